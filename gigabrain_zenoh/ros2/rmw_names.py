"""Formats of `rmw_zenoh`: keys, liveliness tokens, QoS texts, ids and attachments.

Source: ros2/rmw_zenoh (design document, `liveliness_utils.cpp`, `attachment_helpers.cpp`).
"""

import struct
import time
from typing import NamedTuple

import xxhash

from gigabrain_zenoh.ros2.qos import MAX_DEPTH, Qos
from gigabrain_zenoh.ros2.transport import EndpointKind, GraphEndpoint, dds_type, ros_type

SPACE = "@ros2_lv"
NODE = "NN"
CODES: dict[EndpointKind, str] = {
    "publisher": "MP",
    "subscriber": "MS",
    "server": "SS",
    "client": "SC",
}
KINDS = {code: kind for kind, code in CODES.items()}
NO_HASH = "TypeHashNotSupported"  # on Humble, which cannot communicate with other releases
DEFAULT_DEPTH = 42
BEST_EFFORT, TRANSIENT_LOCAL = "2", "1"  # codes of rmw; default values are omitted
NODE_PARTS, ENDPOINT_PARTS, QOS_PARTS = 9, 13, 6


def topic_key(domain: int, topic: str, type: str, hash: str) -> str:
    """Return the key of a topic or service."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type)}/{hash}"


def qos_text(qos: Qos) -> str:
    """Return the last part of a token. Values that equal rmw's defaults are empty."""
    reliability = "" if qos.reliable else BEST_EFFORT
    durability = TRANSIENT_LOCAL if qos.transient_local else ""
    depth = "" if qos.depth == DEFAULT_DEPTH else str(qos.depth)
    return f"{reliability}:{durability}:,{depth}:,:,:,,"


def parse_qos(text: str) -> Qos:
    """Parse the last part of a token. Raises ValueError."""
    parts = text.split(":")
    if len(parts) < QOS_PARTS:
        raise ValueError(f"QoS {text!r}: expected {QOS_PARTS} parts")
    depth = parts[2].partition(",")[2]
    return Qos(
        reliable=parts[0] != BEST_EFFORT,
        transient_local=parts[1] == TRANSIENT_LOCAL,
        depth=min(max(int(depth), 1), MAX_DEPTH) if depth else DEFAULT_DEPTH,
    )


class NodeName(NamedTuple):
    """A node of a session."""

    domain: int
    zid: str  # id of its Zenoh session
    namespace: str  # / or /robot1
    name: str

    @property
    def whole(self) -> str:
        """Fully qualified: /robot1/talker."""
        return f"{self.namespace.rstrip('/')}/{self.name}"

    @property
    def token(self) -> str:
        """Liveliness token of the node, with the id 0 in its session."""
        return self._start(0, NODE)

    def endpoint_token(
        self, id: int, kind: EndpointKind, topic: str, type: str, hash: str, qos: Qos
    ) -> str:
        """Return the liveliness token of one of the node's endpoints."""
        parts = (_mangled(topic), dds_type(type), hash, qos_text(qos))
        return "/".join((self._start(id, CODES[kind]), *parts))

    def _start(self, id: int, code: str) -> str:
        names = f"%/{_mangled(self.namespace)}/{self.name}"
        return f"{SPACE}/{self.domain}/{self.zid}/0/{id}/{code}/{names}"


def parse_token(key: str, our_zid: str) -> GraphEndpoint | str:
    """Return the endpoint of a token, or the name of a node. Raises ValueError."""
    parts = key.split("/")
    if len(parts) < NODE_PARTS or parts[0] != SPACE or not all(parts[:NODE_PARTS]):
        raise ValueError(f"{key!r} is no token of a ROS node")
    node = f"{_plain(parts[7]).rstrip('/')}/{parts[8]}"
    if parts[5] == NODE:
        return node
    if len(parts) < ENDPOINT_PARTS or parts[5] not in KINDS:
        raise ValueError(f"{key!r} is no token of a ROS endpoint")
    return GraphEndpoint(
        node,
        KINDS[parts[5]],
        _plain(parts[9]),
        ros_type(_plain(parts[10])),
        "" if parts[11] == NO_HASH else parts[11],
        parse_qos(parts[12]),
        parts[2] == our_zid,
    )


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"


def _plain(name: str) -> str:
    return name.replace("%", "/")


def gid_of(token: str) -> bytes:
    """Return the id (16 bytes) of the endpoint with this token."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


SHORT_FORM = struct.Struct("<qqB16s")  # 33 bytes
LONG_FORM = struct.Struct("<16sq17sq12s16s")  # 77 bytes, in versions 0.2.0 to 0.2.3 of Jazzy
FIELD_NAMES = (b"\x0fsequence_number", b"\x10source_timestamp", b"\x0asource_gid\x10")


class Attachment(NamedTuple):
    """The attachment of a message, request or response: its number, time and sender."""

    sequence: int  # counts from 1
    source_ns: int  # [ns], Unix time
    gid: bytes  # 16 bytes, id of the publisher or client
    named: bool = False  # true: the long form, with field names

    def to_bytes(self) -> bytes:
        """Encode in the short or long form."""
        if not self.named:
            return SHORT_FORM.pack(self.sequence, self.source_ns, 16, self.gid)
        sequence, stamp, gid = FIELD_NAMES
        return LONG_FORM.pack(sequence, self.sequence, stamp, self.source_ns, gid, self.gid)

    def answered(self) -> "Attachment":
        """Return the attachment for the response to this request."""
        return self._replace(source_ns=time.time_ns())


def parse_attachment(data: bytes) -> Attachment:
    """Parse an attachment in either form. Raises ValueError."""
    if len(data) == SHORT_FORM.size:
        sequence, source_ns, size, gid = SHORT_FORM.unpack(data)
        if size == 16:
            return Attachment(sequence, source_ns, gid)
    elif len(data) == LONG_FORM.size:
        first, sequence, second, source_ns, third, gid = LONG_FORM.unpack(data)
        if (first, second, third) == FIELD_NAMES:
            return Attachment(sequence, source_ns, gid, named=True)
    raise ValueError(f"attachment of {len(data)} bytes: expected 33 or 77 in rmw_zenoh's form")
