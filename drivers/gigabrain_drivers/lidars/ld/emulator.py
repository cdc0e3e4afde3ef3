"""Emulated LDROBOT lidars. They turn and send from power-on, and have no input."""

import math
from collections import deque
from typing import Any, ClassVar

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Sample, Sweep, Wire
from gigabrain_drivers.lidars.ld import protocol as ld

MAX_SAG_VOLTS = 0.5  # below 5 V; with a larger sag, the motor does not keep its speed
LENS_X, LENS_Y, SLANT = 5.9, -20.14, 0.11923  # [mm], [mm], slope; LDS-02's beam misses the axis
RAYS_PER_SAMPLE = 4  # of LDS-02
RAY_DELAY_DEG = 3.0  # samples are behind the newest ray: the beam's slope needs rays on both sides
MAX_RAYS = 60  # newest rays, 23 degrees


class LdDevice(Device):
    """LD06 and LD19. Subclasses are other models that send the same frame."""

    Options = ScanOptions
    baud: ClassVar[int | None] = 230_400
    samples_hz: ClassVar[float] = 4500
    reach: ClassVar[tuple[float, float]] = 0.02, 12.0  # [m]

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._sweep = Sweep(body, *self.reach)
        self._turn_hz = body.robot.lidar.rate_hz if body.robot.lidar else 10.0

    def feed(self, data: bytes) -> None:
        """Ignore all bytes."""

    def reset(self) -> None:
        """Start to turn."""
        self._sweep.start(self.samples_hz, self._turn_hz)

    def step(self, now_ns: int) -> None:
        """Send all whole frames that were measured since the last step."""
        while samples := self._sweep.next_samples(ld.POINTS):
            if self.sag_volts <= MAX_SAG_VOLTS:
                self.wire.write(ld.encode(self._frame([self.measured(s) for s in samples])))

    def measured(self, sample: Sample) -> Sample:
        """Return a sample as this model sends it, without the host's corrections."""
        return sample

    def _frame(self, samples: list[Sample]) -> ld.LdFrame:
        distances = tuple(min(0xFFFF, round(sample.distance)) for sample in samples)
        return ld.LdFrame(
            speed=round(360 * self._turn_hz),
            start=round(samples[0].angle * 100) % ld.TURN,
            end=round(samples[-1].angle * 100) % ld.TURN,
            distances=distances,
            confidences=tuple(200 if distance else 0 for distance in distances),
            time_ms=self.body.clock_ns // 1_000_000 % ld.CLOCK_MS,
        )


class Lds02Device(LdDevice):
    """Sends LD frames of its lens, which is not on the axis, and whose beam is slanted."""

    baud = 115_200
    samples_hz = 2300
    reach = 0.16, 8.0

    def reset(self) -> None:
        """Start to turn."""
        self._rays = deque[Sample](maxlen=MAX_RAYS)
        self._waiting: list[Sample] = []  # for a complete frame
        self._sweep.start(self.samples_hz * RAYS_PER_SAMPLE, self._turn_hz)

    def step(self, now_ns: int) -> None:
        """Send all whole frames that were measured since the last step."""
        while rays := self._sweep.next_samples(RAYS_PER_SAMPLE):
            self._rays += rays
            if len(self._rays) == MAX_RAYS:
                self._waiting.append(self._lens_sample((rays[-1].angle - RAY_DELAY_DEG) % 360))
            if len(self._waiting) == ld.POINTS:
                frame, self._waiting = self._frame(self._waiting), []
                if self.sag_volts <= MAX_SAG_VOLTS:
                    self.wire.write(ld.encode(frame))

    def _lens_sample(self, angle: float) -> Sample:
        """Return what the lens measures when it reports `angle` [deg]."""
        distance, seen_at = 0.0, angle  # from the axis
        for _ in range(4):  # direction and distance depend on each other; this converges quickly
            distance = self._ray(seen_at).distance
            raw = lens_distance(distance) if distance else 1e6
            seen_at = angle - math.degrees(math.atan2(SLANT * raw + LENS_Y, raw + LENS_X))
        return Sample(angle, lens_distance(distance) if distance else 0.0)

    def _ray(self, angle: float) -> Sample:
        """Return the ray that is nearest to `angle` [deg]."""
        step = 360 * self._turn_hz / self.samples_hz / RAYS_PER_SAMPLE
        back = (self._rays[-1].angle - angle) % 360
        return self._rays[-1 - min(round(back / step), MAX_RAYS - 1)]


def lens_distance(distance: float) -> float:
    """Return the distance that LDS-02's lens measures to a point `distance` [mm] from the axis."""
    a, b = 1 + SLANT**2, LENS_X + SLANT * LENS_Y
    return (math.sqrt(max(b * b - a * (LENS_X**2 + LENS_Y**2 - distance**2), 0.0)) - b) / a
