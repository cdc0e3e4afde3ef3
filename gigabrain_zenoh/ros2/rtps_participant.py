"""A DDS participant for services, as a state machine without sockets or clocks.

It announces itself, discovers the other participants (SPDP) and their endpoints (SEDP), and matches
those with its own. Source: OMG DDSI-RTPS 2.3, chapter 8.5. Data of a participant are accepted only
from an address that it announces, so that no host can make it send to a third one.
"""

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field

from gigabrain_zenoh.ros2.rtps_discovery import (
    HAS_PUBLICATIONS_READER,
    HAS_PUBLICATIONS_WRITER,
    HAS_SUBSCRIPTIONS_READER,
    HAS_SUBSCRIPTIONS_WRITER,
    MAX_PARTICIPANTS,
    PARTICIPANT,
    PUBLICATIONS_READER,
    PUBLICATIONS_WRITER,
    SPDP_READER,
    SPDP_WRITER,
    SUBSCRIPTIONS_READER,
    SUBSCRIPTIONS_WRITER,
    Address,
    EndpointData,
    ParticipantData,
    choose_address,
    decode_endpoint,
    decode_participant,
)
from gigabrain_zenoh.ros2.rtps_reader import ReliableReader
from gigabrain_zenoh.ros2.rtps_wire import (
    DISPOSED,
    UNKNOWN_ENTITY,
    AckNack,
    BadMessage,
    Data,
    DataFragments,
    Gap,
    Heartbeat,
    HeartbeatFragments,
    NackFragments,
    Submessage,
    decode_message,
    encode_message,
)
from gigabrain_zenoh.ros2.rtps_writer import ReliableWriter

LEASE_S, ANNOUNCE_PERIOD_S = 10.0, 2.0
EARLY_ANNOUNCEMENTS, EARLY_PERIOD_S = 5, 0.1  # after the start
MIN_LEASE_S, MAX_LEASE_S = 1.0, 300.0  # limits for the leases of others
MAX_REMOTES, MAX_ENDPOINTS, MAX_ALL_ENDPOINTS = 512, 2048, 20_000  # endpoints of one, and of all
SERVICE_TOPICS = ("rq/", "rr/")  # endpoints of other topics are ignored
MIN_TICK_S, MAX_TICK_S = 0.01, 0.1


@dataclass(slots=True, eq=False)
class Remote:
    """Another participant."""

    data: ParticipantData
    payload: bytes  # its newest announcement
    builtin: Address  # destination of discovery data
    user: Address  # destination of samples
    received_s: float  # time of its newest datagram
    endpoints: dict[bytes, EndpointData] = field(default_factory=dict)


