"""LDS-03 (COIN-D4), the lidar of late TurtleBot3. Packets have a first and a last angle.

Source: the vendor's driver coin_d4_driver.
"""

import math
import struct
from typing import Any, NamedTuple

import serial

from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_drivers.links.frames import FrameDecoder, Spelling, Wording, xor_of
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

BAUD = 230_400

_HEADER = b"\xaa\x55"
_PREFIX = 10
_TURN = 360.0

PROBE_BYTES = 600
DTR_NS = 100_000_000  # from opening to the clearing of the data-terminal-ready line
START_NS = 1_000_000_000  # from opening to the start command, because it boots
RESTART_NS = 3_000_000_000  # it is stopped and started after this time without a packet
REFLECTION_MM = 150  # a sample up to this distance,
REFLECTION_QUALITY = 65  # and this quality, is a reflection of the housing
MIRROR_QUALITY = 255  # replaces the quality of a mirror-like surface


def command(code: int) -> bytes:
    """Return the bytes of a command."""
    return bytes([0xAA, 0x55, code, 0xAA ^ 0x55 ^ code])


START, STOP = command(0xF0), command(0xF5)


class Lds03Sample(NamedTuple):
    """One measurement."""

    angle: float  # [deg], clockwise, 0 up to 360
    distance: int  # [mm], 0 without a return
    quality: int  # 0-255
    reflective: bool  # True for a mirror-like surface


class Lds03Packet(NamedTuple):
    """Consecutive samples. `begins` is True for the first packet of a turn."""

    begins: bool
    rate: float  # [Hz], turns per second; 0 unless a turn begins
    samples: tuple[Lds03Sample, ...]


def encode(packet: Lds03Packet) -> bytes:
    """Return the bytes of a packet; it needs a sample, and angles at even intervals."""
    first, last = packet.samples[0].angle, packet.samples[-1].angle
    kind = packet.begins | round(packet.rate * 10) << 1
    head = struct.pack("<BBHH", kind, len(packet.samples), _angle(first), _angle(last))
    body = b"".join(_sample(sample) for sample in packet.samples)
    return _HEADER + head + struct.pack("<H", _checksum(head, body)) + body


def describe(packet: Lds03Packet) -> str:
    """Describe a packet for the log."""
    first, last = packet.samples[0], packet.samples[-1]
    turn = f"a turn begins at {packet.rate:.1f} Hz, " if packet.begins else ""
    return (
        f"{turn}{len(packet.samples)} samples from {first.angle:.2f} deg, {first.distance} mm "
        f"to {last.angle:.2f} deg, {last.distance} mm"
    )


