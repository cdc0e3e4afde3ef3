"""Reliable reader of RTPS, as a state machine without sockets or clocks.

Source: OMG DDSI-RTPS 2.3, chapter 8.4. Times are in seconds of any monotonic clock. No peer can
make it use unbounded memory. A submessage is answered by at most two datagrams.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from gigabrain_zenoh.ros2.rtps_discovery import Address
from gigabrain_zenoh.ros2.rtps_wire import (
    WINDOW,
    AckNack,
    Data,
    DataFragments,
    Gap,
    Heartbeat,
    HeartbeatFragments,
    NackFragments,
)
from gigabrain_zenoh.ros2.rtps_writer import Send

MAX_SAMPLE_BYTES, MAX_FRAGMENTS = 1 << 20, 4096
MAX_EARLY = WINDOW  # out-of-order samples kept for one writer
MAX_ALL_EARLY, MAX_EARLY_BYTES = 4096, 4 << 20  # out-of-order samples kept for all writers
MAX_ASSEMBLIES, ASSEMBLY_TIMEOUT_S = 8, 5.0  # incomplete fragmented samples of one reader
MIN_GREETING_S, MAX_GREETING_S = 0.5, 8.0  # period of requests for a first heartbeat; it doubles
MAX_STRANGERS = 256  # writers that sent heartbeats before their announcement
MIN_REQUEST_S = 0.005  # minimum time between two requests because of samples out of order


@dataclass(slots=True, eq=False)
class _Assembly:
    """A fragmented sample that is still incomplete."""

    data: DataFragments  # the first received ones
    received_s: float  # time of the newest fragment
    parts: dict[int, bytes] = field(default_factory=dict)  # by fragment number, from 1

    @property
    def total(self) -> int:
        return -(-self.data.sample_bytes // self.data.fragment_bytes)

    def missing(self) -> tuple[int, ...]:
        first = next(n for n in range(1, self.total + 1) if n not in self.parts)
        window = range(first, min(first + WINDOW, self.total + 1))
        return tuple(number for number in window if number not in self.parts)


@dataclass(slots=True, eq=False)
class _Writer:
    """A reader's state of one remote writer."""

    guid: bytes
    address: Address
    next: int = 1  # sequence number of the sample to deliver next
    early: dict[int, Data | None] = field(default_factory=dict)  # None: not for this reader
    assemblies: dict[int, _Assembly] = field(default_factory=dict)
    answered: bool = False  # true: it has sent a heartbeat or a gap
    wait_s: float = MIN_GREETING_S
    due_s: float = 0.0  # time of the next greeting
    requested_s: float = -1.0  # time of the newest request for samples


