"""LDS-01 (HLS-LFCD2), TurtleBot3's first lidar: 360 samples a turn, five turns a second."""

from typing import Any

import serial

from gigabrain_drivers.lidars.lds import lds01 as lds01
from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_drivers.links.wording import Spelling, Wording, whole
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

PROBE_BYTES = 600  # fourteen packets
PROBE_PACKETS = 3
RESTART_NS = 1_000_000_000  # without a packet, until it is started again
LAST_WORD_NS = 20_000_000  # until a command has left the port


class Lds01(SerialSource):
    """Turns from its start command to its stop command."""

    name = "LDS-01"
    samples_hz, turns_hz = 1800.0, 5.0  # 300 rpm; it takes no speed

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        super().__init__(options, lidar, clock, lds01.BAUD)
        self.link.wording = Wording(
            Spelling(whole, lds01.describe_command), Spelling(lds01.Decoder().feed, lds01.describe)
        )
        self._decoder = lds01.Decoder()
        self._last: int | None = None  # number of the newest packet
        self._told_ns = 0  # when it was last told to start, or last seen to turn

    def connected(self) -> None:
        """Start it."""
        self._decoder.clear()
        self._last = None
        self._start()

    def received(self, data: bytes) -> None:
        """Packets, or parts of them."""
        now_ns = self.clock.now_ns()
        for packet in self._decoder.feed(data):
            turn_at = 0 if self._last is not None and packet.number <= self._last else None
            self._last, self._told_ns = packet.number, now_ns
            first = packet.number * lds01.SAMPLES + 1  # the vendor's driver puts sample 0 at 359
            angles = range(first, first + lds01.SAMPLES)
            self.finished(self.turn.clockwise(angles, packet.ranges, turn_at, now_ns))
        self.link.errors = self._decoder.errors

    def look(self, now_ns: int) -> None:
        """Start it again where it does not turn: it may have had no power before."""
        super().look(now_ns)
        if now_ns - self._told_ns > RESTART_NS:
            self._start()

    def understands(self) -> bool:
        """Whether packets come."""
        return self._last is not None

    def probe(self, port: serial.Serial) -> bool:
        """Whether packets come from this port once it is told to start."""
        port.write(lds01.START)
        found = len(lds01.Decoder().feed(port.read(PROBE_BYTES))) >= PROBE_PACKETS
        if not found:
            port.write(lds01.STOP)
        return found

    async def close(self) -> None:
        """Stop it, and free the port."""
        if self.link.write(lds01.STOP):
            await self.clock.sleep_ns(LAST_WORD_NS)
        await super().close()

    def _start(self) -> None:
        self._told_ns = self.clock.now_ns()
        self.link.write(lds01.START)
