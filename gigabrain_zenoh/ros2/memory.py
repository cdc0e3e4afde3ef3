"""A network of ROS nodes inside this process, for tests: first in, first out, no clock.

Endpoints match as in DDS, and payloads are the same as on the wire.
"""

import asyncio
import contextlib
import logging
from collections import Counter, deque
from collections.abc import Callable
from itertools import count
from types import TracebackType

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import GigabrainError, NoAnswer
from gigabrain_zenoh.ros2.qos import DEFAULT, SERVICES, Qos, mismatch
from gigabrain_zenoh.ros2.transport import (
    Answer,
    Close,
    EndpointKind,
    GraphEndpoint,
    OnReaders,
    OnReceived,
    Received,
    absolute,
)
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)


class MemoryEndpoint:
    """One endpoint of a node on a MemoryNetwork; its publish method is for publishers."""

    def __init__(
        self, node: "MemoryTransport", kind: EndpointKind, topic: str, type: str, qos: Qos
    ) -> None:
        self.node, self.kind, self.topic, self.type, self.qos = node, kind, topic, type, qos
        self.gid = next(node.network.ids).to_bytes(16, "little")
        self.history: deque[Received] = deque(maxlen=qos.depth)  # for late readers
        self.on_readers: OnReaders | None = None
        self.handle: OnReceived | None = None
        self.answer: Answer | None = None
        self.readers = 0

    def publish(self, payload: bytes) -> None:
        """Deliver to all matched readers."""
        received = Received(payload, self.node.network.now_ns(), self.gid)
        if self.qos.transient_local:
            self.history.append(received)
        for reader in self.node.network.matching(self):
            self.node.network.post(reader, received)

    def close(self) -> None:
        """Remove the endpoint from its network."""
        self.node.network.leave(self)


class MemoryNetwork:
    """Connects the nodes of a test."""

    def __init__(self, types: Types, now_ns: Callable[[], int] = lambda: 0) -> None:
        self.types, self.now_ns = types, now_ns
        self.ids = count(1)
        self.endpoints: list[MemoryEndpoint] = []
        self.nodes: list[MemoryTransport] = []
        self._queue: deque[tuple[MemoryEndpoint, Received]] = deque()
        self._delivering = False

    def transport(self, link: Ros2Link | None = None) -> "MemoryTransport":
        """Return a new node on this network."""
        self.nodes.append(MemoryTransport(self, link or Ros2Link()))
        return self.nodes[-1]

    def join(self, endpoint: MemoryEndpoint) -> None:
        """Add an endpoint, match it, and deliver the history of its publishers."""
        self.endpoints.append(endpoint)
        self._count_readers()
        if endpoint.kind != "subscriber" or not endpoint.qos.transient_local:
            return
        for writer in tuple(self.endpoints):
            if endpoint in self.matching(writer):
                for received in writer.history:
                    self.post(endpoint, received)

    def leave(self, endpoint: MemoryEndpoint) -> None:
        """Remove an endpoint. Does nothing if it is already removed."""
        with contextlib.suppress(ValueError):
            self.endpoints.remove(endpoint)
        endpoint.readers = 0
        self._count_readers()

    def matching(self, writer: MemoryEndpoint) -> list[MemoryEndpoint]:
        """Return the matched subscribers of other nodes; empty if `writer` is not a publisher."""
        if writer.kind != "publisher":
            return []
        return [
            each
            for each in self.endpoints
            if each.kind == "subscriber"
            and (each.topic, each.type) == (writer.topic, writer.type)
            and each.node is not writer.node
            and not mismatch(writer.qos, each.qos)
        ]

    def post(self, reader: MemoryEndpoint, received: Received) -> None:
        """Deliver a message after those in the queue."""
        self._queue.append((reader, received))
        if self._delivering:
            return
        self._delivering = True
        try:
            while self._queue:
                reader, received = self._queue.popleft()
                if reader in self.endpoints and reader.handle:
                    reader.handle(received)
        finally:
            self._delivering = False

    def _count_readers(self) -> None:
        for writer in tuple(self.endpoints):
            readers = len(self.matching(writer))
            if readers != writer.readers:
                writer.readers = readers
                if writer.on_readers:
                    writer.on_readers(readers)


class MemoryTransport:
    """One node on a MemoryNetwork."""

    def __init__(self, network: MemoryNetwork, link: Ros2Link) -> None:
        self.network, self._link = network, link
        self.counts: Counter[str] = Counter()
        self.name = f"{link.namespace.rstrip('/')}/{link.node}"

    async def __aenter__(self) -> "MemoryTransport":
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for endpoint in tuple(self.network.endpoints):
            if endpoint.node is self:
                endpoint.close()
        with contextlib.suppress(ValueError):
            self.network.nodes.remove(self)

    def publisher(
        self, topic: str, type: str, qos: Qos = DEFAULT, on_readers: OnReaders | None = None
    ) -> MemoryEndpoint:
        """Declare a publisher."""
        publisher = self._endpoint("publisher", topic, type, qos)
        publisher.on_readers = on_readers
        self.network.join(publisher)
        return publisher

    def subscribe(self, topic: str, type: str, qos: Qos, handle: OnReceived) -> Close:
        """Call `handle` synchronously for each message."""
        subscriber = self._endpoint("subscriber", topic, type, qos)
        subscriber.handle = handle
        self.network.join(subscriber)
        return subscriber.close

    def serve(self, service: str, type: str, handle: Answer) -> Close:
        """Serve a service: `handle` returns the response to a request."""
        server = self._endpoint("server", service, type, SERVICES)
        server.answer = handle
        self.network.join(server)
        return server.close

    async def call(self, service: str, type: str, request: bytes, timeout_s: float) -> bytes:
        """Return the response of the service's server. Raises NoAnswer."""
        topic = absolute(service, self._link.namespace)
        for each in self.network.endpoints:
            if each.kind == "server" and (each.topic, each.type) == (topic, type):
                assert each.answer is not None
                try:
                    return await asyncio.wait_for(each.answer(request), timeout_s)
                except (GigabrainError, TimeoutError) as error:
                    log.warning("%s: no answer: %s", topic, error)
                    break
        raise NoAnswer(f"no answer of {topic} within {timeout_s} s")

    def endpoints(self) -> tuple[GraphEndpoint, ...]:
        """Return the endpoints of all nodes."""
        return tuple(
            GraphEndpoint(
                each.node.name,
                each.kind,
                each.topic,
                each.type,
                self.network.types.hash(each.type),
                each.qos,
                each.node is self,
            )
            for each in self.network.endpoints
        )

    def nodes(self) -> tuple[str, ...]:
        """Return the names of all nodes."""
        return tuple(each.name for each in self.network.nodes)

    def _endpoint(self, kind: EndpointKind, topic: str, type: str, qos: Qos) -> MemoryEndpoint:
        self.network.types.hash(type)  # raises for an unknown type
        return MemoryEndpoint(self, kind, absolute(topic, self._link.namespace), type, qos)
