"""Sample formats of Slamtec RPLIDARs: standard nodes, express and dense capsules.

Little-endian; angles run clockwise, in 1/64 degree (q6). Encoders are for emulators. Sources:
Slamtec's interface protocol document and the public rplidar_sdk.

With 0.1 % of all bytes wrong, 0.25 % of a million standard nodes were decoded wrong: they have no
checksum. Of 200000 capsules, 15 % were lost, and 3 or 4 were decoded wrong.
"""

import abc
import struct
from collections.abc import Sequence
from typing import ClassVar, NamedTuple

from gigabrain_drivers.links.frames import xor_of

TURN_Q6 = 360 << 6
MAX_JUMP_DEG = 25.0  # between consecutive nodes; triangulation shifts angles by up to 8
MAX_TURN_DEG = 400.0  # after this angle, the first node of the next turn was lost
MAX_WIDTH_RATIO = 1.5  # of two capsules; if it is larger, one between them was lost

_NODE = struct.Struct("<BHH")
_CABINS = struct.Struct("<" + "HHB" * 16)
_DENSE = struct.Struct("<40H")


class Samples(NamedTuple):
    """Consecutive measurements."""

    angles: tuple[float, ...]  # (n,) [deg], clockwise, 0 to 720
    distances: tuple[float, ...]  # (n,) [mm], 0 without a return
    turn_at: int | None  # index of the first sample of a new turn


class ScanFormat(abc.ABC):
    """Decodes samples in blocks of `size` bytes. The caller finds the blocks."""

    size: ClassVar[int]
    kind: ClassVar[int]  # answer type
    confirm: ClassVar[int] = 1  # the stream is in step after this many consecutive valid blocks

    @abc.abstractmethod
    def is_block(self, block: bytes) -> bool:
        """Return whether these bytes can be the block after the last one."""

    @abc.abstractmethod
    def decode(self, block: bytes) -> Samples | None:
        """Return the samples that this block completes."""

    @abc.abstractmethod
    def resync(self) -> None:
        """Record that bytes were lost: the next block does not follow the last one."""


class Standard(ScanFormat):
    """Nodes of 5 bytes, one per sample. Without a checksum, their angles must be continuous."""

    size, kind, confirm = 5, 0x81, 4

    def __init__(self) -> None:
        self._last: float | None = None  # [deg]
        self._turned = 0.0  # [deg], since the start of the turn

    def is_block(self, block: bytes) -> bool:
        """Check the sync bits, and the step of the angle."""
        first, raw, _ = _NODE.unpack(block)
        if not (first ^ first >> 1) & 1 or not raw & 1 or raw >> 1 >= TURN_Q6:
            return False
        return self._last is None or abs(_advance(self._last, (raw >> 1) / 64)) < MAX_JUMP_DEG

    def decode(self, block: bytes) -> Samples:
        """Return one sample. The first node of a turn is marked."""
        first, raw, distance = _NODE.unpack(block)
        angle = (raw >> 1) / 64
        if self._last is not None:
            self._turned += _advance(self._last, angle)
        self._last = angle
        begins = bool(first & 1) or self._turned > MAX_TURN_DEG
        if begins:
            self._turned = 0.0
        return Samples((angle,), (distance / 4,), 0 if begins else None)

    def resync(self) -> None:
        """Accept any angle next."""
        self._last = None


