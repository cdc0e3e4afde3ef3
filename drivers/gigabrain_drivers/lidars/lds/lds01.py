"""LDS-01 (Hitachi-LG HLS-LFCD2), the lidar of early TurtleBot3. A turn is 60 packets of 42 bytes.

Source: the vendor's driver hls_lfcd_lds_driver. It ignores the checksum, which is not documented.
So a packet is valid if its structure is right, and the header of the next one follows.
"""

import struct
from typing import Any, NamedTuple

import serial

from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_drivers.links.frames import FrameDecoder, Spelling, Wording, as_one_frame
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

BAUD = 230_400
START, STOP = b"b", b"e"
PACKETS, SAMPLES = 60, 6  # per turn, per packet
SIZE = 42

_SYNC, _FIRST = 0xFA, 0xA0

PROBE_BYTES = 600  # fourteen packets
PROBE_PACKETS = 3
RESTART_NS = 1_000_000_000  # it is started again after this time without a packet


class Lds01Packet(NamedTuple):
    """Six of a turn's 360 samples, from sample `6 * number` on, clockwise."""

    number: int  # 0-59
    rpm: float
    intensities: tuple[int, ...]
    ranges: tuple[int, ...]  # [mm], 0 without a return


def encode(packet: Lds01Packet) -> bytes:
    """Return the bytes of a packet, with the checksum that other drivers describe."""
    frame = struct.pack("<BBH", _SYNC, _FIRST + packet.number, round(packet.rpm * 10))
    for intensity, distance in zip(packet.intensities, packet.ranges, strict=True):
        frame += struct.pack("<HHH", intensity, distance, 0)
    return frame + bytes([0xFF - sum(frame) & 0xFF]) * 2


def describe(packet: Lds01Packet) -> str:
    """Describe a packet for the log."""
    first = packet.number * SAMPLES
    return (
        f"samples {first} to {first + SAMPLES - 1} of 360: {' '.join(map(str, packet.ranges))} mm, "
        f"{packet.rpm:.1f} rpm"
    )


def describe_command(command: bytes) -> str:
    """Describe a command for the log."""
    return {START: "start", STOP: "stop"}.get(command, "unknown command")


class Lds01Decoder(FrameDecoder[Lds01Packet]):
    """Finds packets in a stream of bytes; each waits for the header of the next one."""

    HEADER = bytes([_SYNC])

    def _size(self, buffer: bytearray) -> int | None:
        if len(buffer) < SIZE + 2:
            return None
        number = buffer[1] - _FIRST
        follows = buffer[SIZE] == _SYNC and buffer[SIZE + 1] == _FIRST + (number + 1) % PACKETS
        return SIZE if 0 <= number < PACKETS and follows else 0

    def _frame(self, data: bytes) -> Lds01Packet:
        return _packet(data)


def _packet(frame: bytes) -> Lds01Packet:
    values = struct.unpack("<BBH" + "HHH" * SAMPLES + "H", frame)
    return Lds01Packet(values[1] - _FIRST, values[2] / 10, values[3:-1:3], values[4:-1:3])


class Lds01(SerialSource):
    """Turns from its start command to its stop command."""

    name = "LDS-01"
    samples_hz, turns_hz = 1800.0, 5.0  # 300 rpm, fixed

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        self._decoder = Lds01Decoder()
        super().__init__(options, lidar, clock, BAUD, self._decoder)
        self.link.wording = Wording(
            Spelling(as_one_frame, describe_command), Spelling(Lds01Decoder().feed, describe)
        )
        self._last: int | None = None  # number of the newest packet
        self._active_ns = 0  # time of the last start command or packet

    def connected(self) -> None:
        """Start the lidar."""
        self._last = None
        self._start()

    def received(self, data: bytes) -> None:
        """Decode packets; keep partial ones."""
        now_ns = self.clock.now_ns()
        for packet in self._decoder.feed(data):
            turn_at = 0 if self._last is not None and packet.number <= self._last else None
            self.understood, self._last, self._active_ns = True, packet.number, now_ns
            first = packet.number * SAMPLES + 1  # the vendor's driver puts sample 0 at 359
            angles = range(first, first + SAMPLES)
            self.emit_scan(self.turn.add_samples(angles, packet.ranges, turn_at, now_ns))

    def watch_scans(self, now_ns: int) -> None:
        """Start the lidar again if it does not turn: it may have had no power before."""
        super().watch_scans(now_ns)
        if now_ns - self._active_ns > RESTART_NS:
            self._start()

    def probe(self, port: serial.Serial) -> bool:
        """Return whether this port sends packets after a start command."""
        port.write(START)
        found = len(Lds01Decoder().feed(port.read(PROBE_BYTES))) >= PROBE_PACKETS
        if not found:
            port.write(STOP)
        return found

    def send_stop(self) -> bool:
        """Stop the lidar."""
        return self.link.write(STOP)

    def _start(self) -> None:
        self._active_ns = self.clock.now_ns()
        self.link.write(START)
