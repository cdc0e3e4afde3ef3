"""Wire format of RTPS: messages, submessages and parameter lists. Pure functions.

Source: OMG DDSI-RTPS 2.3, chapters 8.3 and 9.4. A GUID is 16 bytes: a prefix of 12 bytes, which
names the participant, and an entity id of 4 bytes. Decoders accept both byte orders, encoders
write little-endian.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

VERSION = bytes((2, 3))
VENDOR_UNKNOWN, VENDOR_CYCLONE = bytes((0, 0)), bytes((1, 16))
UNKNOWN_ENTITY = bytes(4)

PID_SENTINEL, PID_KEY_HASH, PID_STATUS_INFO = 0x0001, 0x0070, 0x0071
PID_RELATED_SAMPLE, PID_RELATED_SAMPLE_OLD = 0x0083, 0x800F  # old: for Fast DDS before 2.13
DISPOSED = 0b11  # status bits: 0 is disposed, 1 is unregistered

WINDOW = 256  # maximum size of a set of sequence numbers, in an ACKNACK or a GAP
MAX_SEQUENCE = 1 << 62  # received; later numbers then also fit into 64 bits
MAX_PARAMETERS = 200  # in one list
HEADER_BYTES, MAX_SUBMESSAGES = 20, 64

_DATA, _DATA_FRAG, _ACKNACK, _HEARTBEAT, _GAP = 0x15, 0x16, 0x06, 0x07, 0x08
_NACK_FRAG, _HEARTBEAT_FRAG = 0x12, 0x13
_PAD, _INFO_TS, _INFO_SRC, _INFO_DST = 0x01, 0x09, 0x0C, 0x0E


class BadMessage(ValueError):
    """Received bytes that are not valid RTPS."""


class Sample(NamedTuple):
    """The identity of a sample: the GUID of its writer and its sequence number."""

    guid: bytes
    seq: int

    def encode(self) -> bytes:
        """Return the 24 bytes of a sample identity."""
        return self.guid + _sequence(self.seq)


class Data(NamedTuple):
    """A DATA submessage: one sample, or the disposal of an instance."""

    reader: bytes  # entity id; UNKNOWN_ENTITY for all readers
    writer: bytes  # entity id
    seq: int
    payload: bytes = b""  # with its encapsulation header
    related: Sample | None = None  # in a request: the client's reader; in a reply: the request
    status: int = 0  # DISPOSED for a disposal
    key: bytes = b""  # key hash; in discovery data, the GUID of the described entity

    def encode(self) -> bytes:
        """Return the submessage."""
        inline = _inline_qos(self.related, self.status, self.key)
        flags = 1 | (2 if inline else 0) | ((8 if self.status else 4) if self.payload else 0)
        head = struct.pack("<HH", 0, 16) + self.reader + self.writer + _sequence(self.seq)
        return _submessage(_DATA, flags, head + inline + self.payload)


class DataFragments(NamedTuple):
    """A DATA_FRAG submessage: consecutive fragments of a sample."""

    reader: bytes
    writer: bytes
    seq: int
    first: int  # number of the first fragment, from 1
    number: int  # count of fragments in this submessage
    fragment_bytes: int  # size of each fragment, except the sample's last one
    sample_bytes: int  # size of the whole sample
    payload: bytes
    related: Sample | None = None

    def encode(self) -> bytes:
        """Return the submessage."""
        inline = _inline_qos(self.related, 0, b"")
        head = struct.pack("<HH", 0, 28) + self.reader + self.writer + _sequence(self.seq)
        head += struct.pack(
            "<IHHI", self.first, self.number, self.fragment_bytes, self.sample_bytes
        )
        return _submessage(_DATA_FRAG, 3 if inline else 1, head + inline + self.payload)


class Heartbeat(NamedTuple):
    """A HEARTBEAT submessage: the range of samples that a writer has."""

    reader: bytes
    writer: bytes
    first: int
    last: int  # first - 1 if there are none
    serial: int  # increases with each submessage of this kind
    final: bool = False  # true: no answer is needed

    def encode(self) -> bytes:
        """Return the submessage."""
        body = self.reader + self.writer + _sequence(self.first) + _sequence(self.last)
        return _submessage(_HEARTBEAT, 3 if self.final else 1, body + _serial(self.serial))


class AckNack(NamedTuple):
    """An ACKNACK submessage: a reader has all samples below `base`, and requests `missing`."""

    reader: bytes
    writer: bytes
    base: int
    missing: tuple[int, ...]
    serial: int  # increases with each submessage of this kind
    final: bool = True  # true: no heartbeat is needed

    def encode(self) -> bytes:
        """Return the submessage."""
        body = self.reader + self.writer + _sequence(self.base) + _bitmap(self.base, self.missing)
        return _submessage(_ACKNACK, 3 if self.final else 1, body + _serial(self.serial))


class Gap(NamedTuple):
    """A GAP submessage: samples `start` to `base - 1`, and `others`, are not for the reader."""

    reader: bytes
    writer: bytes
    start: int
    base: int
    others: tuple[int, ...] = ()

    def encode(self) -> bytes:
        """Return the submessage."""
        body = self.reader + self.writer + _sequence(self.start) + _sequence(self.base)
        return _submessage(_GAP, 1, body + _bitmap(self.base, self.others))


class NackFragments(NamedTuple):
    """A NACK_FRAG submessage: a reader requests fragments of a sample."""

    reader: bytes
    writer: bytes
    seq: int
    missing: tuple[int, ...]  # numbers of fragments, from 1
    serial: int  # increases with each submessage of this kind

    def encode(self) -> bytes:
        """Return the submessage."""
        base = self.missing[0]
        body = self.reader + self.writer + _sequence(self.seq) + struct.pack("<I", base)
        return _submessage(_NACK_FRAG, 1, body + _bitmap(base, self.missing) + _serial(self.serial))


class HeartbeatFragments(NamedTuple):
    """A HEARTBEAT_FRAG submessage: a writer has a sample's fragments up to `last`."""

    reader: bytes
    writer: bytes
    seq: int
    last: int
    serial: int

    def encode(self) -> bytes:
        """Return the submessage."""
        body = self.reader + self.writer + _sequence(self.seq) + struct.pack("<I", self.last)
        return _submessage(_HEARTBEAT_FRAG, 1, body + _serial(self.serial))


