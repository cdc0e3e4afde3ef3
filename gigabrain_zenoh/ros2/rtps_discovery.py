"""Discovery data of RTPS: participants and endpoints as parameter lists, ports and addresses.

Source: OMG DDSI-RTPS 2.3, chapters 8.5 and 9.6; for user data, the rmw layers of ROS 2.
"""

import socket
import struct
from collections.abc import Collection, Iterable
from typing import NamedTuple

from gigabrain_zenoh.ros2.rtps_wire import (
    PID_KEY_HASH,
    PID_SENTINEL,
    VENDOR_UNKNOWN,
    VERSION,
    BadMessage,
    decode_parameters,
    encode_parameters,
)
from gigabrain_zenoh.ros2.transport import dds_type

Address = tuple[str, int]  # IPv4 address and UDP port

MULTICAST_GROUP = "239.255.0.1"
MAX_DOMAIN, MAX_PARTICIPANTS = 232, 120  # the latter: of one domain on one host
MAX_PORT = 65535
PARTICIPANT = bytes((0, 0, 1, 0xC1))
SPDP_WRITER, SPDP_READER = bytes((0, 1, 0, 0xC2)), bytes((0, 1, 0, 0xC7))
PUBLICATIONS_WRITER, PUBLICATIONS_READER = bytes((0, 0, 3, 0xC2)), bytes((0, 0, 3, 0xC7))
SUBSCRIPTIONS_WRITER, SUBSCRIPTIONS_READER = bytes((0, 0, 4, 0xC2)), bytes((0, 0, 4, 0xC7))
WRITER_KIND, READER_KIND = 0x03, 0x04  # last byte of the entity id, for topics without a key
BUILTIN_ENDPOINTS = 0x3F  # announcers and detectors of participants, publications, subscriptions
HAS_PUBLICATIONS_WRITER, HAS_PUBLICATIONS_READER = 1 << 2, 1 << 3
HAS_SUBSCRIPTIONS_WRITER, HAS_SUBSCRIPTIONS_READER = 1 << 4, 1 << 5

_PARAMETER_LIST = bytes((0, 3, 0, 0))  # encapsulation: little-endian parameter list
_UDP_V4, _RELIABLE, _VOLATILE, _XCDR1 = 1, 2, 0, 0
_MAX_BLOCKING = struct.pack("<iI", 0, 429_496_729)  # 0.1 s, the default
_LEASE_DURATION, _TOPIC_NAME, _TYPE_NAME = 0x0002, 0x0005, 0x0007
_PROTOCOL_VERSION, _VENDOR_ID, _RELIABILITY, _DURABILITY = 0x0015, 0x0016, 0x001A, 0x001D
_PARTITION, _USER_DATA, _ENDPOINT_LOCATOR = 0x0029, 0x002C, 0x002F
_USER_LOCATOR, _BUILTIN_LOCATOR = 0x0031, 0x0032
_PARTICIPANT_GUID, _BUILTIN_SET, _ENDPOINT_GUID = 0x0050, 0x0058, 0x005A
_ENTITY_NAME, _REPRESENTATION = 0x0062, 0x0073
MAX_LOCATORS, MAX_NAME_BYTES = 16, 512


class ParticipantData(NamedTuple):
    """A participant, and the addresses at which it listens."""

    prefix: bytes
    builtin: tuple[Address, ...]  # addresses for discovery data
    user: tuple[Address, ...]  # addresses for samples of topics
    lease_s: float = 10.0
    endpoints: int = BUILTIN_ENDPOINTS  # bits of its discovery endpoints
    vendor: bytes = VENDOR_UNKNOWN
    enclave: str = "/"

    def encode(self) -> bytes:
        """Return the payload of its announcement."""
        user_data = f"enclave={self.enclave};".encode() + b"\0"
        return _PARAMETER_LIST + encode_parameters(
            [
                (_PROTOCOL_VERSION, VERSION),
                (_VENDOR_ID, self.vendor),
                (_PARTICIPANT_GUID, self.prefix + PARTICIPANT),
                *((_BUILTIN_LOCATOR, encode_locator(address)) for address in self.builtin),
                *((_USER_LOCATOR, encode_locator(address)) for address in self.user),
                (_LEASE_DURATION, struct.pack("<iI", int(self.lease_s), 0)),
                (_BUILTIN_SET, struct.pack("<I", self.endpoints)),
                (_ENTITY_NAME, _string(self.enclave)),
                (_USER_DATA, struct.pack("<I", len(user_data)) + user_data),
            ]
        )

    def encode_key(self) -> bytes:
        """Return the payload that announces the end of this participant."""
        guid = self.prefix + PARTICIPANT
        return _PARAMETER_LIST + encode_parameters([(_PARTICIPANT_GUID, guid)])