class CommandDecoder:
    """Finds commands in the bytes sent to the lidar."""

    def __init__(self) -> None:
        self._newest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the commands that `data` completes."""
        found = []
        for value in data:
            self._newest = self._newest[-3:] + bytes((value,))
            if self._newest == command(self._newest[2] if len(self._newest) == 4 else 0):
                found.append(self._newest)
        return found


def describe_command(command: bytes) -> str:
    """Describe a command for the log."""
    return {START: "start", STOP: "stop"}.get(command, "unknown command")


class Lds03Decoder(FrameDecoder[Lds03Packet]):
    """Finds packets in a stream of bytes."""

    HEADER = _HEADER

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < _PREFIX:
            return None
        count = buffer[3]
        return _PREFIX + 3 * count if count and buffer[4] & buffer[6] & 1 else 0

    def _frame(self, data: bytes) -> Lds03Packet | None:
        valid = _checksum(data[2:8], data[_PREFIX:]) == int.from_bytes(data[8:10], "little")
        return _packet(data) if valid else None


def _checksum(head: bytes, body: bytes) -> int:
    """Return the XOR of the packet's 16-bit words; a sample's first byte is a word of its own."""
    low = xor_of(head[0::2]) ^ xor_of(body[0::3]) ^ xor_of(body[1::3])
    high = xor_of(head[1::2]) ^ xor_of(body[2::3])
    return 0x55AA ^ (low | high << 8)


def _angle(degrees: float) -> int:
    return round(degrees % _TURN * 64) << 1 | 1


def _sample(sample: Lds03Sample) -> bytes:
    """Pack a sample as `0bQQQQQQ0R 0bDDDDDDQQ 0bDDDDDDDD`, with the lowest bits first."""
    return bytes(
        [
            (sample.quality & 0x3F) << 2 | sample.reflective,
            (sample.distance & 0x3F) << 2 | sample.quality >> 6,
            sample.distance >> 6,
        ]
    )


def _packet(frame: bytes) -> Lds03Packet:
    kind, count, first, last = struct.unpack_from("<BBHH", frame, 2)
    start, end = (first >> 1) / 64, (last >> 1) / 64
    step = (end - start) % _TURN / (count - 1) if count > 1 else 0.0
    samples = []
    for i, (low, middle, high) in enumerate(struct.iter_unpack("BBB", frame[_PREFIX:])):
        samples.append(
            Lds03Sample(
                angle=(start + i * step) % _TURN,
                distance=high << 6 | middle >> 2,
                quality=(middle & 3) << 6 | low >> 2,
                reflective=bool(low & 1),
            )
        )
    begins = bool(kind & 1)
    return Lds03Packet(begins, (kind >> 1) / 10 if begins else 0.0, tuple(samples))


class Lds03(SerialSource):
    """Turns from its start command to its stop command."""

    name = "LDS-03"
    samples_hz = 4000.0

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        self._decoder = Lds03Decoder()
        super().__init__(options, lidar, clock, BAUD, self._decoder)
        self.link.wording = Wording(
            Spelling(CommandDecoder().feed, describe_command),
            Spelling(Lds03Decoder().feed, describe),
        )
        self._dtr_cleared = self._started = False
        self._active_ns = 0  # time of the last command or packet

    def connected(self) -> None:
        """Wait for its boot; `watch_scans` starts it."""
        self._dtr_cleared = self._started = False
        self._active_ns = self.clock.now_ns()

    def received(self, data: bytes) -> None:
        """Decode packets; keep partial ones."""
        now_ns = self.clock.now_ns()
        for packet in self._decoder.feed(data):
            self.understood, self._active_ns = True, now_ns
            angles = [sample.angle for sample in packet.samples]
            distances = [trusted(sample) for sample in packet.samples]
            turn_at = 0 if packet.begins else None
            self.emit_scan(self.turn.add_samples(angles, distances, turn_at, now_ns))

    def watch_scans(self, now_ns: int) -> None:
        """Start the lidar once it has booted, and again if it does not turn."""
        super().watch_scans(now_ns)
        silent_ns = now_ns - self._active_ns
        if not self._dtr_cleared and silent_ns >= DTR_NS:
            self.link.set_dtr(False)
            self._dtr_cleared = True
        if not self._started and silent_ns >= START_NS:
            self._send_command(START)
            self._started = True
        elif self._started and silent_ns >= RESTART_NS:
            self._send_command(STOP)
            self._send_command(START)

    def probe(self, port: serial.Serial) -> bool:
        """Return whether this port sends packets after a start command."""
        port.write(START)
        found = bool(Lds03Decoder().feed(port.read(PROBE_BYTES)))
        if not found:
            port.write(STOP)
        return found

    def send_stop(self) -> bool:
        """Stop the lidar."""
        return self.link.write(STOP)

    def _send_command(self, command: bytes) -> None:
        self._active_ns = self.clock.now_ns()
        self.link.write(command)


def trusted(sample: Lds03Sample) -> float:
    """Return the distance [mm] of a sample; nan if it is too near and too weak.

    Source: the vendor's coin_d4_driver.
    """
    quality = MIRROR_QUALITY if sample.reflective else sample.quality
    if 0 < sample.distance <= REFLECTION_MM and quality <= REFLECTION_QUALITY:
        return math.nan
    return float(sample.distance)
