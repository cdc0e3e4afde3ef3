"""Interface of the transports to ROS 2, and the names that both use.

Payloads are CDR with the header of 4 bytes, as `Types.encode` makes them. Everything runs on the
event loop's thread. Nothing that a transport publishes reaches its own subscriptions.
"""

import re
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ros2.qos import DEFAULT, Qos

Close = Callable[[], None]  # may be called twice
OnReaders = Callable[[int], None]  # number of matched readers of others
Answer = Callable[[bytes], Awaitable[bytes]]  # request to response, both CDR
EndpointKind = Literal["publisher", "subscriber", "server", "client"]


class Received(NamedTuple):
    """One message of a topic."""

    payload: bytes  # CDR; may have a tail
    source_ns: int | None  # [ns] Unix time of its publication, by the publisher's clock
    gid: bytes  # of the publisher: 16 bytes; empty if unknown
    number: int | None = None  # by the publisher; None where a transport keeps the order itself


OnReceived = Callable[[Received], None]


@dataclass(frozen=True)
class GraphEndpoint:
    """A publisher, subscriber, server or client in the ROS graph."""

    node: str  # fully qualified: /robot1/talker; empty if unknown
    kind: EndpointKind
    topic: str  # fully qualified; of servers and clients the service
    type: str  # std_msgs/msg/String, std_srvs/srv/SetBool
    hash: str  # RIHS01_…; empty where the other side tells none
    qos: Qos
    ours: bool  # made by this transport


class RosPublisher(Protocol):
    """A publisher of one topic."""

    @property
    def readers(self) -> int:
        """Number of matched readers of others. At 0 nothing has to be encoded."""
        ...

    def publish(self, payload: bytes) -> None:
        """Send to all readers, without waiting for any."""
        ...

    def close(self) -> None:
        """Withdraw the publisher. May be called twice."""
        ...


class RosServer(Protocol):
    """Offers topics and services.

    Both are absolute (`/scan`) or relative to the node's namespace (`scan`). Types are
    `std_msgs/msg/String` or `std_srvs/srv/SetBool`.
    """

    counts: Counter[str]  # what was refused or lost, by reason

    def publisher(
        self, topic: str, type: str, qos: Qos = DEFAULT, on_readers: OnReaders | None = None
    ) -> RosPublisher:
        """Declare a publisher. `on_readers` gets the number of readers at each change."""
        ...

    def serve(self, service: str, type: str, handle: Answer) -> Close:
        """Answer requests of a service, each in a task of its own.

        A GigabrainError of `handle` is logged, and the client gets no answer: ROS has no other way.
        """
        ...


class RosTransport(RosServer, Protocol):
    """One ROS node on a transport."""

    def subscribe(self, topic: str, type: str, qos: Qos, handle: OnReceived) -> Close:
        """Call `handle` for each message; a busy loop keeps the newest `qos.depth` messages."""
        ...

    async def call(self, service: str, type: str, request: bytes, timeout_s: float) -> bytes:
        """Return the response of the service's server. Raises NoAnswer."""
        ...

    def endpoints(self) -> tuple[GraphEndpoint, ...]:
        """Return the graph: endpoints of all nodes, ours as well."""
        ...

    def nodes(self) -> tuple[str, ...]:
        """Return the fully qualified names of all nodes, ours as well."""
        ...


NAME = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
TYPE = re.compile(r"[a-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)


def absolute(name: str, namespace: str) -> str:
    """Return a topic or service with a leading slash. Raises ConfigError for an invalid name.

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
    """Return the type of a name on the wire; the name itself if it is of another form."""
    parts = name.split("::")
    if len(parts) != 4 or parts[2] != "dds_" or not parts[3].endswith("_"):
        return name
    return f"{parts[0]}/{parts[1]}/{parts[3][:-1]}"
