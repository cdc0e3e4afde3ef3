"""The ROS graph over DDS: endpoints that DDS discovers, and nodes that participants announce.

DDS knows participants and endpoints, but no nodes. Each participant publishes its nodes and their
endpoints on `ros_discovery_info`.
"""

import logging
import re
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from cyclonedds.core import InstanceState
from cyclonedds.qos import Policy
from cyclonedds.qos import Qos as DdsQos
from rosbags.typesys import Stores, get_typestore

from gigabrain_zenoh.errors import BadPayload
from gigabrain_zenoh.ros2.qos import MAX_DEPTH, Qos
from gigabrain_zenoh.ros2.transport import EndpointKind, GraphEndpoint, ros_type
from gigabrain_zenoh.ros2.type_files import Fields
from gigabrain_zenoh.ros2.types import decoded

log = logging.getLogger(__name__)
INFO_TOPIC = "ros_discovery_info"
INFO_TYPE = "rmw_dds_common/msg/ParticipantEntitiesInfo"
HASH = re.compile(rb"typehash=(RIHS01_[0-9a-f]{64});")
MAX_NODES = 1000  # of one participant; also the maximum number of participants
GID_BYTES = 16


class DiscoveredEndpoint(NamedTuple):
    """An endpoint as DDS describes it."""

    writer: bool  # false: a reader
    participant: bytes  # the GUID of its participant, 16 bytes
    topic: str  # rt/scan
    type: str  # sensor_msgs::msg::dds_::LaserScan_
    qos: Qos
    hash: str


class NodeEntities(NamedTuple):
    """A node, and the GUIDs of its endpoints."""

    name: str  # fully qualified
    gids: frozenset[bytes]


class DiscoveryInfo:
    """Encodes and decodes `ros_discovery_info`. Up to Humble, its ids have 24 bytes."""

    def __init__(self, distro: str) -> None:
        humble = distro == "humble"
        self._store: Any = get_typestore(Stores.ROS2_HUMBLE if humble else Stores.ROS2_JAZZY)
        self._gid_bytes = 24 if humble else GID_BYTES

    def fields_of(self, name: str) -> Fields:
        """Return the fields of a message type in `ros_discovery_info`."""
        fields: Fields = self._store.fielddefs[name][1]
        return fields

    def encode(
        self,
        participant: bytes,
        namespace: str,
        node: str,
        readers: Iterable[bytes],
        writers: Iterable[bytes],
    ) -> bytes:
        """Return the message of a participant with one node."""
        types = self._store.types
        entities = types["rmw_dds_common/msg/NodeEntitiesInfo"](
            node_namespace=namespace,
            node_name=node,
            reader_gid_seq=[self._gid(each) for each in readers],
            writer_gid_seq=[self._gid(each) for each in writers],
        )
        message = types[INFO_TYPE](gid=self._gid(participant), node_entities_info_seq=[entities])
        return bytes(self._store.serialize_cdr(message, INFO_TYPE, little_endian=True))

    def decode(self, payload: bytes) -> tuple[bytes, tuple[NodeEntities, ...]]:
        """Return a participant's GUID, and its nodes. Raises BadPayload."""
        message = decoded(self._store, INFO_TYPE, payload)
        nodes = tuple(
            NodeEntities(
                f"{each.node_namespace.rstrip('/')}/{each.node_name}",
                frozenset(
                    gid.data[:GID_BYTES].tobytes()
                    for gid in (*each.reader_gid_seq, *each.writer_gid_seq)
                ),
            )
            for each in message.node_entities_info_seq[:MAX_NODES]
        )
        return message.gid.data[:GID_BYTES].tobytes(), nodes

    def _gid(self, guid: bytes) -> Any:
        data = np.frombuffer(guid.ljust(self._gid_bytes, b"\0"), np.uint8)
        return self._store.types["rmw_dds_common/msg/Gid"](data=data)


class DdsGraph:
    """All known endpoints and nodes, including our own."""

    def __init__(self, info: DiscoveryInfo, ours: frozenset[bytes]) -> None:
        """Create an empty graph; `ours` are the GUID prefixes (12 bytes) of our participants."""
        self._info, self._ours = info, ours
        self._discovered: dict[bytes, DiscoveredEndpoint] = {}  # by GUID
        self._nodes: dict[bytes, tuple[NodeEntities, ...]] = {}  # by the GUID of the participant

    def endpoint(self, sample: Any, writer: bool) -> None:
        """Add or remove an endpoint, as a built-in sample of DDS says."""
        guid = sample.key.bytes
        if sample.sample_info.instance_state != InstanceState.Alive or sample.qos is None:
            self._discovered.pop(guid, None)
            return
        self._discovered[guid] = DiscoveredEndpoint(
            writer,
            sample.participant_key.bytes,
            sample.topic_name or "",
            sample.type_name or "",
            ros_qos(sample.qos),
            _hash(sample.qos),
        )

    def participant(self, sample: Any) -> None:
        """Remove the nodes of a participant that a built-in sample of DDS reports as gone."""
        if sample.sample_info.instance_state != InstanceState.Alive:
            self._nodes.pop(sample.key.bytes, None)

    def update(self, payload: bytes) -> None:
        """Replace a participant's nodes by those of a `ros_discovery_info`. Raises BadPayload."""
        participant, nodes = self._info.decode(payload)
        if participant in self._nodes or len(self._nodes) < MAX_NODES:
            self._nodes[participant] = nodes
        else:
            raise BadPayload(f"{INFO_TOPIC}: more than {MAX_NODES} participants")

    def nodes(self) -> tuple[str, ...]:
        """Return the names of all nodes."""
        return tuple(node.name for nodes in self._nodes.values() for node in nodes)

    def endpoints(self) -> tuple[GraphEndpoint, ...]:
        """Return all ROS endpoints. The two DDS endpoints of a server or client are one."""
        owners = {
            gid: node.name for nodes in self._nodes.values() for node in nodes for gid in node.gids
        }
        found = (
            _endpoint(each, owners.get(guid, ""), each.participant[:12] in self._ours)
            for guid, each in self._discovered.items()
        )
        return tuple(each for each in found if each)


def _endpoint(found: DiscoveredEndpoint, node: str, ours: bool) -> GraphEndpoint | None:
    """Return the ROS endpoint; None for other DDS endpoints, and the replies of a service."""
    prefix, _, rest = found.topic.partition("/")
    topic, type = f"/{rest}", ros_type(found.type)
    kind: EndpointKind = "publisher" if found.writer else "subscriber"
    if prefix == "rq" and topic.endswith("Request") and type.endswith("_Request"):
        kind = "client" if found.writer else "server"
        topic, type = topic.removesuffix("Request"), type.removesuffix("_Request")
    elif prefix != "rt" or not rest:
        return None
    return GraphEndpoint(node, kind, topic, type, found.hash, found.qos, ours)


def ros_qos(qos: DdsQos) -> Qos:
    """Return the QoS of an endpoint. The default history of DDS is one message."""
    history = qos[Policy.History]
    depth = getattr(history, "depth", MAX_DEPTH) if history else 1
    return Qos(
        reliable=isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable),
        transient_local=qos[Policy.Durability]
        in (Policy.Durability.TransientLocal, Policy.Durability.Transient),
        depth=min(max(depth, 1), MAX_DEPTH),
    )


def _hash(qos: DdsQos) -> str:
    data = qos[Policy.Userdata]
    found = HASH.search(data.data) if data else None
    return found[1].decode() if found else ""
