"""Simulated bodies: MuJoCo physics, worlds, sensors and the truth about them.

Imports `driver` and `kinematics`; `emulators` and `cameras` import it. Time advances in whole
steps, so it never drifts. Two steps are one tick of the robot's clock.
"""

import math
import time

from gigabrain_schemas.base import TICK_S

STEP_NS = 10_000_000  # one step of the physics
STEP_S = STEP_NS / 1e9
MAX_LAG_S = 0.25  # beyond this lag, time is dropped, not caught up


def exposes(rate_hz: float, tick: int) -> bool:
    """Return whether a camera of this rate takes a picture at the end of a tick."""
    per_tick = rate_hz * TICK_S
    return math.floor(tick * per_tick + 1e-9) > math.floor((tick - 1) * per_tick + 1e-9)


class Pace:
    """Absolute deadlines, `step_s` [s] apart, from the creation of this object."""

    def __init__(self, step_s: float) -> None:
        self._step_s, self._start_s, self._done = step_s, time.perf_counter(), 0
        self.dropped_s = 0.0  # in total

    def wait(self, steps: int = 1) -> None:
        """Sleep until the deadline `steps` steps after the last one."""
        self._done += steps
        wait = self._start_s + self._done * self._step_s - time.perf_counter()
        if wait > 0:
            time.sleep(wait)
        elif wait < -MAX_LAG_S:
            self._start_s -= wait
            self.dropped_s -= wait
