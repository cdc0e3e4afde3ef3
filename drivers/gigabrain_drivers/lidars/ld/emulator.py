"""An LDROBOT lidar: turns and sends from the moment it has power, and listens to nobody."""

from pathlib import Path
from typing import Any, ClassVar

from gigabrain_drivers.driver.robot import ScanOptions
from gigabrain_drivers.emulators.base import Device, EmulatedBody, Port, Wire
from gigabrain_drivers.emulators.pty import Pty
from gigabrain_drivers.emulators.sweep import Sample, Sweep
from gigabrain_drivers.lidars.ld import protocol as ld

LEAST_VOLTS = 0.5  # below its 5 V by more than this, the motor does not keep its speed


class LdDevice(Device):
    """LD06 and LD19. A subclass is another model that sends the same frame."""

    Options = ScanOptions
    baud: ClassVar[int] = 230_400
    samples_hz: ClassVar[float] = 4500
    reach: ClassVar[tuple[float, float]] = 0.02, 12.0  # [m]

    def __init__(self, body: EmulatedBody, options: Any, wire: Wire) -> None:
        super().__init__(body, options, wire)
        self._sweep = Sweep(body, *self.reach)
        self._turn_hz = body.robot.lidar.rate_hz if body.robot.lidar else 10.0

    @classmethod
    def port(cls, options: Any) -> Port:
        """A serial line at its only speed."""
        return Pty(Path(options.port), cls.baud)

    def feed(self, data: bytes) -> None:
        """It has no input."""

    def reset(self) -> None:
        """It starts to turn."""
        self._sweep.start(self.samples_hz, self._turn_hz)

    def step(self, now_ns: int) -> None:
        """All whole frames that were measured meanwhile."""
        while samples := self._sweep.take(ld.POINTS):
            if self.sag_volts <= LEAST_VOLTS:
                self.wire.write(ld.encode(self._frame([self.measured(s) for s in samples])))

    def measured(self, sample: Sample) -> Sample:
        """A sample as this model sends it, before any correction by the host."""
        return sample

    def _frame(self, samples: list[Sample]) -> ld.Frame:
        distances = tuple(min(0xFFFF, round(sample.distance)) for sample in samples)
        return ld.Frame(
            speed=round(360 * self._turn_hz),
            start=round(samples[0].angle * 100) % ld.TURN,
            end=round(samples[-1].angle * 100) % ld.TURN,
            distances=distances,
            confidences=tuple(200 if distance else 0 for distance in distances),
            time_ms=self.body.clock_ns // 1_000_000 % ld.CLOCK_MS,
        )
