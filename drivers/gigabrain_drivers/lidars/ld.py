"""LDROBOT's lidars: they turn and send by themselves as soon as they have power."""

from typing import Any, ClassVar

import serial

from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_drivers.links.wording import Spelling, Wording
from gigabrain_drivers.protocols import ld
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.clock import Clock

PROBE_BYTES = 300  # at least five frames
PROBE_FRAMES = 3


class Ld(SerialSource):
    """A lidar that sends LD frames. Subclasses name the model, its baud rate and its corrections.

    It has no way of saying whether a 0 means free space or nothing measurable, so a body's file
    says `no_return: unknown` of it where that matters.
    """

    samples_hz = 4500.0
    rate_baud: ClassVar[int]

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        super().__init__(options, lidar, clock, self.rate_baud)
        self.link.wording = Wording(received=Spelling(ld.Decoder().feed, ld.describe))
        self._decoder = ld.Decoder()
        self._last: float | None = None  # [deg], of the newest sample
        self._understood = False

    def place(self, frame: ld.Frame) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Angles [deg], clockwise, and distances [mm] of a frame's samples, (12,) each."""
        return frame.angles(), frame.distances

    def connected(self) -> None:
        """A new stream."""
        self._decoder.clear()
        self._last, self._understood = None, False

    def received(self, data: bytes) -> None:
        """Frames, or parts of them."""
        now_ns = self.clock.now_ns()
        for frame in self._decoder.feed(data):
            self._understood = True
            raw = frame.angles()
            turn_at, self._last = turn_start(raw, self._last), raw[-1] % 360
            angles, distances = self.place(frame)
            self.finished(self.turn.clockwise(angles, distances, turn_at, now_ns))
        self.link.errors = self._decoder.errors

    def understands(self) -> bool:
        """Whether frames come."""
        return self._understood

    def probe(self, port: serial.Serial) -> bool:
        """Whether frames come from this port."""
        return len(ld.Decoder().feed(port.read(PROBE_BYTES))) >= PROBE_FRAMES


class Ld06(Ld):
    """LDROBOT LD06."""

    name, rate_baud = "LD06", 230_400


class Ld19(Ld):
    """LDROBOT LD19, also sold as STL-19P, D200 and D300."""

    name, rate_baud = "LD19", 230_400


def turn_start(angles: tuple[float, ...], last: float | None) -> int | None:
    """Index of the first of `angles` (n,) [deg], rising, that is in another turn than `last`."""
    if last is not None and angles[0] % 360 < last - 180:
        return 0
    return next((n for n, angle in enumerate(angles) if angle >= 360), None)
