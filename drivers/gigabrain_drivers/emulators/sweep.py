"""The beam of a turning lidar: what it hits in each direction, at the time it points there."""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from gigabrain_drivers.emulators.base import EmulatedBody, Snapshot
from gigabrain_drivers.sim.body import SimLidar
from gigabrain_drivers.sim.lidar import Lidar
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.streams import Stream, generator
from gigabrain_drivers.sim.tick import TICK_S

KEPT_S = 0.5  # samples of so long are kept when nobody takes them


class Sample(NamedTuple):
    """One measurement."""

    angle: float  # [deg], clockwise from ahead, 0 to 360
    distance: float  # [mm], 0 where nothing is in range


class Sweep:
    """Casts in the physics thread, each step of 10 ms the rays of the angle swept meanwhile.

    So a scan is bent by the robot's motion just as a real one is.
    """

    def __init__(self, body: EmulatedBody, range_min: float, range_max: float) -> None:
        config = SimLidar(range_min=range_min, range_max=range_max)
        self._data = body.simulation.data
        noise = generator(body.run.seed, Stream.LIDAR)
        self._lidar = Lidar(config, body.simulation.model, f"{ROBOT}lidar", noise)
        self._samples = deque[Sample]()
        self._rate_hz = self.turn_hz = self._angle = self._due = 0.0
        body.on_step.append(self._measure)

    def start(self, rate_hz: float, turn_hz: float) -> None:
        """Measure `rate_hz` samples a second from now on, at `turn_hz` turns a second."""
        self._samples = deque(maxlen=math.ceil(rate_hz * KEPT_S))
        self.turn_hz, self._rate_hz = turn_hz, rate_hz

    def stop(self) -> None:
        """Measure nothing."""
        self._rate_hz = 0.0
        self._samples.clear()

    def take(self, count: int) -> list[Sample]:
        """The next `count` samples, or none when there are not so many yet."""
        samples = self._samples
        return [samples.popleft() for _ in range(count)] if len(samples) >= count else []

    def _measure(self, _: Snapshot) -> None:
        rate_hz, turn_hz, samples = self._rate_hz, self.turn_hz, self._samples
        if not rate_hz or not turn_hz:
            return
        self._due += rate_hz * TICK_S
        count = int(self._due)
        self._due -= count
        step = 360 * turn_hz / rate_hz
        angles = (self._angle + step * np.arange(count)) % 360
        self._angle = (self._angle + step * count) % 360
        turned = np.radians(angles)
        directions = np.stack([np.cos(turned), -np.sin(turned), np.zeros(count)], axis=1)
        ranges = self._lidar.cast(self._data, directions)
        distances = np.where(np.isfinite(ranges), ranges * 1000, 0.0)
        samples.extend(map(Sample, angles.tolist(), distances.tolist()))