class ReliableReader:
    """A reader that delivers each sample of its matched writers once, in order."""

    def __init__(self, entity: bytes, send: Send, deliver: Callable[[bytes, Data], None]) -> None:
        """Create a reader with an entity id; it calls `deliver` with (writer's GUID, sample)."""
        self.entity = entity
        self.writers: dict[bytes, _Writer] = {}
        self._send, self._deliver, self._serial = send, deliver, 0
        self._strangers: dict[bytes, None] = {}
        self._early = self._early_bytes = 0

    def match(self, guid: bytes, address: Address, now: float) -> None:
        """Add a remote writer, or change its address."""
        if known := self.writers.get(guid):
            known.address = address
            return
        answered = guid in self._strangers
        self._strangers.pop(guid, None)
        self.writers[guid] = writer = _Writer(guid, address, answered=answered)
        self._greet(writer, now)

    def unmatch(self, guid: bytes) -> None:
        """Remove a remote writer."""
        if writer := self.writers.pop(guid, None):
            for seq in list(writer.early):
                self._pop_early(writer, seq)
        self._strangers.pop(guid, None)

    def on_data(self, guid: bytes, data: Data, now: float) -> None:
        """Process a sample."""
        writer = self.writers.get(guid)
        if writer is None or data.seq < writer.next or data.seq in writer.early:
            return
        writer.assemblies.pop(data.seq, None)
        if data.seq == writer.next:
            writer.next += 1
            self._deliver(guid, data)
            self._drain(writer)
            return
        if data.seq < writer.next + MAX_EARLY and self._has_room(len(data.payload)):
            writer.early[data.seq] = data
            self._early, self._early_bytes = self._early + 1, self._early_bytes + len(data.payload)
        if now - writer.requested_s >= MIN_REQUEST_S:
            self._request_missing(writer, data.seq, now)

    def on_fragments(self, guid: bytes, part: DataFragments, now: float) -> None:
        """Process fragments of a sample, and the whole sample once it is complete."""
        writer = self.writers.get(guid)
        if writer is None or part.sample_bytes > MAX_SAMPLE_BYTES:
            return
        if part.sample_bytes > MAX_FRAGMENTS * part.fragment_bytes:
            return
        if not writer.next <= part.seq < writer.next + MAX_EARLY or part.seq in writer.early:
            return
        assembly = writer.assemblies.get(part.seq)
        if assembly is None or _shape(assembly.data) != _shape(part):
            if assembly is None and self._assemblies() >= MAX_ASSEMBLIES:
                return
            assembly = writer.assemblies[part.seq] = _Assembly(part, now)
        assembly.received_s = now
        for number in range(part.first, min(part.first + part.number, assembly.total + 1)):
            start = (number - part.first) * part.fragment_bytes
            size = min(part.fragment_bytes, part.sample_bytes - (number - 1) * part.fragment_bytes)
            piece = part.payload[start : start + size]
            if len(piece) == size:
                assembly.parts.setdefault(number, piece)
        if len(assembly.parts) == assembly.total:
            payload = b"".join(assembly.parts[n] for n in range(1, assembly.total + 1))
            related = assembly.data.related or part.related
            self.on_data(guid, Data(part.reader, part.writer, part.seq, payload, related), now)

    def on_heartbeat(self, guid: bytes, beat: Heartbeat, now: float) -> None:
        """Request the missing samples of those that the writer has."""
        writer = self.writers.get(guid)
        if writer is None:
            if len(self._strangers) < MAX_STRANGERS:
                self._strangers[guid] = None
            return
        writer.answered = True
        self._skip(writer, beat.first)  # the writer no longer has the samples before
        if not beat.final or writer.next <= beat.last:
            self._request_missing(writer, beat.last, now)

    def on_heartbeat_fragments(self, guid: bytes, beat: HeartbeatFragments, now: float) -> None:
        """Request the missing fragments of a sample."""
        writer = self.writers.get(guid)
        assembly = writer.assemblies.get(beat.seq) if writer else None
        missing = [n for n in assembly.missing() if n <= beat.last] if assembly else []
        if writer and missing:
            self._nack_fragments(writer, beat.seq, tuple(missing))

    def on_gap(self, guid: bytes, gap: Gap, now: float) -> None:
        """Stop waiting for samples that are not for this reader."""
        writer = self.writers.get(guid)
        if writer is None:
            return
        writer.answered = True
        if gap.start <= writer.next:
            self._skip(writer, gap.base)
        window = range(max(gap.start, writer.next), min(gap.base, writer.next + MAX_EARLY))
        for seq in (*window, *gap.others):
            new = writer.next <= seq < writer.next + MAX_EARLY and seq not in writer.early
            if new and self._has_room(0):
                writer.early[seq] = None
                self._early += 1
        self._drain(writer)

    def tick(self, now: float) -> float:
        """Greet writers that have not answered; return when the next greeting is due."""
        due = math.inf
        for writer in self.writers.values():
            if writer.assemblies:
                writer.assemblies = {
                    seq: assembly
                    for seq, assembly in writer.assemblies.items()
                    if now - assembly.received_s <= ASSEMBLY_TIMEOUT_S
                }
            if not writer.answered:
                if now >= writer.due_s:
                    self._greet(writer, now)
                due = min(due, writer.due_s)
        return due

    def _assemblies(self) -> int:
        return sum(len(writer.assemblies) for writer in self.writers.values())

    def _greet(self, writer: _Writer, now: float) -> None:
        writer.due_s = now + writer.wait_s
        writer.wait_s = min(2 * writer.wait_s, MAX_GREETING_S)
        self._acknack(writer, (), final=False)

    def _skip(self, writer: _Writer, first: int) -> None:
        """Deliver the received samples below `first`, and continue with `first`."""
        if first <= writer.next:
            return
        for seq in sorted(seq for seq in writer.early if seq < first):
            self._take_early(writer, seq)
        for seq in [seq for seq in writer.assemblies if seq < first]:
            del writer.assemblies[seq]
        writer.next = max(writer.next, first)
        self._drain(writer)

    def _drain(self, writer: _Writer) -> None:
        while writer.next in writer.early:
            self._take_early(writer, writer.next)

    def _take_early(self, writer: _Writer, seq: int) -> None:
        data = self._pop_early(writer, seq)
        writer.next = seq + 1
        writer.assemblies.pop(seq, None)
        if data is not None:
            self._deliver(writer.guid, data)

    def _pop_early(self, writer: _Writer, seq: int) -> Data | None:
        data = writer.early.pop(seq)
        self._early -= 1
        self._early_bytes -= len(data.payload) if data else 0
        return data

    def _has_room(self, size: int) -> bool:
        return self._early < MAX_ALL_EARLY and self._early_bytes + size <= MAX_EARLY_BYTES

    def _request_missing(self, writer: _Writer, last: int, now: float) -> None:
        """Acknowledge received samples, and request missing ones up to `last`."""
        writer.requested_s = now
        window = range(writer.next, min(last + 1, writer.next + WINDOW))
        missing = [seq for seq in window if seq not in writer.early]
        partial = [seq for seq in missing if seq in writer.assemblies]
        self._acknack(writer, tuple(seq for seq in missing if seq not in partial), final=True)
        for seq in partial[:1]:
            self._nack_fragments(writer, seq, writer.assemblies[seq].missing())

    def _acknack(self, writer: _Writer, missing: tuple[int, ...], *, final: bool) -> None:
        self._serial += 1
        ack = AckNack(self.entity, writer.guid[12:], writer.next, missing, self._serial, final)
        self._send(writer.guid[:12], writer.address, [ack])

    def _nack_fragments(self, writer: _Writer, seq: int, missing: tuple[int, ...]) -> None:
        self._serial += 1
        nack = NackFragments(self.entity, writer.guid[12:], seq, missing, self._serial)
        self._send(writer.guid[:12], writer.address, [nack])


def _shape(part: DataFragments) -> tuple[int, int]:
    return part.fragment_bytes, part.sample_bytes
