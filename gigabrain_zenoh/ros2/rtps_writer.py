"""Reliable writer of RTPS, as a state machine without sockets or clocks.

Source: OMG DDSI-RTPS 2.3, chapter 8.4. Times are in seconds of any one clock. All memory is
bounded, whatever a peer sends; a reader gets no more than the samples that it asked for.
"""

import itertools
import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from gigabrain_zenoh.ros2.rtps_discovery import Address
from gigabrain_zenoh.ros2.rtps_wire import (
    UNKNOWN_ENTITY,
    WINDOW,
    AckNack,
    Data,
    DataFragments,
    Gap,
    Heartbeat,
    NackFragments,
    Sample,
    Submessage,
)

Send = Callable[[bytes, Address, Iterable[Submessage]], None]  # to a prefix at an address

FRAGMENT_BYTES = 16_384  # of a sample that is longer than one datagram may be
MAX_WHOLE_BYTES = 32_768
MAX_HISTORY, MAX_HISTORY_BYTES = 512, 8 << 20  # of a writer
HISTORY_S = 5.0  # a sample waits so long for a reader that is not there yet
FIRST_HEARTBEAT_S, SLOWEST_HEARTBEAT_S = 0.05, 2.0
RESEND_S = 0.01  # one sample is not sent again to one reader within this time
MAX_RESEND_BYTES = 1 << 18  # in answer to one datagram; a reader that lacks more asks again


@dataclass(slots=True, eq=False)
class _Written:
    """A sample in a writer's history."""

    data: Data
    target: bytes  # beginning of the GUIDs of its readers: empty for all
    at_s: float


@dataclass(slots=True, eq=False)
class _Reader:
    """A remote reader, as its writer knows it."""

    guid: bytes
    address: Address
    start: int  # first sample that concerns it, except those for it alone
    announced: int  # it knows about all samples up to this one
    acked: int = 0  # it has all samples below this one
    last: int = 0  # the newest sample for it
    answered: bool = False  # it has sent an ACKNACK
    wait_s: float = FIRST_HEARTBEAT_S
    due_s: float = 0.0
    sent_s: dict[int, float] = field(default_factory=dict)

    @property
    def waits(self) -> bool:
        return self.acked <= self.last or not self.answered


