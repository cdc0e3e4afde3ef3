"""Reliable writer of RTPS, as a state machine without sockets or clocks.

Source: OMG DDSI-RTPS 2.3, chapter 8.4. Times are in seconds of any monotonic clock. No peer can
make it use unbounded memory, or send more samples than requested.
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

Send = Callable[[bytes, Address, Iterable[Submessage]], None]  # (receiver's prefix, address, …)

FRAGMENT_BYTES = 16_384  # of a sample that is too long for one datagram
MAX_WHOLE_BYTES = 32_768  # longer samples are sent in fragments
MAX_HISTORY, MAX_HISTORY_BYTES = 512, 8 << 20  # of one writer
HISTORY_S = 5.0  # a sample without a reader is kept for this time
MIN_HEARTBEAT_S, MAX_HEARTBEAT_S = 0.05, 2.0  # period of heartbeats; it doubles
MIN_RESEND_S = 0.01  # minimum time before a sample is sent to the same reader again
MAX_RESEND_BYTES = 1 << 18  # in answer to one datagram; a reader then requests the rest


@dataclass(slots=True, eq=False)
class _Written:
    """A sample in a writer's history."""

    data: Data
    target: bytes  # for readers whose GUID begins with this; empty: for all
    written_s: float


@dataclass(slots=True, eq=False)
class _Reader:
    """A writer's state of one remote reader."""

    guid: bytes
    address: Address
    start: int  # the first sample for all readers that it receives
    announced: int  # samples up to this one were announced to it
    acked: int = 0  # samples below this one are acknowledged
    last: int = 0  # the newest sample for this reader
    answered: bool = False  # true: it has sent an ACKNACK
    wait_s: float = MIN_HEARTBEAT_S
    due_s: float = 0.0  # time of the next heartbeat
    sent_s: dict[int, float] = field(default_factory=dict)  # by sequence number

    @property
    def needs_heartbeat(self) -> bool:
        return self.acked <= self.last or not self.answered


