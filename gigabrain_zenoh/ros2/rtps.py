"""Services over DDS, compatible with rmw_fastrtps and rmw_cyclonedds of ROS 2.

A service is two topics: requests `rq/<name>Request` and replies `rr/<name>Reply`. A reply names
its request: in the inline QoS of the sample (rmw_fastrtps), or in 16 bytes before the payload
(rmw_cyclonedds). The library of Cyclone DDS cannot write that inline QoS, so services have a
separate participant, implemented here.
"""

import asyncio
import itertools
import logging
import secrets
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

from gigabrain_zenoh.errors import BusError, ConfigError, GigabrainError, NoAnswer
from gigabrain_zenoh.logs import QuietFault
from gigabrain_zenoh.ros2.rtps_discovery import (
    MAX_DOMAIN,
    READER_KIND,
    WRITER_KIND,
    EndpointData,
    ParticipantData,
    service_topics,
    service_types,
)
from gigabrain_zenoh.ros2.rtps_participant import LEASE_S, Participant
from gigabrain_zenoh.ros2.rtps_reader import ReliableReader
from gigabrain_zenoh.ros2.rtps_sockets import Sockets
from gigabrain_zenoh.ros2.rtps_wire import VENDOR_CYCLONE, VENDOR_UNKNOWN, Data, Sample
from gigabrain_zenoh.ros2.rtps_writer import ReliableWriter
from gigabrain_zenoh.ros2.transport import Answer

log = logging.getLogger(__name__)

MAX_RUNNING = 64  # requests of one service in progress; further ones are dropped
ENCAPSULATION_BYTES, CYCLONE_HEADER_BYTES = 4, 16
REFRESH_S = 2.0  # period of reading this host's addresses
READY_S = 1.0  # after this time, a request is sent even if no server is confirmed as ready
POLL_S = 0.01


class ServiceType(NamedTuple):
    """A service type, with the ROS hashes of its two messages; empty if unknown."""

    name: str  # "std_srvs/srv/SetBool"
    request_hash: str = ""  # "RIHS01_..."
    reply_hash: str = ""