class ReliableWriter:
    """A writer whose samples go to all matched readers, or to those with a given GUID.

    With `transient_local`, readers that come later get all samples; a sample with a key replaces
    the older one with the same key.
    """

    def __init__(self, entity: bytes, send: Send, *, transient_local: bool = False) -> None:
        """Create a writer with an entity id."""
        self.entity = entity
        self.readers: dict[bytes, _Reader] = {}
        self._send, self._transient_local = send, transient_local
        self._history: dict[int, _Written] = {}
        self._bytes = self._last = self._serial = 0

    def match(self, guid: bytes, address: Address, now: float) -> None:
        """Add a remote reader, or change its address."""
        if known := self.readers.get(guid):
            known.address = address
            return
        start = 1 if self._transient_local else self._last + 1
        reader = _Reader(guid, address, start, announced=0, due_s=now + FIRST_HEARTBEAT_S)
        self.readers[guid] = reader
        mine = [one for one in self._history.values() if self._concerns(one, reader)]
        reader.last = mine[-1].data.seq if mine else 0
        self._deliver(reader, mine, now)

    def unmatch(self, guid: bytes) -> None:
        """Remove a remote reader."""
        self.readers.pop(guid, None)

    def write(
        self,
        payload: bytes,
        now: float,
        *,
        related: Sample | None = None,
        target: bytes = b"",
        status: int = 0,
        key: bytes = b"",
    ) -> int:
        """Send a sample; return its sequence number."""
        self._last += 1
        data = Data(UNKNOWN_ENTITY, self.entity, self._last, payload, related, status, key)
        if key and self._transient_local:
            for seq in [seq for seq, one in self._history.items() if one.data.key == key]:
                self._forget(seq)
        self._history[self._last] = written = _Written(data, target, now)
        self._bytes += len(payload)
        while len(self._history) > MAX_HISTORY or self._bytes > MAX_HISTORY_BYTES:
            self._forget(next(iter(self._history)))
        for reader in self._readers_of(target):
            reader.last = self._last
            reader.wait_s, reader.due_s = FIRST_HEARTBEAT_S, now + FIRST_HEARTBEAT_S
            self._deliver(reader, [written], now)
        return self._last

    def on_acknack(self, guid: bytes, ack: AckNack, now: float) -> None:
        """Send a reader what it asks for."""
        reader = self.readers.get(guid)
        if reader is None:
            return
        reader.answered = True
        base = min(ack.base, self._last + 1)
        reader.acked = max(reader.acked, base)
        if not self._transient_local:
            self._forget_acked(reader)
        asked = [seq for seq in ack.missing if 0 < seq <= self._last]
        wanted, absent, size = [], [], 0
        for seq in asked:
            one = self._history.get(seq)
            if one is None or not self._concerns(one, reader):
                absent.append(seq)
            elif now - reader.sent_s.get(seq, -1.0) >= RESEND_S and size < MAX_RESEND_BYTES:
                wanted.append(one)
                size += len(one.data.payload)
        if absent:
            self._to(reader, [self._gap(reader, absent[0], absent)])
        if wanted:
            self._deliver(reader, wanted, now)
        elif not asked and not ack.final:
            has_all = base > max(reader.last, reader.announced)
            self._to(reader, [self._heartbeat(reader, final=has_all)])

    def on_nack_fragments(self, guid: bytes, nack: NackFragments, now: float) -> None:
        """Send fragments again."""
        reader, one = self.readers.get(guid), self._history.get(nack.seq)
        if reader is None or one is None or not self._concerns(one, reader):
            return
        if now - reader.sent_s.get(nack.seq, -1.0) < RESEND_S:
            return
        reader.sent_s[nack.seq] = now
        parts = _fragments(one.data, reader.guid[12:])
        wanted = (part for part in parts if part.first in nack.missing)
        for part in itertools.islice(wanted, MAX_RESEND_BYTES // FRAGMENT_BYTES):
            self._to(reader, [part])
        self._to(reader, [self._heartbeat(reader)])

    def tick(self, now: float) -> float:
        """Send heartbeats that are due; return when the next one is due."""
        due = math.inf
        for reader in self.readers.values():
            if not reader.waits:
                continue
            if now >= reader.due_s:
                reader.wait_s = min(2 * reader.wait_s, SLOWEST_HEARTBEAT_S)
                reader.due_s = now + reader.wait_s
                self._to(reader, [self._heartbeat(reader)])
            due = min(due, reader.due_s)
        if not self._transient_local:
            for seq in [s for s, one in self._history.items() if now - one.at_s > HISTORY_S]:
                if not self._readers_of(self._history[seq].target):
                    self._forget(seq)
        return due

    @property
    def pending(self) -> int:
        """Number of samples that are kept."""
        return len(self._history)

    def _concerns(self, one: _Written, reader: _Reader) -> bool:
        late = one.data.seq < reader.start and len(one.target) < 16
        return reader.guid.startswith(one.target) and not late

    def _readers_of(self, target: bytes) -> list[_Reader]:
        if len(target) == 16:
            reader = self.readers.get(target)
            return [reader] if reader else []
        return [one for guid, one in self.readers.items() if guid.startswith(target)]

    def _forget(self, seq: int) -> None:
        self._bytes -= len(self._history.pop(seq).data.payload)
        for reader in self.readers.values():
            reader.sent_s.pop(seq, None)

    def _forget_acked(self, reader: _Reader) -> None:
        for seq in [seq for seq in self._history if seq < reader.acked]:
            target = self._history[seq].target
            if reader.guid.startswith(target) and all(
                seq < one.acked for one in self._readers_of(target)
            ):
                self._forget(seq)

    def _deliver(self, reader: _Reader, samples: Iterable[_Written], now: float) -> None:
        """Send samples in as few datagrams as possible, the last one with a heartbeat."""
        batch: list[Submessage] = []
        size, entity = 0, reader.guid[12:]
        for one in samples:
            data = one.data._replace(reader=entity)
            if data.seq > reader.announced + 1 and not self._transient_local:
                batch.append(Gap(entity, self.entity, reader.announced + 1, data.seq))
            reader.announced = max(reader.announced, data.seq)
            reader.sent_s[data.seq] = now
            if len(data.payload) > MAX_WHOLE_BYTES:
                for part in _fragments(data, entity):
                    self._to(reader, [part])
                continue
            if batch and (size + len(data.payload) > MAX_WHOLE_BYTES or len(batch) > 16):
                self._to(reader, batch)
                batch, size = [], 0
            batch.append(data)
            size += len(data.payload) + 100
        self._to(reader, [*batch, self._heartbeat(reader)])

    def _heartbeat(self, reader: _Reader, *, final: bool = False) -> Heartbeat:
        self._serial += 1
        last = max(reader.last, reader.announced)
        mine = (s for s, one in self._history.items() if s <= last and self._concerns(one, reader))
        first = min(mine, default=last + 1)
        return Heartbeat(reader.guid[12:], self.entity, first, last, self._serial, final)

    def _gap(self, reader: _Reader, start: int, absent: list[int]) -> Gap:
        base = start
        while base in absent:
            base += 1
        others = tuple(seq for seq in absent if base <= seq < base + WINDOW)
        return Gap(reader.guid[12:], self.entity, start, base, others)

    def _to(self, reader: _Reader, submessages: Iterable[Submessage]) -> None:
        self._send(reader.guid[:12], reader.address, submessages)


def _fragments(data: Data, entity: bytes) -> Iterable[DataFragments]:
    total = len(data.payload)
    for number, at in enumerate(range(0, total, FRAGMENT_BYTES), 1):
        part = data.payload[at : at + FRAGMENT_BYTES]
        yield DataFragments(
            entity, data.writer, data.seq, number, 1, FRAGMENT_BYTES, total, part, data.related
        )