class EndpointData(NamedTuple):
    """A reader or writer of a topic."""

    guid: bytes
    topic: str  # DDS name: "rq/estopRequest"
    type: str  # "std_srvs::srv::dds_::SetBool_Request_"
    reliable: bool = True
    durability: int = _VOLATILE  # 1 is transient local, 2 transient, 3 persistent
    partitioned: bool = False  # true: only for endpoints in a partition, which ours are not
    locators: tuple[Address, ...] = ()  # empty: the addresses of its participant
    type_hash: str = ""  # "RIHS01_..."

    @property
    def is_writer(self) -> bool:
        """Return whether this is a writer."""
        return self.guid[15] & 0x0F in (0x02, 0x03)

    def encode(self) -> bytes:
        """Return the payload of its announcement."""
        user_data = f"typehash={self.type_hash};".encode() if self.type_hash else b""
        reliability = struct.pack("<I", _RELIABLE if self.reliable else 1) + _MAX_BLOCKING
        return _PARAMETER_LIST + encode_parameters(
            [
                (_ENDPOINT_GUID, self.guid),
                (_PARTICIPANT_GUID, self.guid[:12] + PARTICIPANT),
                (PID_KEY_HASH, self.guid),
                (_TOPIC_NAME, _string(self.topic)),
                (_TYPE_NAME, _string(self.type)),
                (_PROTOCOL_VERSION, VERSION),
                (_VENDOR_ID, VENDOR_UNKNOWN),
                (_RELIABILITY, reliability),
                (_DURABILITY, struct.pack("<I", self.durability)),
                (_USER_DATA, struct.pack("<I", len(user_data)) + user_data),
                (_REPRESENTATION, struct.pack("<IHH", 1, _XCDR1, 0)),
            ]
        )

    def encode_key(self) -> bytes:
        """Return the payload that announces the end of this endpoint."""
        return _PARAMETER_LIST + encode_parameters([(_ENDPOINT_GUID, self.guid)])

    def matches(self, other: "EndpointData") -> bool:
        """Return whether one is a writer, the other a reader, and they exchange samples."""
        if self.topic != other.topic or self.type != other.type:
            return False
        if self.is_writer == other.is_writer or self.partitioned or other.partitioned:
            return False
        writer, reader = (self, other) if self.is_writer else (other, self)
        return writer.reliable >= reader.reliable and writer.durability >= reader.durability


def decode_participant(payload: bytes, vendor: bytes) -> ParticipantData:
    """Decode a participant's announcement, or its key. Raises BadMessage."""
    order, found = _parameters(payload)
    prefix = _guid(found, _PARTICIPANT_GUID)[:12]
    lease = found.get(_LEASE_DURATION, [b""])[0]
    endpoints = found.get(_BUILTIN_SET, [b""])[0]
    return ParticipantData(
        prefix=prefix,
        builtin=_locators(order, found.get(_BUILTIN_LOCATOR, ())),
        user=_locators(order, found.get(_USER_LOCATOR, ())),
        lease_s=float(struct.unpack(order + "i", lease[:4])[0]) if len(lease) >= 8 else 100.0,
        endpoints=struct.unpack(order + "I", endpoints[:4])[0] if len(endpoints) >= 4 else 0,
        vendor=vendor,
    )


