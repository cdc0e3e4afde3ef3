"""Interface of the transports to ROS 2, and the names that both use.

Payloads are CDR with its 4-byte header, as `Types.encode` returns them. All methods and callbacks
run on the event loop's thread. A transport does not receive its own messages.
"""

import re
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ros2.qos import DEFAULT, Qos

Close = Callable[[], None]  # may be called twice
OnReaders = Callable[[int], None]  # called with the number of matched readers of other nodes
Answer = Callable[[bytes], Awaitable[bytes]]  # from request to response, both CDR
EndpointKind = Literal["publisher", "subscriber", "server", "client"]


class Received(NamedTuple):
    """One message of a topic."""

    payload: bytes  # CDR; unknown bytes may follow it
    source_ns: int | None  # [ns] Unix time of publication, by the publisher's clock
    gid: bytes  # the publisher's id, 16 bytes; empty if unknown
    number: int | None = None  # the publisher's count; None if the transport keeps the order


OnReceived = Callable[[Received], None]


@dataclass(frozen=True)
class GraphEndpoint:
    """A publisher, subscriber, server or client in the ROS graph."""

    node: str  # fully qualified: /robot1/talker; empty if unknown
    kind: EndpointKind
    topic: str  # fully qualified; the service, for servers and clients
    type: str  # std_msgs/msg/String, std_srvs/srv/SetBool
    hash: str  # RIHS01_…; empty if the other node sends none
    qos: Qos
    ours: bool  # true: created by this transport


class RosPublisher(Protocol):
    """A publisher of one topic."""

    @property
    def readers(self) -> int:
        """Number of matched readers of other nodes. At 0, skip encoding and publishing."""
        ...

    def publish(self, payload: bytes) -> None:
        """Send to all readers, without waiting for them."""
        ...

    def close(self) -> None:
        """Withdraw the publisher. May be called twice."""
        ...


class RosServer(Protocol):
    """Offers topics and services.

    Names are absolute (`/scan`) or relative to the node's namespace (`scan`). Types are written
    as `std_msgs/msg/String` or `std_srvs/srv/SetBool`.
    """

    counts: Counter[str]  # numbers of rejected or lost messages, by reason

    def publisher(
        self, topic: str, type: str, qos: Qos = DEFAULT, on_readers: OnReaders | None = None
    ) -> RosPublisher:
        """Declare a publisher. `on_readers` is called when the number of readers changes."""
        ...

    def serve(self, service: str, type: str, handle: Answer) -> Close:
        """Answer requests of a service, each in a task of its own.

        A GigabrainError of `handle` is logged, and the client gets no answer, because a ROS
        response cannot carry an error.
        """
        ...


class RosTransport(RosServer, Protocol):
    """One ROS node on a transport."""

    def subscribe(self, topic: str, type: str, qos: Qos, handle: OnReceived) -> Close:
        """Call `handle` for each message; up to `qos.depth` newest ones wait for a busy loop."""
        ...

    async def call(self, service: str, type: str, request: bytes, timeout_s: float) -> bytes:
        """Return the response of the service's server. Raises NoAnswer."""
        ...

    def endpoints(self) -> tuple[GraphEndpoint, ...]:
        """Return the endpoints of all nodes, including this one."""
        ...

    def nodes(self) -> tuple[str, ...]:
        """Return the fully qualified names of all nodes, including this one."""
        ...


NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
TYPE = re.compile(r"[a-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)


def absolute(name: str, namespace: str) -> str:
    """Return the absolute name of a topic or service. Raises ConfigError for an invalid name.

    >>> absolute("scan", "/robot1")
    '/robot1/scan'
    """
    if not NAME.fullmatch(name):
        raise ConfigError(f"{name!r} is no ROS name; expected one like /scan", value=name)
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def dds_type(name: str) -> str:
    """Return a type's name on the wire: `std_msgs/msg/String` is `std_msgs::msg::dds_::String_`.

    Raises ConfigError for a name of another form.
    """
    if not TYPE.fullmatch(name):
        raise ConfigError(
            f"{name!r} is no ROS type; expected one like std_msgs/msg/String", value=name
        )
    package, kind, short = name.split("/")
    return f"{package}::{kind}::dds_::{short}_"


def ros_type(name: str) -> str:
    """Return the ROS type of a DDS type name; the name itself if it has another form."""
    parts = name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return name
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