Submessage = Data | DataFragments | Heartbeat | AckNack | Gap | NackFragments | HeartbeatFragments


class Message(NamedTuple):
    """The submessages of a datagram that are for this participant."""

    prefix: bytes  # the sender's GUID prefix
    vendor: bytes
    submessages: list[Submessage]


def encode_message(prefix: bytes, to: bytes, submessages: Iterable[Submessage], ns: int) -> bytes:
    """Return a datagram. `to` is the receiver's prefix, empty for all; `ns` is Unix time."""
    parts = [b"RTPS" + VERSION + VENDOR_UNKNOWN + prefix]
    if to:
        parts.append(_submessage(_INFO_DST, 1, to))
    fraction = (ns % 1_000_000_000 << 32) // 1_000_000_000
    parts.append(_submessage(_INFO_TS, 1, struct.pack("<II", ns // 1_000_000_000, fraction)))
    parts.extend(each.encode() for each in submessages)
    return b"".join(parts)


def decode_message(datagram: bytes, prefix: bytes) -> Message:
    """Decode the submessages for the participant `prefix`, up to the first malformed one.

    Raises BadMessage if the header of the datagram is wrong.
    """
    if len(datagram) < HEADER_BYTES or datagram[:4] != b"RTPS" or datagram[4] != VERSION[0]:
        raise BadMessage("not an RTPS message")
    message = Message(datagram[8:20], datagram[6:8], [])
    ours, at = True, HEADER_BYTES
    for _ in range(MAX_SUBMESSAGES):
        if at + 4 > len(datagram):
            break
        kind, flags = datagram[at], datagram[at + 1]
        order = "<" if flags & 1 else ">"
        (size,) = struct.unpack_from(order + "H", datagram, at + 2)
        if not size and kind not in (_PAD, _INFO_TS):
            size = len(datagram) - at - 4  # 0 in the last one: up to the end, also above 64 kB
        body = datagram[at + 4 : at + 4 + size]
        at += 4 + (size + 3 & ~3)
        if len(body) < size or kind == _INFO_SRC:  # no sender may act for another participant
            break
        if kind == _INFO_DST:
            ours = body in (prefix, bytes(12))
        elif ours and (decode := _DECODERS.get(kind)):
            try:
                message.submessages.append(decode(order, flags, body))
            except (struct.error, BadMessage):
                break
    return message


def encode_parameters(parameters: Iterable[tuple[int, bytes]]) -> bytes:
    """Return a parameter list with its sentinel."""
    parts = []
    for pid, value in parameters:
        padding = -len(value) % 4
        parts.append(struct.pack("<HH", pid, len(value) + padding) + value + bytes(padding))
    return b"".join(parts) + struct.pack("<HH", PID_SENTINEL, 0)


def decode_parameters(order: str, data: bytes, at: int = 0) -> Iterator[tuple[int, bytes, int]]:
    """Yield (id, value, offset after it) of each parameter; the sentinel has no value.

    Raises BadMessage for a list that ends early, or that is too long.
    """
    for _ in range(MAX_PARAMETERS):
        if at + 4 > len(data):
            raise BadMessage("parameter list without an end")
        pid, size = struct.unpack_from(order + "HH", data, at)
        if pid == PID_SENTINEL:
            yield pid, b"", at + 4
            return
        value = data[at + 4 : at + 4 + size]
        if len(value) < size:
            raise BadMessage("parameter list without an end")
        at += 4 + (size + 3 & ~3)
        yield pid, value, at
    raise BadMessage("too many parameters")


def _inline_qos(related: Sample | None, status: int, key: bytes) -> bytes:
    parameters = []
    if related:
        identity = related.encode()
        parameters += [(PID_RELATED_SAMPLE, identity), (PID_RELATED_SAMPLE_OLD, identity)]
    if key:
        parameters.append((PID_KEY_HASH, key))
    if status:
        parameters.append((PID_STATUS_INFO, struct.pack(">I", status)))
    return encode_parameters(parameters) if parameters else b""


def _sequence(seq: int) -> bytes:
    return struct.pack("<iI", seq >> 32, seq & 0xFFFF_FFFF)


def _serial(serial: int) -> bytes:
    return struct.pack("<I", serial & 0x7FFF_FFFF)


def _bitmap(base: int, numbers: Iterable[int]) -> bytes:
    bits = [number - base for number in numbers]
    size = max(bits) + 1 if bits else 0
    words = [0] * ((size + 31) // 32)
    for bit in bits:
        words[bit // 32] |= 1 << (31 - bit % 32)
    return struct.pack(f"<I{len(words)}I", size, *words)


def _submessage(kind: int, flags: int, body: bytes) -> bytes:
    padding = -len(body) % 4
    size = len(body) + padding
    if size > 0xFFFF:
        raise ValueError(f"a submessage of {size} bytes is too long")
    return struct.pack("<BBH", kind, flags, size) + body + bytes(padding)


def _read_sequence(order: str, body: bytes, at: int) -> int:
    high, low = struct.unpack_from(order + "iI", body, at)
    return int(high << 32 | low)


def _read_bitmap(order: str, body: bytes, at: int, base: int) -> tuple[tuple[int, ...], int]:
    """Return the numbers of a set, and the offset after it."""
    (size,) = struct.unpack_from(order + "I", body, at)
    if size > WINDOW:
        raise BadMessage("too large a set")
    words = struct.unpack_from(f"{order}{(size + 31) // 32}I", body, at + 4)
    numbers = (base + bit for bit in range(size) if words[bit // 32] >> (31 - bit % 32) & 1)
    return tuple(numbers), at + 4 + 4 * len(words)


class _InlineQos(NamedTuple):
    related: Sample | None
    status: int
    key: bytes
    end: int  # offset of the payload


def _read_inline_qos(order: str, flags: int, body: bytes) -> _InlineQos:
    (skip,) = struct.unpack_from(order + "H", body, 2)
    related, status, key, end = None, 0, b"", 4 + skip
    if flags & 2:
        for pid, value, after in decode_parameters(order, body, end):
            end = after
            if pid in (PID_RELATED_SAMPLE, PID_RELATED_SAMPLE_OLD) and len(value) >= 24:
                related = Sample(value[:16], _read_sequence(order, value, 16))
            elif pid == PID_STATUS_INFO and len(value) >= 4:
                status = value[3] & DISPOSED
            elif pid == PID_KEY_HASH and len(value) >= 16:
                key = value[:16]
    return _InlineQos(related, status, key, end)


def _checked_sequence(seq: int, minimum: int = 1) -> int:
    if not minimum <= seq <= MAX_SEQUENCE:
        raise BadMessage(f"sequence number {seq}: expected {minimum} to {MAX_SEQUENCE}")
    return seq


def _data(order: str, flags: int, body: bytes) -> Data:
    seq = _checked_sequence(_read_sequence(order, body, 12))
    inline = _read_inline_qos(order, flags, body)
    payload = body[inline.end :] if flags & 12 else b""
    status = inline.status or (DISPOSED if flags & 8 else 0)  # flag 8: only a key
    return Data(body[4:8], body[8:12], seq, payload, inline.related, status, inline.key)


def _data_fragments(order: str, flags: int, body: bytes) -> DataFragments:
    seq = _checked_sequence(_read_sequence(order, body, 12))
    first, count, fragment, sample = struct.unpack_from(order + "IHHI", body, 20)
    if not (first and count and fragment and sample and (first - 1) * fragment < sample):
        raise BadMessage("impossible fragments")
    inline = _read_inline_qos(order, flags, body)
    part = body[inline.end :]
    return DataFragments(
        body[4:8], body[8:12], seq, first, count, fragment, sample, part, inline.related
    )


def _heartbeat(order: str, flags: int, body: bytes) -> Heartbeat:
    first = _checked_sequence(_read_sequence(order, body, 8))
    last = _checked_sequence(_read_sequence(order, body, 16), first - 1)
    (count,) = struct.unpack_from(order + "I", body, 24)
    return Heartbeat(body[:4], body[4:8], first, last, count, bool(flags & 2))


def _acknack(order: str, flags: int, body: bytes) -> AckNack:
    base = _read_sequence(order, body, 8)  # unchecked: Fast DDS begins with 0
    missing, at = _read_bitmap(order, body, 16, base)
    (count,) = struct.unpack_from(order + "I", body, at)
    return AckNack(body[:4], body[4:8], base, missing, count, bool(flags & 2))


def _gap(order: str, flags: int, body: bytes) -> Gap:
    start = _checked_sequence(_read_sequence(order, body, 8))
    base = _checked_sequence(_read_sequence(order, body, 16))
    others, _ = _read_bitmap(order, body, 24, base)
    return Gap(body[:4], body[4:8], start, base, others)


def _nack_fragments(order: str, flags: int, body: bytes) -> NackFragments:
    seq = _checked_sequence(_read_sequence(order, body, 8))
    (base,) = struct.unpack_from(order + "I", body, 16)
    missing, at = _read_bitmap(order, body, 20, base)
    (count,) = struct.unpack_from(order + "I", body, at)
    return NackFragments(body[:4], body[4:8], seq, missing, count)


def _heartbeat_fragments(order: str, flags: int, body: bytes) -> HeartbeatFragments:
    seq = _checked_sequence(_read_sequence(order, body, 8))
    last, count = struct.unpack_from(order + "II", body, 16)
    return HeartbeatFragments(body[:4], body[4:8], seq, last, count)


_DECODERS: dict[int, Callable[[str, int, bytes], Submessage]] = {
    _DATA: _data,
    _DATA_FRAG: _data_fragments,
    _HEARTBEAT: _heartbeat,
    _ACKNACK: _acknack,
    _GAP: _gap,
    _NACK_FRAG: _nack_fragments,
    _HEARTBEAT_FRAG: _heartbeat_fragments,
}