class ReliableWriter:
    """A writer whose samples go to all matched readers, or to those with a given GUID.

    With `transient_local`, late readers receive the whole history, in which a sample replaces
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
        reader = _Reader(guid, address, start, announced=0, due_s=now + MIN_HEARTBEAT_S)
        self.readers[guid] = reader
        samples = [each for each in self._history.values() if self._is_for(each, reader)]
        reader.last = samples[-1].data.seq if samples else 0
        self._deliver(reader, samples, now)

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
            for seq in [seq for seq, each in self._history.items() if each.data.key == key]:
                self._forget(seq)
        self._history[self._last] = written = _Written(data, target, now)
        self._bytes += len(payload)
        while len(self._history) > MAX_HISTORY or self._bytes > MAX_HISTORY_BYTES:
            self._forget(next(iter(self._history)))
        for reader in self._readers_of(target):
            reader.last = self._last
            reader.wait_s, reader.due_s = MIN_HEARTBEAT_S, now + MIN_HEARTBEAT_S
            self._deliver(reader, [written], now)
        return self._last

    def on_acknack(self, guid: bytes, ack: AckNack, now: float) -> None:
        """Send the samples that a reader requests."""
        reader = self.readers.get(guid)
        if reader is None:
            return
        reader.answered = True
        base = min(ack.base, self._last + 1)
        reader.acked = max(reader.acked, base)
        if not self._transient_local:
            self._forget_acked(reader)
        requested = [seq for seq in ack.missing if 0 < seq <= self._last]
        samples, absent, size = [], [], 0
        for seq in requested:
            sample = self._history.get(seq)
            if sample is None or not self._is_for(sample, reader):
                absent.append(seq)
            elif now - reader.sent_s.get(seq, -1.0) >= MIN_RESEND_S and size < MAX_RESEND_BYTES:
                samples.append(sample)
                size += len(sample.data.payload)
        if absent:
            self._send_to(reader, [self._gap(reader, absent[0], absent)])
        if samples:
            self._deliver(reader, samples, now)
        elif not requested and not ack.final:
            has_all = base > max(reader.last, reader.announced)
            self._send_to(reader, [self._heartbeat(reader, final=has_all)])

    def on_nack_fragments(self, guid: bytes, nack: NackFragments, now: float) -> None:
        """Send requested fragments again."""
        reader, sample = self.readers.get(guid), self._history.get(nack.seq)
        if reader is None or sample is None or not self._is_for(sample, reader):
            return
        if now - reader.sent_s.get(nack.seq, -1.0) < MIN_RESEND_S:
            return
        reader.sent_s[nack.seq] = now
        parts = _fragments(sample.data, reader.guid[12:])
        wanted = (part for part in parts if part.first in nack.missing)
        for part in itertools.islice(wanted, MAX_RESEND_BYTES // FRAGMENT_BYTES):
            self._send_to(reader, [part])
        self._send_to(reader, [self._heartbeat(reader)])

    def tick(self, now: float) -> float:
        """Send due heartbeats; return the time of the next one."""
        due = math.inf
        for reader in self.readers.values():
            if not reader.needs_heartbeat:
                continue
            if now >= reader.due_s:
                reader.wait_s = min(2 * reader.wait_s, MAX_HEARTBEAT_S)
                reader.due_s = now + reader.wait_s
                self._send_to(reader, [self._heartbeat(reader)])
            due = min(due, reader.due_s)
        if not self._transient_local:
            for seq in [s for s, each in self._history.items() if now - each.written_s > HISTORY_S]:
                if not self._readers_of(self._history[seq].target):
                    self._forget(seq)
        return due

    @property
    def pending(self) -> int:
        """Number of samples in the history."""
        return len(self._history)

    def _is_for(self, sample: _Written, reader: _Reader) -> bool:
        late = sample.data.seq < reader.start and len(sample.target) < 16
        return reader.guid.startswith(sample.target) and not late

    def _readers_of(self, target: bytes) -> list[_Reader]:
        if len(target) == 16:
            reader = self.readers.get(target)
            return [reader] if reader else []
        return [each for guid, each in self.readers.items() if guid.startswith(target)]

    def _forget(self, seq: int) -> None:
        self._bytes -= len(self._history.pop(seq).data.payload)
        for reader in self.readers.values():
            reader.sent_s.pop(seq, None)

    def _forget_acked(self, reader: _Reader) -> None:
        for seq in [seq for seq in self._history if seq < reader.acked]:
            target = self._history[seq].target
            if reader.guid.startswith(target) and all(
                seq < each.acked for each in self._readers_of(target)
            ):
                self._forget(seq)

    def _deliver(self, reader: _Reader, samples: Iterable[_Written], now: float) -> None:
        """Send samples in as few datagrams as possible, and a heartbeat in the last one."""
        batch: list[Submessage] = []
        size, entity = 0, reader.guid[12:]
        for sample in samples:
            data = sample.data._replace(reader=entity)
            if data.seq > reader.announced + 1 and not self._transient_local:
                batch.append(Gap(entity, self.entity, reader.announced + 1, data.seq))
            reader.announced = max(reader.announced, data.seq)
            reader.sent_s[data.seq] = now
            if len(data.payload) > MAX_WHOLE_BYTES:
                for part in _fragments(data, entity):
                    self._send_to(reader, [part])
                continue
            if batch and (size + len(data.payload) > MAX_WHOLE_BYTES or len(batch) > 16):
                self._send_to(reader, batch)
                batch, size = [], 0
            batch.append(data)
            size += len(data.payload) + 100
        self._send_to(reader, [*batch, self._heartbeat(reader)])

    def _heartbeat(self, reader: _Reader, *, final: bool = False) -> Heartbeat:
        self._serial += 1
        last = max(reader.last, reader.announced)
        history = self._history.items()
        first = min(
            (seq for seq, each in history if seq <= last and self._is_for(each, reader)),
            default=last + 1,
        )
        return Heartbeat(reader.guid[12:], self.entity, first, last, self._serial, final)

    def _gap(self, reader: _Reader, start: int, absent: list[int]) -> Gap:
        base = start
        while base in absent:
            base += 1
        others = tuple(seq for seq in absent if base <= seq < base + WINDOW)
        return Gap(reader.guid[12:], self.entity, start, base, others)

    def _send_to(self, reader: _Reader, submessages: Iterable[Submessage]) -> None:
        self._send(reader.guid[:12], reader.address, submessages)


def _fragments(data: Data, entity: bytes) -> Iterable[DataFragments]:
    total = len(data.payload)
    for number, at in enumerate(range(0, total, FRAGMENT_BYTES), 1):
        part = data.payload[at : at + FRAGMENT_BYTES]
        yield DataFragments(
            entity, data.writer, data.seq, number, 1, FRAGMENT_BYTES, total, part, data.related
        )