class Participant:
    """Our participant. `send` sends a datagram to an address, `announce` to all participants."""

    def __init__(
        self,
        data: ParticipantData,
        send: Callable[[bytes, Address], None],
        announce: Callable[[bytes], None],
        unix_ns: Callable[[], int],
    ) -> None:
        """Create a participant that listens at the addresses of `data`."""
        self.data, self.own = data, frozenset[str]()
        self.remotes: dict[bytes, Remote] = {}
        self.writers: dict[bytes, tuple[ReliableWriter, EndpointData]] = {}
        self.readers: dict[bytes, tuple[ReliableReader, EndpointData]] = {}
        self._out, self._announce, self._unix_ns = send, announce, unix_ns
        self._announced, self._next_s, self._now, self._entities = 0, 0.0, 0.0, 0
        self._sequence, self._endpoints = 1, 0  # endpoints of all remote participants
        self._builtin_writers = {
            entity: ReliableWriter(entity, self.send, transient_local=True)
            for entity in (PUBLICATIONS_WRITER, SUBSCRIPTIONS_WRITER)
        }
        self._builtin_readers = {
            entity: ReliableReader(entity, self.send, self._on_endpoint)
            for entity in (PUBLICATIONS_READER, SUBSCRIPTIONS_READER)
        }

    def move(self, data: ParticipantData, own: Collection[str]) -> None:
        """Set our data and the addresses of this host; announce the data if they changed."""
        if data != self.data:
            self.data, self._sequence, self._next_s = data, self._sequence + 1, 0.0
        self.own = frozenset(own)

    def next_entity(self, kind: int) -> bytes:
        """Return the entity id of a new endpoint; `kind` is WRITER_KIND or READER_KIND."""
        self._entities += 1
        return self._entities.to_bytes(3, "big") + bytes((kind,))

    def send(self, to: bytes, address: Address, submessages: Iterable[Submessage]) -> None:
        """Send submessages to the participant with the prefix `to`."""
        self._out(encode_message(self.data.prefix, to, submessages, self._unix_ns()), address)

    def add_writer(self, writer: ReliableWriter, data: EndpointData, now: float) -> None:
        """Add and announce a writer."""
        self.writers[writer.entity] = writer, data
        self._announce_endpoint(PUBLICATIONS_WRITER, data, now)
        self._match_all(data, now)

    def add_reader(self, reader: ReliableReader, data: EndpointData, now: float) -> None:
        """Add and announce a reader."""
        self.readers[reader.entity] = reader, data
        self._announce_endpoint(SUBSCRIPTIONS_WRITER, data, now)
        self._match_all(data, now)

    def remove(self, entity: bytes, now: float) -> None:
        """Remove an endpoint, and announce its end."""
        _, data = self.writers.pop(entity, None) or self.readers.pop(entity)
        builtin = PUBLICATIONS_WRITER if data.is_writer else SUBSCRIPTIONS_WRITER
        self._builtin_writers[builtin].write(data.encode_key(), now, status=DISPOSED, key=data.guid)

    def receive(self, datagram: bytes, source: str, now: float) -> None:
        """Process a datagram. Malformed content is ignored."""
        self._now = now
        try:
            message = decode_message(datagram, self.data.prefix)
        except BadMessage:
            return
        if message.prefix == self.data.prefix:
            return
        for submessage in message.submessages:
            if isinstance(submessage, Data) and submessage.writer == SPDP_WRITER:
                self._on_participant(message.prefix, message.vendor, submessage, source)
                continue
            remote = self.remotes.get(message.prefix)
            if remote is None or not self._announces(remote.data, source):
                return
            remote.received_s = now
            self._dispatch(message.prefix, submessage)

    def tick(self, now: float) -> float:
        """Drop expired participants, send due messages; return the time to the next tick [s]."""
        self._now = now
        for prefix, remote in list(self.remotes.items()):
            lease = min(max(remote.data.lease_s, MIN_LEASE_S), MAX_LEASE_S)
            if now - remote.received_s > lease:
                self._forget(prefix)
        if now >= self._next_s:
            self._announced += 1
            early = self._announced <= EARLY_ANNOUNCEMENTS
            self._next_s = now + (EARLY_PERIOD_S if early else ANNOUNCE_PERIOD_S)
            self._announce(self._announcement(b""))
        writers = [*self._builtin_writers.values(), *(each for each, _ in self.writers.values())]
        readers = [*self._builtin_readers.values(), *(each for each, _ in self.readers.values())]
        due = [*(each.tick(now) for each in writers), *(each.tick(now) for each in readers)]
        return min(max(MIN_TICK_S, min(self._next_s, *due) - now), MAX_TICK_S)

    def leave(self) -> None:
        """Announce the end of this participant to all others."""
        key = self.data.prefix + PARTICIPANT
        disposal = Data(
            SPDP_READER,
            SPDP_WRITER,
            self._sequence + 1,
            self.data.encode_key(),
            status=DISPOSED,
            key=key,
        )
        self._announce(encode_message(self.data.prefix, b"", [disposal], self._unix_ns()))
        for prefix, remote in self.remotes.items():
            self.send(prefix, remote.builtin, [disposal])
        self.remotes.clear()

    def _announcement(self, to: bytes) -> bytes:
        data = Data(SPDP_READER, SPDP_WRITER, self._sequence, self.data.encode())
        return encode_message(self.data.prefix, to, [data], self._unix_ns())

    def _announce_endpoint(self, builtin: bytes, data: EndpointData, now: float) -> None:
        self._builtin_writers[builtin].write(data.encode(), now, key=data.guid)

    def _announces(self, data: ParticipantData, source: str) -> bool:
        """Return whether a participant announces an address on the host `source`."""
        return choose_address((*data.builtin, *data.user), source, self.own) is not None

    def _on_participant(self, prefix: bytes, vendor: bytes, sample: Data, source: str) -> None:
        remote = self.remotes.get(prefix)
        if sample.status:
            if remote and self._announces(remote.data, source):
                self._forget(prefix)
            return
        if remote and remote.payload == sample.payload and self._announces(remote.data, source):
            remote.received_s = self._now
            return
        try:
            data = decode_participant(sample.payload, vendor)
        except BadMessage:
            return
        builtin = choose_address(data.builtin, source, self.own)
        user = choose_address(data.user, source, self.own)
        if data.prefix != prefix or builtin is None or user is None:
            return
        if remote:
            remote.data, remote.payload, remote.received_s = data, sample.payload, self._now
            if remote.builtin not in data.builtin or remote.user not in data.user:
                remote.builtin, remote.user = builtin, user
                self._match_builtin(prefix, remote)
                for endpoint in remote.endpoints.values():
                    self._match(endpoint, remote)
        elif len(self.remotes) < MAX_REMOTES and self._count_on_host(builtin[0]) < MAX_PARTICIPANTS:
            self.remotes[prefix] = remote = Remote(data, sample.payload, builtin, user, self._now)
            self._out(self._announcement(prefix), builtin)
            self._match_builtin(prefix, remote)

    def _count_on_host(self, host: str) -> int:
        return sum(remote.builtin[0] == host for remote in self.remotes.values())

    def _has_room(self, remote: Remote) -> bool:
        return len(remote.endpoints) < MAX_ENDPOINTS and self._endpoints < MAX_ALL_ENDPOINTS

    def _match_builtin(self, prefix: bytes, remote: Remote) -> None:
        endpoints, address, now = remote.data.endpoints, remote.builtin, self._now
        if endpoints & HAS_PUBLICATIONS_READER:
            writer = self._builtin_writers[PUBLICATIONS_WRITER]
            writer.match(prefix + PUBLICATIONS_READER, address, now)
        if endpoints & HAS_SUBSCRIPTIONS_READER:
            writer = self._builtin_writers[SUBSCRIPTIONS_WRITER]
            writer.match(prefix + SUBSCRIPTIONS_READER, address, now)
        if endpoints & HAS_PUBLICATIONS_WRITER:
            reader = self._builtin_readers[PUBLICATIONS_READER]
            reader.match(prefix + PUBLICATIONS_WRITER, address, now)
        if endpoints & HAS_SUBSCRIPTIONS_WRITER:
            reader = self._builtin_readers[SUBSCRIPTIONS_READER]
            reader.match(prefix + SUBSCRIPTIONS_WRITER, address, now)

    def _dispatch(self, prefix: bytes, submessage: Submessage) -> None:
        if isinstance(submessage, AckNack | NackFragments):
            writer = self._builtin_writers.get(submessage.writer)
            if writer is None and (found := self.writers.get(submessage.writer)):
                writer = found[0]
            if writer is None:
                return
            if isinstance(submessage, AckNack):
                writer.on_acknack(prefix + submessage.reader, submessage, self._now)
            else:
                writer.on_nack_fragments(prefix + submessage.reader, submessage, self._now)
            return
        guid = prefix + submessage.writer
        for reader in self._readers_for(submessage.reader, guid):
            _pass_to_reader(reader, guid, submessage, self._now)

    def _readers_for(self, entity: bytes, writer: bytes) -> list[ReliableReader]:
        if entity == UNKNOWN_ENTITY:
            own = (each for each, _ in self.readers.values())
            readers = [*self._builtin_readers.values(), *own]
            return [each for each in readers if writer in each.writers]
        if found := self._builtin_readers.get(entity):
            return [found]
        return [self.readers[entity][0]] if entity in self.readers else []

    def _on_endpoint(self, writer: bytes, sample: Data) -> None:
        remote = self.remotes.get(writer[:12])
        if remote is None:
            return
        try:
            guid = sample.key or decode_endpoint(sample.payload).guid
            endpoint = None if sample.status else decode_endpoint(sample.payload)
        except BadMessage:
            return
        if guid[:12] != writer[:12]:
            return
        known = remote.endpoints.get(guid)
        if known and known != endpoint:
            del remote.endpoints[guid]
            self._endpoints -= 1
            self._unmatch(guid)
        if endpoint is None or endpoint == known or endpoint.guid != guid:
            return
        if endpoint.topic.startswith(SERVICE_TOPICS) and self._has_room(remote):
            remote.endpoints[guid] = endpoint
            self._endpoints += 1
            self._match(endpoint, remote)

    def _match_all(self, data: EndpointData, now: float) -> None:
        self._now = now
        for remote in self.remotes.values():
            for endpoint in remote.endpoints.values():
                if data.matches(endpoint):
                    self._match(endpoint, remote)

    def _match(self, endpoint: EndpointData, remote: Remote) -> None:
        allowed = (*remote.data.user, *remote.data.builtin)
        hosts = {host for host, _ in allowed}
        listed = [each for each in endpoint.locators if each[0] in hosts]
        address = choose_address(listed, remote.user[0], self.own) or remote.user
        if endpoint.is_writer:
            for reader, data in self.readers.values():
                if data.matches(endpoint):
                    reader.match(endpoint.guid, address, self._now)
        else:
            for writer, data in self.writers.values():
                if data.matches(endpoint):
                    writer.match(endpoint.guid, address, self._now)

    def _unmatch(self, guid: bytes) -> None:
        for writer, _ in self.writers.values():
            writer.unmatch(guid)
        for reader, _ in self.readers.values():
            reader.unmatch(guid)

    def _forget(self, prefix: bytes) -> None:
        remote = self.remotes.pop(prefix)
        self._endpoints -= len(remote.endpoints)
        for guid in remote.endpoints:
            self._unmatch(guid)
        for entity, writer in self._builtin_writers.items():
            writer.unmatch(prefix + _COUNTERPARTS[entity])
        for entity, reader in self._builtin_readers.items():
            reader.unmatch(prefix + _COUNTERPARTS[entity])


_COUNTERPARTS = {
    PUBLICATIONS_WRITER: PUBLICATIONS_READER,
    PUBLICATIONS_READER: PUBLICATIONS_WRITER,
    SUBSCRIPTIONS_WRITER: SUBSCRIPTIONS_READER,
    SUBSCRIPTIONS_READER: SUBSCRIPTIONS_WRITER,
}


def _pass_to_reader(
    reader: ReliableReader, guid: bytes, submessage: Submessage, now: float
) -> None:
    if isinstance(submessage, Data):
        reader.on_data(guid, submessage, now)
    elif isinstance(submessage, DataFragments):
        reader.on_fragments(guid, submessage, now)
    elif isinstance(submessage, Heartbeat):
        reader.on_heartbeat(guid, submessage, now)
    elif isinstance(submessage, HeartbeatFragments):
        reader.on_heartbeat_fragments(guid, submessage, now)
    elif isinstance(submessage, Gap):
        reader.on_gap(guid, submessage, now)