def decode_endpoint(payload: bytes) -> EndpointData:
    """Decode an endpoint's announcement, or its key. Raises BadMessage."""
    order, found = _parameters(payload)
    guid = _guid(found, _ENDPOINT_GUID if _ENDPOINT_GUID in found else PID_KEY_HASH)
    reliability = found.get(_RELIABILITY, [b""])[0]
    durability = found.get(_DURABILITY, [b""])[0]
    is_writer = guid[15] & 0x0F in (0x02, 0x03)
    kind = struct.unpack(order + "I", reliability[:4])[0] if len(reliability) >= 4 else 0
    partition = found.get(_PARTITION, [b""])[0]
    return EndpointData(
        guid=guid,
        topic=_text(order, found.get(_TOPIC_NAME, [b""])[0]),
        type=_text(order, found.get(_TYPE_NAME, [b""])[0]),
        reliable=kind == _RELIABLE if kind else is_writer,  # only writers are reliable by default
        durability=struct.unpack(order + "I", durability[:4])[0] if len(durability) >= 4 else 0,
        partitioned=len(partition) >= 4 and any(partition[:4]),
        locators=_locators(order, found.get(_ENDPOINT_LOCATOR, ())),
    )


def multicast_port(domain: int) -> int:
    """Return the multicast port for announcements in a domain."""
    return 7400 + 250 * domain


def participant_ports(domain: int, index: int) -> tuple[int, int]:
    """Return the ports (discovery, user data) of the participant `index` on a host."""
    return multicast_port(domain) + 10 + 2 * index, multicast_port(domain) + 11 + 2 * index


def host_ports(domain: int) -> list[tuple[int, int]]:
    """Return the port pairs of a domain's participants on a host; domain 232 has only 63."""
    pairs = (participant_ports(domain, index) for index in range(MAX_PARTICIPANTS))
    return [pair for pair in pairs if pair[1] <= MAX_PORT]


def encode_locator(address: Address) -> bytes:
    """Return the 24 bytes of a locator."""
    host, port = address
    return struct.pack("<iI12s", _UDP_V4, port, bytes(12)) + socket.inet_aton(host)


def choose_address(
    locators: Iterable[Address], source: str, own: Collection[str]
) -> Address | None:
    """Return the first locator on the host that sent the announcement; None without one.

    `own` are the addresses of this host. Other locators are ignored, so that a participant cannot
    make us send to a third host.
    """
    found = list(locators)
    for host, port in found:
        if host == source:
            return host, port
    if source in own:
        return next((each for each in found if each[0] in own), None)
    return None


def service_topics(service: str) -> tuple[str, str]:
    """Return the topics of requests and replies: `rq/a/bRequest`, `rr/a/bReply` for `/a/b`."""
    return f"rq{service}Request", f"rr{service}Reply"


def service_types(name: str) -> tuple[str, str]:
    """Return the DDS types of requests and responses of a type such as `std_srvs/srv/SetBool`.

    Raises ConfigError for a name of another form.
    """
    stem = dds_type(name)
    return f"{stem}Request_", f"{stem}Response_"


def _parameters(payload: bytes) -> tuple[str, dict[int, list[bytes]]]:
    if len(payload) < 4 or payload[0] or payload[1] not in (2, 3):
        raise BadMessage("not a parameter list")
    order = "<" if payload[1] == 3 else ">"
    found: dict[int, list[bytes]] = {}
    for pid, value, _ in decode_parameters(order, payload, 4):
        if pid != PID_SENTINEL:
            found.setdefault(pid, []).append(value)
    return order, found


def _guid(found: dict[int, list[bytes]], pid: int) -> bytes:
    guid = found.get(pid, [b""])[0]
    if len(guid) < 16:
        raise BadMessage("no GUID")
    return guid[:16]


def _locators(order: str, values: Iterable[bytes]) -> tuple[Address, ...]:
    """Return the usable locators: UDP over IPv4, with a valid port, not multicast."""
    found = []
    for value in list(values)[:MAX_LOCATORS]:
        if len(value) < 24:
            continue
        kind, port = struct.unpack(order + "iI", value[:8])
        if kind == _UDP_V4 and 0 < port <= MAX_PORT and value[20] not in (0, *range(224, 256)):
            found.append((socket.inet_ntoa(value[20:24]), int(port)))
    return tuple(found)


def _string(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data


def _text(order: str, value: bytes) -> str:
    if len(value) < 4:
        return ""
    (size,) = struct.unpack(order + "I", value[:4])
    if not 0 < size <= min(len(value) - 4, MAX_NAME_BYTES):
        raise BadMessage("a name that is too long")
    return value[4 : 4 + size].split(b"\0")[0].decode("utf-8", "replace")
