"""LDS-03 (COIN-D4), the lidar of late TurtleBot3: packets with their own first and last angle.

Source: the vendor's driver coin_d4_driver.
"""

import operator
import struct
from functools import reduce
from typing import NamedTuple

from gigabrain_drivers.links.frames import FrameDecoder

BAUD = 230_400

_HEADER = b"\xaa\x55"
_PREFIX = 10
_TURN = 360.0


def command(code: int) -> bytes:
    """A command to the lidar."""
    return bytes([0xAA, 0x55, code, 0xAA ^ 0x55 ^ code])


START, STOP = command(0xF0), command(0xF5)


class Sample(NamedTuple):
    """One measurement."""

    angle: float  # [deg], clockwise, 0 up to 360
    distance: int  # [mm], 0 where there was no return
    quality: int  # 0-255
    reflective: bool  # of a mirror-like surface


class Packet(NamedTuple):
    """Samples in a row; `begins` a turn when the angle passes 0."""

    begins: bool
    rate: float  # [Hz] of turns; only told where a turn begins, else 0
    samples: tuple[Sample, ...]


def encode(packet: Packet) -> bytes:
    """The bytes of a packet of at least one sample; angles in between are spread evenly."""
    first, last = packet.samples[0].angle, packet.samples[-1].angle
    kind = packet.begins | round(packet.rate * 10) << 1
    head = struct.pack("<BBHH", kind, len(packet.samples), _angle(first), _angle(last))
    body = b"".join(_sample(sample) for sample in packet.samples)
    return _HEADER + head + struct.pack("<H", _check(head, body)) + body


def describe(packet: Packet) -> str:
    """A packet in words."""
    first, last = packet.samples[0], packet.samples[-1]
    turn = f"a turn begins at {packet.rate:.1f} Hz, " if packet.begins else ""
    return (
        f"{turn}{len(packet.samples)} samples from {first.angle:.2f} deg, {first.distance} mm "
        f"to {last.angle:.2f} deg, {last.distance} mm"
    )


class CommandDecoder:
    """Finds commands in what goes to the lidar."""

    def __init__(self) -> None:
        self._newest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """The commands that `data` completes."""
        found = []
        for value in data:
            self._newest = self._newest[-3:] + bytes((value,))
            if self._newest == command(self._newest[2] if len(self._newest) == 4 else 0):
                found.append(self._newest)
        return found


def describe_command(command: bytes) -> str:
    """A command to the lidar in words."""
    return {START: "start", STOP: "stop"}.get(command, "unknown command")


class Decoder(FrameDecoder[Packet]):
    """Finds packets in whatever comes in."""

    HEADER = _HEADER

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < _PREFIX:
            return None
        count = buffer[3]
        return _PREFIX + 3 * count if count and buffer[4] & buffer[6] & 1 else 0

    def _frame(self, data: bytes) -> Packet | None:
        right = _check(data[2:8], data[_PREFIX:]) == int.from_bytes(data[8:10], "little")
        return _packet(data) if right else None


def _check(head: bytes, body: bytes) -> int:
    """The exclusive or of the packet's 16-bit words; of each sample its first byte by itself."""
    low = _xor(head[0::2]) ^ _xor(body[0::3]) ^ _xor(body[1::3])
    high = _xor(head[1::2]) ^ _xor(body[2::3])
    return 0x55AA ^ (low | high << 8)


def _xor(data: bytes) -> int:
    return reduce(operator.xor, data, 0)


def _angle(degrees: float) -> int:
    return round(degrees % _TURN * 64) << 1 | 1


def _sample(sample: Sample) -> bytes:
    """`0bQQQQQQ0R 0bDDDDDDQQ 0bDDDDDDDD`, the lowest bits of quality and distance first."""
    return bytes(
        [
            (sample.quality & 0x3F) << 2 | sample.reflective,
            (sample.distance & 0x3F) << 2 | sample.quality >> 6,
            sample.distance >> 6,
        ]
    )


def _packet(frame: bytes) -> Packet:
    kind, count, first, last = struct.unpack_from("<BBHH", frame, 2)
    start, end = (first >> 1) / 64, (last >> 1) / 64
    step = (end - start) % _TURN / (count - 1) if count > 1 else 0.0
    samples = []
    for i, (low, middle, high) in enumerate(struct.iter_unpack("BBB", frame[_PREFIX:])):
        samples.append(
            Sample(
                angle=(start + i * step) % _TURN,
                distance=high << 6 | middle >> 2,
                quality=(middle & 3) << 6 | low >> 2,
                reflective=bool(low & 1),
            )
        )
    begins = bool(kind & 1)
    return Packet(begins, (kind >> 1) / 10 if begins else 0.0, tuple(samples))
