"""LDS-03 (COIN-D4), the lidar of the newest TurtleBot3."""

import math
from typing import Any

import serial

from gigabrain_drivers.lidars.lds import lds03 as lds03
from gigabrain_drivers.lidars.lds.lds03 import Sample
from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_drivers.links.wording import Spelling, Wording
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

PROBE_BYTES = 600
DTR_NS = 100_000_000  # after opening, until the terminal-ready line is cleared
START_NS = 1_000_000_000  # after opening, until it listens
RESTART_NS = 3_000_000_000  # without a packet, until it is stopped and started
LAST_WORD_NS = 20_000_000  # until a command has left the port
NEAR_MM, WEAK = 150, 65  # up to here, a sample this weak is a reflection of the housing
MIRROR_QUALITY = 255


class Lds03(SerialSource):
    """Turns from its start command to its stop command."""

    name = "LDS-03"
    samples_hz = 4000.0

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        super().__init__(options, lidar, clock, lds03.BAUD)
        self.link.wording = Wording(
            Spelling(lds03.CommandDecoder().feed, lds03.describe_command),
            Spelling(lds03.Decoder().feed, lds03.describe),
        )
        self._decoder = lds03.Decoder()
        self._cleared = self._started = self._understood = False
        self._told_ns = 0  # when it was last told something, or last seen to turn

    def connected(self) -> None:
        """Leave it alone for a second; then it is started by `look`."""
        self._decoder.clear()
        self._cleared = self._started = self._understood = False
        self._told_ns = self.clock.now_ns()

    def received(self, data: bytes) -> None:
        """Packets, or parts of them."""
        now_ns = self.clock.now_ns()
        for packet in self._decoder.feed(data):
            self._understood, self._told_ns = True, now_ns
            angles = [sample.angle for sample in packet.samples]
            distances = [trusted(sample) for sample in packet.samples]
            turn_at = 0 if packet.begins else None
            self.finished(self.turn.clockwise(angles, distances, turn_at, now_ns))
        self.link.errors = self._decoder.errors

    def look(self, now_ns: int) -> None:
        """Start it when it is ready for that, and once more where it does not turn."""
        super().look(now_ns)
        since = now_ns - self._told_ns
        if not self._cleared and since >= DTR_NS:
            self.link.set_dtr(False)
            self._cleared = True
        if not self._started and since >= START_NS:
            self._tell(lds03.START)
            self._started = True
        elif self._started and since >= RESTART_NS:
            self._tell(lds03.STOP)
            self._tell(lds03.START)

    def understands(self) -> bool:
        """Whether packets come."""
        return self._understood

    def probe(self, port: serial.Serial) -> bool:
        """Whether packets come from this port once it is told to start."""
        port.write(lds03.START)
        found = bool(lds03.Decoder().feed(port.read(PROBE_BYTES)))
        if not found:
            port.write(lds03.STOP)
        return found

    async def close(self) -> None:
        """Stop it, and free the port."""
        if self.link.write(lds03.STOP):
            await self.clock.sleep_ns(LAST_WORD_NS)
        await super().close()

    def _tell(self, command: bytes) -> None:
        self._told_ns = self.clock.now_ns()
        self.link.write(command)


def trusted(sample: Sample) -> float:
    """The distance [mm] of a sample, nan where it is too near and too weak to be believed.

    Source: the vendor's coin_d4_driver.
    """
    quality = MIRROR_QUALITY if sample.reflective else sample.quality
    if 0 < sample.distance <= NEAR_MM and quality <= WEAK:
        return math.nan
    return float(sample.distance)