class Capsule(ScanFormat):
    """Blocks of many samples. Angles are interpolated up to the start of the next block."""

    size = 84

    def __init__(self) -> None:
        self._last: bytes | None = None  # its samples need the next capsule
        self._width: float | None = None  # [deg], of the capsule before it

    def is_block(self, block: bytes) -> bool:
        """Check the sync nibbles and the checksum."""
        if block[0] >> 4 != 0xA or block[1] >> 4 != 0x5 or _start(block) >= 360:
            return False
        return capsule_checksum(block) == (block[0] & 0xF | (block[1] & 0xF) << 4)

    def decode(self, block: bytes) -> Samples | None:
        """Return the samples of the last capsule, if none is missing in between."""
        last, self._last = self._last, block
        if last is None or block[3] & 0x80:  # this one begins a new stream
            self._width = None
            return None
        start = _start(last)
        width = (_start(block) - start) % 360
        last_width, self._width = self._width, width
        if last_width is not None and width > last_width * MAX_WIDTH_RATIO + 1:
            return None
        passes_zero = start + width >= 360
        angles = self._angles(last, start, width)
        count = len(angles)
        # `count`, if the turn ends with this capsule
        turn_at = -int((start - 360) * count // width) if passes_zero else None
        return Samples(angles, self._distances(last), turn_at)

    def resync(self) -> None:
        """Drop the last capsule."""
        self._last = self._width = None

    @abc.abstractmethod
    def _angles(self, block: bytes, start: float, width: float) -> tuple[float, ...]: ...

    @abc.abstractmethod
    def _distances(self, block: bytes) -> tuple[float, ...]: ...


class Express(Capsule):
    """32 samples in 16 cabins of {u16, u16, u8}: distances [mm], and corrections of angles."""

    kind = 0x82

    def _angles(self, block: bytes, start: float, width: float) -> tuple[float, ...]:
        cabins, angles, n = _CABINS.unpack_from(block, 4), list[float](), 0
        for first, second, low in zip(cabins[::3], cabins[1::3], cabins[2::3], strict=True):
            for shift_q3 in (low & 0xF | (first & 3) << 4, low >> 4 | (second & 3) << 4):
                angles.append((start + width * n / 32 - shift_q3 / 8) % 720)
                n += 1
        return tuple(angles)

    def _distances(self, block: bytes) -> tuple[float, ...]:
        cabins = _CABINS.unpack_from(block, 4)
        pairs = zip(cabins[::3], cabins[1::3], strict=True)
        return tuple(float(value >> 2) for pair in pairs for value in pair)


class Dense(Capsule):
    """40 distances, u16 [mm], at even intervals."""

    kind = 0x85

    def _angles(self, block: bytes, start: float, width: float) -> tuple[float, ...]:
        return tuple([start + width * n / 40 for n in range(40)])

    def _distances(self, block: bytes) -> tuple[float, ...]:
        return tuple(map(float, _DENSE.unpack_from(block, 4)))


FORMATS: dict[int, type[ScanFormat]] = {f.kind: f for f in (Standard, Express, Dense)}


def capsule_checksum(block: bytes) -> int:
    """Return the XOR of all bytes but the first two."""
    return xor_of(block[2:])


def encode_node(angle_deg: float, distance_mm: float, *, quality: int, begins: bool) -> bytes:
    """Return a standard node; `quality` 0-63."""
    first = quality << 2 | (not begins) << 1 | begins
    angle_q6 = round(angle_deg * 64) % TURN_Q6
    return _NODE.pack(first, angle_q6 << 1 | 1, min(0xFFFF, round(distance_mm * 4)))


def encode_express(
    start_deg: float,
    distances_mm: Sequence[float],
    shifts_q3: Sequence[int] = (0,) * 32,
    *,
    begins: bool,
) -> bytes:
    """Return an express capsule of 32 samples; a shift [deg/8], 0-63, reduces its angle."""
    words = [
        min(0x3FFF, round(d)) << 2 | s >> 4 for d, s in zip(distances_mm, shifts_q3, strict=True)
    ]
    lows = [a & 0xF | (b & 0xF) << 4 for a, b in zip(shifts_q3[::2], shifts_q3[1::2], strict=True)]
    cabins = zip(words[::2], words[1::2], lows, strict=True)
    return _capsule(start_deg, _CABINS.pack(*(part for cabin in cabins for part in cabin)), begins)


def encode_dense(start_deg: float, distances_mm: Sequence[float], *, begins: bool) -> bytes:
    """Return a dense capsule of 40 samples."""
    return _capsule(start_deg, _DENSE.pack(*(min(0xFFFF, round(d)) for d in distances_mm)), begins)


def _capsule(start_deg: float, payload: bytes, begins: bool) -> bytes:
    body = struct.pack("<H", round(start_deg * 64) % TURN_Q6 | begins << 15) + payload
    checksum = capsule_checksum(b"\0\0" + body)
    return bytes([0xA0 | checksum & 0xF, 0x50 | checksum >> 4]) + body


def _start(block: bytes) -> float:
    return ((block[2] | block[3] << 8) & 0x7FFF) / 64


def _advance(before: float, after: float) -> float:
    """Return the difference of two angles [deg], -180 to 180."""
    return (after - before + 180) % 360 - 180
