"""Simulated bodies: MuJoCo physics, worlds, sensors and the truth about them.

Imports `driver` and `kinematics`; `emulators` and pictures use it. Time goes on in whole steps, so
that it never drifts; two of them are a tick of the robot's clock.
"""

import math
import time

from gigabrain_schemas.base import TICK_S

STEP_NS = 10_000_000  # one advance of the physics
STEP_S = STEP_NS / 1e9
LATE_S = 0.25  # further behind than this, time is dropped instead of raced after


def exposes(rate_hz: float, tick: int) -> bool:
    """Return whether a camera of this rate takes a picture at the end of a tick."""
    per_tick = rate_hz * TICK_S
    return math.floor(tick * per_tick + 1e-9) > math.floor((tick - 1) * per_tick + 1e-9)


class Pace:
    """Absolute deadlines, `step_s` [s] apart, counted from the making of this."""

    def __init__(self, step_s: float) -> None:
        self._step_s, self._start_s, self._done = step_s, time.perf_counter(), 0
        self.dropped_s = 0.0  # all together

    def wait(self, steps: int = 1) -> None:
        """Sleep until the deadline that lies `steps` behind the last one."""
        self._done += steps
        wait = self._start_s + self._done * self._step_s - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        elif wait < -LATE_S:
            self._start_s -= wait
            self.dropped_s -= wait
