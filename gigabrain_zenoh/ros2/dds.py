"""Transport to ROS nodes over DDS: topics by cyclonedds, services by a participant of their own.

A thread waits for readers with data, and posts a call to the event loop. The loop then takes the
reader's samples, at most its depth at once.
"""

import asyncio
import contextlib
import logging
import threading
from collections import Counter
from collections.abc import Callable
from types import TracebackType
from typing import Any

from cyclonedds._clayer import ddspy_take, ddspy_write
from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import (
    DDSException,
    DDSStatus,
    Entity,
    GuardCondition,
    InstanceState,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy
from cyclonedds.qos import Qos as DdsQos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import BadPayload, BusError
from gigabrain_zenoh.ros2.dds_graph import INFO_TOPIC, INFO_TYPE, DdsGraph, DiscoveryInfo
from gigabrain_zenoh.ros2.dds_types import IdlTypes
from gigabrain_zenoh.ros2.qos import DEFAULT, MAX_DEPTH, Qos
from gigabrain_zenoh.ros2.rtps import RequestReply, ServiceType
from gigabrain_zenoh.ros2.transport import (
    Answer,
    Close,
    GraphEndpoint,
    OnReaders,
    OnReceived,
    Received,
    absolute,
)
from gigabrain_zenoh.ros2.types import Types

log = logging.getLogger(__name__)
ALL = SampleState.Any | ViewState.Any | InstanceState.Any
FOREVER = duration(infinite=True)
BLOCKING_MS = 1  # maximum wait of a write for a slow reader, because it blocks the event loop
INFO_QOS = Qos(transient_local=True, depth=1)
LOCALHOST = """<CycloneDDS><Domain Id="any">
<General><Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>120</MaxAutoParticipantIndex>
<Peers><Peer Address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""


class _StatusWatcher:
    """A thread that waits for readers with data, and for writers whose readers changed.

    Listeners of cyclonedds could deadlock: its threads would hold its locks while they wait for the
    GIL, and `ddspy_write` holds the GIL while it waits for those locks.
    """

    def __init__(self, participant: DomainParticipant) -> None:
        self._set = WaitSet(participant)
        self._watched: dict[Entity, tuple[int, Callable[[], None]]] = {}
        self._closing = GuardCondition(participant)
        self._set.attach(self._closing)
        self._thread = threading.Thread(target=self._run, name="dds", daemon=True)
        self._thread.start()

    def watch(self, entity: Entity, status: int, post: Callable[[], None]) -> None:
        """Call `post` in the thread each time that the status is set, and once now."""
        entity.set_status_mask(status)
        self._watched = {**self._watched, entity: (status, post)}
        self._set.attach(entity)
        post()

    def forget(self, entity: Entity) -> None:
        """Stop watching an entity."""
        self._watched = {each: how for each, how in self._watched.items() if each is not entity}
        self._set.detach(entity)

    def close(self) -> None:
        """End the thread."""
        self._closing.set(True)
        self._thread.join()

    def _run(self) -> None:
        while self._set.wait(FOREVER) and not self._closing.read():
            for entity, (status, post) in self._watched.items():
                with contextlib.suppress(DDSException):  # the entity may be deleted by now
                    if entity.take_status(status):
                        post()


class DdsPublisher:
    """A publisher, which owns a writer of cyclonedds."""

    def __init__(self, home: "DdsTransport", writer: Any, on_readers: OnReaders | None) -> None:
        self.readers = 0
        self._home, self._writer, self._on_readers = home, writer, on_readers
        self.gid: bytes = writer.guid.bytes

    def publish(self, payload: bytes) -> None:
        """Send to all readers; a slow reliable reader can block it for BLOCKING_MS."""
        if self._writer and ddspy_write(self._writer._ref, payload) < 0:
            self._home.counts["not sent"] += 1

    def close(self) -> None:
        """Withdraw the publisher."""
        if self._writer:
            writer, self._writer = self._writer, None
            self._home.remove(self, writer)

    def count(self) -> None:
        """Update the number of readers, and report a change."""
        if not self._writer:
            return
        readers = int(self._writer.get_publication_matched_status().current_count)
        if readers != self.readers:
            self.readers = readers
            if self._on_readers:
                self._on_readers(readers)


class DdsSubscriber:
    """A subscriber, which owns a reader of cyclonedds."""

    def __init__(self, home: "DdsTransport", reader: Any, depth: int, handle: OnReceived) -> None:
        self._home, self._reader, self._depth, self._handle = home, reader, depth, handle
        self._gids: dict[int, bytes] = {}  # ids of publishers by handle
        self.gid: bytes = reader.guid.bytes

    def take(self) -> bool:
        """Deliver at most `depth` samples of the reader; return whether there may be more."""
        taken = ddspy_take(self._reader._ref, ALL, self._depth) if self._reader else ()
        if isinstance(taken, int):
            self._home.counts["not taken"] += 1
            return False
        for payload, info in taken:
            if info.valid_data and self._reader:
                gid = self._gid(info.publication_handle)
                self._handle(Received(payload, info.source_timestamp, gid))
        return len(taken) == self._depth

    def close(self) -> None:
        """Withdraw the subscriber."""
        if self._reader:
            reader, self._reader = self._reader, None
            self._home.remove(self, reader)

    def _gid(self, handle: int) -> bytes:
        if handle not in self._gids:
            if len(self._gids) >= MAX_DEPTH:  # most are of publishers that no longer exist
                self._gids.clear()
            found = self._reader.get_matched_publication_data(handle)
            self._gids[handle] = found.key.bytes if found else b""
        return self._gids[handle]


class DdsTransport:
    """One ROS node, as a participant of a DDS domain."""

    def __init__(self, link: Ros2Link, types: Types) -> None:
        """Prepare; `link` names domain and node."""
        self.link, self.types = link, types
        self.counts: Counter[str] = Counter()
        self._info = DiscoveryInfo(link.distro)
        self._idl, self._info_idl = IdlTypes(types.fields), IdlTypes(self._info.fields_of)
        self._topics: dict[tuple[str, str], Any] = {}
        self._endpoints: list[DdsPublisher | DdsSubscriber] = []
        self._publishing = self._closed = False
        self._references: list[Entity] = []  # cyclonedds deletes entities without references

    async def __aenter__(self) -> "DdsTransport":
        self._loop = asyncio.get_running_loop()
        self._services = await RequestReply.open(self.link.domain, localhost=self.link.localhost)
        async with contextlib.AsyncExitStack() as undo:
            undo.push_async_callback(self._services.close)
            self._bridge = Bridge()
            undo.callback(self._bridge.close)
            try:
                self._open()
            except DDSException as error:
                text = f"DDS domain {self.link.domain} cannot be joined: {error}"
                raise BusError(text) from None
            undo.pop_all()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bridge.close()
        self._closed = True
        await self._services.close()
        await asyncio.to_thread(self._watcher.close)
        await asyncio.to_thread(_delete, self._participant)  # and all its entities

    def publisher(
        self, topic: str, type: str, qos: Qos = DEFAULT, on_readers: OnReaders | None = None
    ) -> DdsPublisher:
        """Declare a publisher. `on_readers` is first called in a later turn of the loop."""
        writer = DataWriter(
            self._participant, self._topic(topic, type), dds_qos(qos, self.types.hash(type))
        )
        publisher = DdsPublisher(self, writer, on_readers)
        self._watcher.watch(
            writer,
            DDSStatus.PublicationMatched,
            lambda: self._bridge.post(DdsPublisher.count, publisher),
        )
        self._add(publisher)
        return publisher

    def subscribe(self, topic: str, type: str, qos: Qos, handle: OnReceived) -> Close:
        """Call `handle` for each message; up to `qos.depth` newest ones wait for a busy loop."""
        reader = DataReader(
            self._participant, self._topic(topic, type), dds_qos(qos, self.types.hash(type))
        )
        subscriber = DdsSubscriber(self, reader, qos.depth, handle)
        self._listen(reader, subscriber.take)
        self._add(subscriber)
        return subscriber.close

    def serve(self, service: str, type: str, handle: Answer) -> Close:
        """Answer requests of a service, each in a task of its own."""
        name = absolute(service, self.link.namespace)
        server = self._services.serve(name, self._service_type(type), handle)
        self._publish_graph_soon()

        def close() -> None:
            server.close()
            self._publish_graph_soon()

        return close

    async def call(self, service: str, type: str, request: bytes, timeout_s: float) -> bytes:
        """Return the response of the service's server, waiting for it to appear."""
        name = absolute(service, self.link.namespace)
        self._publish_graph_soon()
        return await self._services.call(name, self._service_type(type), request, timeout_s)

    def endpoints(self) -> tuple[GraphEndpoint, ...]:
        """Return the endpoints of all nodes in the domain."""
        return self._graph.endpoints()

    def nodes(self) -> tuple[str, ...]:
        """Return the names of all nodes in the domain."""
        return self._graph.nodes()

    def remove(self, endpoint: DdsPublisher | DdsSubscriber, entity: Entity) -> None:
        """Delete an endpoint in another thread, because a writer waits for its readers."""
        if self._closed:  # it was deleted with the participant
            return
        self._endpoints.remove(endpoint)
        self._watcher.forget(entity)
        self._loop.run_in_executor(None, _delete, entity)
        self._publish_graph_soon()

    def _open(self) -> None:
        if self.link.localhost:
            self._references += _localhost(self.link.domain)
        qos = DdsQos(Policy.Userdata(b"enclave=/;"))
        self._participant = DomainParticipant(self.link.domain, qos)
        self._watcher = _StatusWatcher(self._participant)
        guid = self._participant.guid.bytes
        self._graph = DdsGraph(
            self._info, frozenset({guid[:12], self._services.participant.data.prefix})
        )
        self._watch(BuiltinTopicDcpsParticipant, self._graph.participant)
        self._watch(BuiltinTopicDcpsPublication, lambda s: self._graph.endpoint(s, True))
        self._watch(BuiltinTopicDcpsSubscription, lambda s: self._graph.endpoint(s, False))
        topic = Topic(self._participant, INFO_TOPIC, self._info_idl.struct(INFO_TYPE))
        hash = self.types.hash(INFO_TYPE)
        self._info_writer = DataWriter(self._participant, topic, dds_qos(INFO_QOS, hash, own=True))
        qos = dds_qos(INFO_QOS, hash, keep_all=True, own=True)
        reader = DataReader(self._participant, topic, qos)
        self._listen(reader, DdsSubscriber(self, reader, MAX_DEPTH, self._on_discovery).take)
        self._references += [topic, reader]
        self._publish_graph()

    def _watch(self, topic: Any, on_sample: Callable[[Any], None]) -> None:
        """Call `on_sample` for each sample of a built-in topic, which lists DDS entities."""
        reader = BuiltinDataReader(self._participant, topic)

        def read() -> bool:
            try:
                taken = reader.take(MAX_DEPTH)
            except Exception as error:  # noqa: BLE001 - a bad name raises a plain Exception
                self.counts["malformed endpoint"] += 1
                log.debug("an endpoint cannot be read: %s", error)
                return False
            for sample in taken:
                on_sample(sample)
            return len(taken) == MAX_DEPTH

        self._listen(reader, read)
        self._references.append(reader)

    def _listen(self, reader: Entity, read: Callable[[], bool]) -> None:
        """Call `read` in the loop when a reader has data, and again while it returns True."""
        self._watcher.watch(reader, DDSStatus.DataAvailable, _PendingCall(self._bridge, read))

    def _on_discovery(self, received: Received) -> None:
        try:
            self._graph.update(received.payload)
        except BadPayload as error:
            self.counts["malformed discovery"] += 1
            log.debug("%s", error)

    def _topic(self, topic: str, type: str) -> Any:
        name = f"rt{absolute(topic, self.link.namespace)}"
        if (name, type) not in self._topics:
            self._topics[name, type] = Topic(self._participant, name, self._idl.struct(type))
        return self._topics[name, type]

    def _service_type(self, type: str) -> ServiceType:
        halves = self.types.hash(f"{type}_Request"), self.types.hash(f"{type}_Response")
        return ServiceType(type, *halves)

    def _add(self, endpoint: DdsPublisher | DdsSubscriber) -> None:
        self._endpoints.append(endpoint)
        self._publish_graph_soon()

    def _publish_graph_soon(self) -> None:
        """Announce our endpoints to other nodes in the next turn of the loop."""
        if not self._publishing:
            self._publishing = True
            self._loop.call_soon(self._publish_graph)

    def _publish_graph(self) -> None:
        self._publishing = False
        if self._closed:
            return
        readers, writers = self._services.gids()
        readers += [each.gid for each in self._endpoints if isinstance(each, DdsSubscriber)]
        writers += [each.gid for each in self._endpoints if isinstance(each, DdsPublisher)]
        payload = self._info.encode(
            self._participant.guid.bytes, self.link.namespace, self.link.node, readers, writers
        )
        ddspy_write(self._info_writer._ref, payload)


class _PendingCall:
    """Posts a call to the loop, from any thread, unless the call is already pending.

    Posts it again if the function returns True.
    """

    def __init__(self, bridge: Bridge, function: Callable[[], bool]) -> None:
        self._bridge, self._function = bridge, function
        self._posted = False

    def __call__(self) -> None:
        if not self._posted:
            self._posted = True
            self._bridge.post(_PendingCall._run, self)

    def _run(self) -> None:
        self._posted = False  # before reading, so that data that arrive from now on post a new call
        if self._function():
            self()


def dds_qos(qos: Qos, hash: str, *, keep_all: bool = False, own: bool = False) -> DdsQos:
    """Return cyclonedds's policies; `own`: an endpoint also matches those of its participant."""
    return DdsQos(
        Policy.Reliability.Reliable(duration(milliseconds=BLOCKING_MS))
        if qos.reliable
        else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if qos.transient_local else Policy.Durability.Volatile,
        Policy.History.KeepAll if keep_all else Policy.History.KeepLast(qos.depth),
        Policy.DurabilityService(0, Policy.History.KeepLast(qos.depth), -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.IgnoreLocal.Nothing if own else Policy.IgnoreLocal.Participant,
        Policy.Userdata(f"typehash={hash};".encode()),
    )


def _delete(entity: Any) -> None:
    """Delete an entity and its children, even if references to them remain."""
    entity._delete(entity._ref)


def _localhost(domain: int) -> list[Entity]:
    """Restrict a domain to this host, unless this process has already joined it."""
    try:
        return [Domain(domain, LOCALHOST)]
    except DDSException as error:
        if error.code != DDSException.DDS_RETCODE_PRECONDITION_NOT_MET:
            raise
        log.debug("DDS domain %d is open already: %s", domain, error)
        return []
