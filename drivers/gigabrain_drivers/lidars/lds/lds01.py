"""LDS-01 (Hitachi-LG HLS-LFCD2), the lidar of early TurtleBot3: 60 packets of 42 bytes a turn.

Source: the vendor's driver hls_lfcd_lds_driver. It does not look at the checksum, whose rule is not
published; so a packet is known by its structure, and counts when the next one follows it at once.
"""

import struct
from typing import NamedTuple

from gigabrain_drivers.links.frames import FrameDecoder

BAUD = 230_400
START, STOP = b"b", b"e"
PACKETS, SAMPLES = 60, 6  # per turn, per packet
SIZE = 42
NO_RETURN = 0  # [mm]

_SYNC, _FIRST = 0xFA, 0xA0


class Packet(NamedTuple):
    """Six of a turn's 360 samples; sample `6 * number + i` looks that many degrees clockwise."""

    number: int  # 0-59
    rpm: float
    intensities: tuple[int, ...]
    ranges: tuple[int, ...]  # [mm], 0 where there was no return


def encode(packet: Packet) -> bytes:
    """The bytes of a packet; the checksum is the one that other drivers report, unverified."""
    frame = struct.pack("<BBH", _SYNC, _FIRST + packet.number, round(packet.rpm * 10))
    for intensity, distance in zip(packet.intensities, packet.ranges, strict=True):
        frame += struct.pack("<HHH", intensity, distance, 0)
    return frame + bytes([0xFF - sum(frame) & 0xFF]) * 2


def describe(packet: Packet) -> str:
    """A packet in words."""
    first = packet.number * SAMPLES
    return (
        f"samples {first} to {first + SAMPLES - 1} of 360: {' '.join(map(str, packet.ranges))} mm, "
        f"{packet.rpm:.1f} rpm"
    )


def describe_command(command: bytes) -> str:
    """A command to the lidar in words."""
    return {START: "start", STOP: "stop"}.get(command, "unknown command")


class Decoder(FrameDecoder[Packet]):
    """Finds packets in whatever comes in; each waits for the header of the next."""

    HEADER = bytes([_SYNC])

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < SIZE + 2:
            return None
        number = buffer[1] - _FIRST
        follows = buffer[SIZE] == _SYNC and buffer[SIZE + 1] == _FIRST + (number + 1) % PACKETS
        return SIZE if 0 <= number < PACKETS and follows else 0

    def _frame(self, data: bytes) -> Packet:
        return _packet(data)


def _packet(frame: bytes) -> Packet:
    values = struct.unpack("<BBH" + "HHH" * SAMPLES + "H", frame)
    return Packet(values[1] - _FIRST, values[2] / 10, values[3:-1:3], values[4:-1:3])