class RequestReply:
    """A participant for services. Create it by `open`, and `close` it at the end."""

    def __init__(self, sockets: Sockets, enclave: str) -> None:
        """Create a participant without open sockets; use `open` instead."""
        self._sockets, self._enclave = sockets, enclave
        self._prefix = VENDOR_UNKNOWN + secrets.token_bytes(10)
        self.participant = Participant(
            self._data([]), self._sockets.send, self._sockets.announce, time.time_ns
        )
        self._servers: dict[str, Server] = {}
        self._clients: dict[tuple[str, ServiceType], _Client] = {}
        self._ticking: asyncio.Task[None] | None = None

    @classmethod
    async def open(
        cls,
        domain: int,
        *,
        localhost: bool = False,
        peers: Sequence[str] = (),
        enclave: str = "/",
    ) -> Self:
        """Open a participant of a DDS domain. Raises BusError, ConfigError.

        With `localhost`, it communicates only with participants of this host, without multicast.
        `peers` are IPv4 addresses of hosts that multicast does not reach.
        """
        if not 0 <= domain <= MAX_DOMAIN:
            raise ConfigError(f"domain: expected 0 to {MAX_DOMAIN}, got {domain}")
        participant = cls(Sockets(domain, localhost=localhost, peers=peers), enclave)
        try:
            await participant._sockets.open(participant._receive)
        except BaseException:
            participant._sockets.close()
            raise
        participant._refresh()
        participant._ticking = asyncio.create_task(participant._tick())
        participant._ticking.add_done_callback(_report)
        return participant

    async def close(self) -> None:
        """Announce the end to all participants, and close the sockets. May be called twice."""
        if self._ticking:
            self._ticking.cancel()
            await asyncio.wait([self._ticking])
            self._ticking = None
            self.participant.leave()
        for server in list(self._servers.values()):
            server.cancel()
        self._servers.clear()
        for client in self._clients.values():
            client.fail("the participant was closed")
        self._clients.clear()
        self._sockets.close()

    def serve(self, service: str, type_: ServiceType, handle: Answer) -> "Server":
        """Serve an absolute service name. Raises BusError if it is already served here."""
        if service in self._servers:
            raise BusError(f"{service}: this process has a server of that name already")
        server = Server(self, service, type_, handle)
        self._servers[service] = server
        return server

    async def call(
        self, service: str, type_: ServiceType, request: bytes, timeout_s: float
    ) -> bytes:
        """Return the first reply of a server. Raises NoAnswer after `timeout_s`."""
        if own := self._servers.get(service):
            return await own.ask(request, timeout_s)
        key = service, type_
        if key not in self._clients:
            self._clients[key] = _Client(self, service, type_)
        return await self._clients[key].call(request, timeout_s)

    def gids(self) -> tuple[list[bytes], list[bytes]]:
        """Return the GUIDs of all readers and writers, for `ros_discovery_info`."""
        readers = [data.guid for _, data in self.participant.readers.values()]
        return readers, [data.guid for _, data in self.participant.writers.values()]

    def add_pair(
        self,
        written: tuple[str, str, str],
        read: tuple[str, str, str],
        deliver: Callable[[bytes, Data], None],
    ) -> tuple[ReliableWriter, ReliableReader, bytes]:
        """Add a writer and a reader, each of (topic, type, hash); also return the reader's GUID."""
        participant, now = self.participant, time.monotonic()
        writer = ReliableWriter(participant.next_entity(WRITER_KIND), participant.send)
        reader = ReliableReader(participant.next_entity(READER_KIND), participant.send, deliver)
        guid = self._prefix + reader.entity
        participant.add_reader(reader, EndpointData(guid, *read[:2], type_hash=read[2]), now)
        data = EndpointData(self._prefix + writer.entity, *written[:2], type_hash=written[2])
        participant.add_writer(writer, data, now)
        return writer, reader, guid

    def forget(self, server: "Server") -> None:
        """Withdraw a server."""
        if self._servers.get(server.service) is server:
            del self._servers[server.service]
            for entity in server.entities:
                self.participant.remove(entity, time.monotonic())

    def is_cyclone(self, guid: bytes) -> bool:
        """Return whether the owner of an endpoint is Cyclone DDS."""
        remote = self.participant.remotes.get(guid[:12])
        return remote is not None and remote.data.vendor == VENDOR_CYCLONE

    def _data(self, hosts: Sequence[str]) -> ParticipantData:
        return ParticipantData(
            prefix=self._prefix,
            builtin=tuple((host, self._sockets.builtin_port) for host in hosts),
            user=tuple((host, self._sockets.user_port) for host in hosts),
            lease_s=LEASE_S,
            enclave=self._enclave,
        )

    def _refresh(self) -> None:
        hosts, own = self._sockets.refresh()
        self.participant.move(self._data(hosts), own)

    def _receive(self, datagram: bytes, source: str) -> None:
        self.participant.receive(datagram, source, time.monotonic())

    async def _tick(self) -> None:
        refreshed = time.monotonic()
        while True:
            now = time.monotonic()
            if now - refreshed >= REFRESH_S:
                refreshed = now
                self._refresh()
            await asyncio.sleep(self.participant.tick(now))


class Server:
    """A service that this process serves."""

    def __init__(self, bus: RequestReply, service: str, type_: ServiceType, handle: Answer) -> None:
        """Announce the service."""
        self.service, self.handle, self._bus = service, handle, bus
        self.dropped = 0  # requests beyond MAX_RUNNING
        self._running: set[asyncio.Task[None]] = set()
        self._fault = QuietFault(log)
        requests, replies = service_topics(service)
        request, reply = service_types(type_.name)
        self._writer, self._reader, _ = bus.add_pair(
            (replies, reply, type_.reply_hash),
            (requests, request, type_.request_hash),
            self._on_request,
        )
        self.entities = self._reader.entity, self._writer.entity

    @property
    def clients(self) -> int:
        """Number of matched clients."""
        return len(self._reader.writers)

    @property
    def pending(self) -> int:
        """Number of replies that a client has not acknowledged."""
        return self._writer.pending

    async def ask(self, request: bytes, timeout_s: float) -> bytes:
        """Return the reply to a request from this process. Raises NoAnswer."""
        try:
            async with asyncio.timeout(timeout_s):
                return await self.handle(request)
        except TimeoutError:
            raise NoAnswer(f"{self.service}: no reply within {timeout_s:g} s") from None

    def close(self) -> None:
        """Withdraw the service. Requests in progress get no reply."""
        self.cancel()
        self._bus.forget(self)

    def cancel(self) -> None:
        """Stop handling requests."""
        for task in self._running:
            task.cancel()

    def _on_request(self, writer: bytes, data: Data) -> None:
        if len(self._running) >= MAX_RUNNING:
            self.dropped += 1
            if self.dropped == 1:
                log.warning("%s: dropped a request: %d are running", self.service, MAX_RUNNING)
            return
        task = asyncio.create_task(self._answer(writer, data))
        self._running.add(task)
        task.add_done_callback(self._finish)

    async def _answer(self, writer: bytes, data: Data) -> None:
        request, header = data.payload, b""
        if self._bus.is_cyclone(writer):
            request, header = _take_header(request)
        reply = await self.handle(request)
        related = data.related.guid if data.related else bytes(16)
        # the request may name the client's reader; otherwise its writer identifies the client
        client = related if related[:12] == writer[:12] else writer
        target = client if related == client else writer[:12]
        if header:
            target, reply = writer[:12], _put_header(reply, header)
        now = time.monotonic()
        self._writer.write(reply, now, related=Sample(client, data.seq), target=target)

    def _finish(self, task: asyncio.Task[None]) -> None:
        self._running.discard(task)
        error = None if task.cancelled() else task.exception()
        if isinstance(error, GigabrainError):
            self._fault.begin(f"{self.service}: no answer: {error}", time.monotonic_ns())
        elif error:
            log.error("%s: a request got no reply", self.service, exc_info=error)
        else:
            self._fault.end(f"{self.service} answers again", time.monotonic_ns())


