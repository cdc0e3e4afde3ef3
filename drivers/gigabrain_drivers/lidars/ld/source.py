"""Source for LDROBOT lidars. They turn and send without a command."""

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import serial
from msgspec.structs import replace

from gigabrain_drivers.lidars.base import Samples, TurnBuffer
from gigabrain_drivers.lidars.ld import protocol as ld
from gigabrain_drivers.lidars.serial_source import SerialSource
from gigabrain_drivers.links.device_clock import DeviceClock
from gigabrain_drivers.links.frames import Spelling, Wording
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.clock import Clock

Correction = Callable[[Samples, Samples], tuple[Samples, Samples]]

POINTS, WHOLE = np.arange(ld.POINTS), slice(None)
PROBE_BYTES = 300  # at least five frames
PROBE_FRAMES = 3

OFFSET_X, OFFSET_Y = 5.9, -20.14  # [mm], of the lens from the axis
SLANT = 0.11923  # slope of the beam against the reported direction


class FrameBuffer(TurnBuffer[tuple[bytes, slice]]):
    """Collects a turn as frames; of its first and last frame, perhaps only some points."""

    def __init__(self, lidar: Lidar, correct: Correction) -> None:
        super().__init__(lidar)
        self._correct = correct

    def unpack(self, pieces: list[tuple[bytes, slice]]) -> tuple[Samples, Samples]:
        """Decode all frames at once."""
        angles, distances = self._correct(*ld.points(b"".join(raw for raw, _ in pieces)))
        kept = np.concatenate([POINTS[part] + n * ld.POINTS for n, (_, part) in enumerate(pieces)])
        return angles[kept], distances[kept]

    def add_frame(self, raw: bytes, turn_at: int | None, now_ns: int) -> LaserScan | None:
        """Add a frame; `turn_at` is its first point of a new turn, which ends the current scan."""
        if turn_at is None:
            self.add((raw, WHOLE), ld.POINTS, now_ns)
            return None
        if turn_at:
            self.add((raw, slice(turn_at)), turn_at, now_ns)
        scan = self.finish(now_ns)
        self.add((raw, slice(turn_at, None)), ld.POINTS - turn_at, now_ns)
        return scan


class Ld(SerialSource):
    """A lidar that sends LD frames. Subclasses set the model, its baud rate and its corrections.

    Its 0 mm means free space, or an object that it cannot measure. If that matters, set
    `no_return: unknown` in the body's file.
    """

    samples_hz = 4500.0
    rate_baud: ClassVar[int]

    def __init__(self, options: Any, lidar: Lidar, clock: Clock) -> None:
        self._decoder = ld.LdDecoder()
        super().__init__(options, lidar, clock, self.rate_baud, self._decoder)
        self.link.wording = Wording(received=Spelling(ld.LdDecoder().feed, ld.describe))
        self._frames = FrameBuffer(lidar, self.to_axis)
        self._stamps = DeviceClock(ld.CLOCK_MS)
        self._last: int | None = None  # [0.01 deg], of the newest sample

    def to_axis(self, angles: Samples, distances: Samples) -> tuple[Samples, Samples]:
        """Return angles (n,) [deg] and distances (n,) [mm] as seen from the axis."""
        return angles, distances

    def connected(self) -> None:
        """Reset all state for a new stream."""
        self._frames.clear()
        self._stamps.clear()
        self._last = None

    def received(self, data: bytes) -> None:
        """Decode frames; keep partial ones."""
        now_ns = self.clock.now_ns()
        for raw in self._decoder.cut(data):
            self.understood = True
            self._stamps.arrived(raw.time_ms, now_ns)
            turn_at, self._last = turn_start(raw, self._last), raw.end
            scan = self._frames.add_frame(raw.data, turn_at, now_ns)
            self.emit_scan(replace(scan, late_ms=self._stamps.late_ms) if scan else None)

    def probe(self, port: serial.Serial) -> bool:
        """Return whether this port sends frames."""
        return len(ld.LdDecoder().feed(port.read(PROBE_BYTES))) >= PROBE_FRAMES


class Ld06(Ld):
    """LDROBOT LD06."""

    name, rate_baud = "LD06", 230_400


class Ld19(Ld):
    """LDROBOT LD19, also sold as STL-19P, D200 and D300."""

    name, rate_baud = "LD19", 230_400


def turn_start(raw: ld.RawFrame, last: int | None) -> int | None:
    """Return the first point of a frame in a new turn since `last` [0.01 deg], or None."""
    if last is not None and raw.start < last - ld.TURN // 2:
        return 0
    if raw.end >= raw.start:
        return None
    step = (raw.end - raw.start) % ld.TURN / (ld.POINTS - 1)
    return min(math.ceil((ld.TURN - raw.start) / step), ld.POINTS - 1)


class Lds02(Ld):
    """LDS-02 (LDROBOT LD08), the lidar of most TurtleBot3. Its lens is not on the axis."""

    name, rate_baud = "LDS-02", 115_200
    samples_hz = 2300.0

    def to_axis(self, angles: Samples, distances: Samples) -> tuple[Samples, Samples]:
        """Convert measurements by the lens to those from the axis."""
        return seen_from_axis(angles, distances)


def seen_from_axis(angles: Samples, distances: Samples) -> tuple[Samples, Samples]:
    """Convert measurements (n,) by the lens ([deg] clockwise, [mm]) to those from the axis.

    Source: the vendor's ld08_driver, `SlTransform`. A missing return (0 mm) keeps its angle.
    """
    x, y = distances + OFFSET_X, SLANT * distances + OFFSET_Y
    seen = distances != 0
    turned = angles - np.degrees(np.arctan2(y, x))
    return np.where(seen, turned, angles), np.where(seen, np.hypot(x, y), distances)