class _Client:
    """Calls one service."""

    def __init__(self, bus: RequestReply, service: str, type_: ServiceType) -> None:
        self._service, self._bus = service, bus
        self._waiting: dict[int, asyncio.Future[bytes]] = {}
        self._cyclone_numbers = itertools.count(1)
        requests, replies = service_topics(service)
        request, reply = service_types(type_.name)
        self._writer, self._reader, self._guid = bus.add_pair(
            (requests, request, type_.request_hash),
            (replies, reply, type_.reply_hash),
            self._on_reply,
        )
        self._guids = self._guid, self._guid[:12] + self._writer.entity  # replies name one of them

    async def call(self, request: bytes, timeout_s: float) -> bytes:
        """Send a request; return the first reply. Raises NoAnswer."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        numbers: list[int] = []
        try:
            async with asyncio.timeout(timeout_s):
                numbers = self._send(request, await self._servers(timeout_s))
                self._waiting.update(dict.fromkeys(numbers, future))
                return await future
        except TimeoutError:
            why = "no reply" if numbers else "no server"
            raise NoAnswer(
                f"{self._service}: {why} within {timeout_s:g} s; is its node running?"
            ) from None
        finally:
            for number in numbers:
                self._waiting.pop(number, None)

    def fail(self, why: str) -> None:
        """End all calls with NoAnswer."""
        for future in self._waiting.values():
            if not future.done():
                future.set_exception(NoAnswer(f"{self._service}: {why}"))

    async def _servers(self, timeout_s: float) -> list[bytes]:
        """Wait for servers that can reply; return the GUIDs of their readers."""
        started = time.monotonic()
        while True:
            writers = {guid[:12]: writer for guid, writer in self._reader.writers.items()}
            readers = self._writer.readers
            found = {guid: reader for guid, reader in readers.items() if guid[:12] in writers}
            ready = [g for g, each in found.items() if each.answered and writers[g[:12]].answered]
            late = time.monotonic() - started > min(READY_S, timeout_s / 2)
            if ready or (found and late):
                return ready or list(found)
            await asyncio.sleep(POLL_S)

    def _send(self, request: bytes, servers: list[bytes]) -> list[int]:
        now, related = time.monotonic(), Sample(self._guid, -1 << 32)
        numbers = []
        for guid in servers:
            payload = request
            if self._bus.is_cyclone(guid):
                number = next(self._cyclone_numbers)
                header = self._guid[4:12] + number.to_bytes(8, "little")
                payload = _put_header(request, header)
                numbers.append(-number)
            seq = self._writer.write(payload, now, related=related, target=guid)
            numbers.append(seq)
        return numbers

    def _on_reply(self, writer: bytes, data: Data) -> None:
        number, reply = 0, data.payload
        if self._bus.is_cyclone(writer):
            reply, header = _take_header(reply)
            if header[:8] == self._guid[4:12]:
                number = -int.from_bytes(header[8:], "little")
        elif data.related and data.related.guid in self._guids:
            number = data.related.seq
        future = self._waiting.get(number)
        if future and not future.done():
            future.set_result(reply)


def _report(ticking: asyncio.Task[None]) -> None:
    if not ticking.cancelled() and (error := ticking.exception()):
        log.error("services over DDS have stopped", exc_info=error)


def _take_header(payload: bytes) -> tuple[bytes, bytes]:
    """Split a payload of rmw_cyclonedds into (payload, header)."""
    end = ENCAPSULATION_BYTES + CYCLONE_HEADER_BYTES
    return payload[:ENCAPSULATION_BYTES] + payload[end:], payload[ENCAPSULATION_BYTES:end]


def _put_header(payload: bytes, header: bytes) -> bytes:
    return payload[:ENCAPSULATION_BYTES] + header + payload[ENCAPSULATION_BYTES:]
