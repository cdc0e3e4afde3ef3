"""Debouncing of faults: for how many ticks of the robot's clock one has lasted."""

import math

from gigabrain_schemas.base import TICK_NS

MAX_STEP_TICKS = 5  # a sample after a longer gap counts for no more than this


def ticks_of(seconds: float) -> int:
    """Return the whole ticks that last at least `seconds`."""
    return math.ceil(seconds * 1e9 / TICK_NS - 1e-9)


def lasting(ticks: int, wrong: bool, elapsed: int) -> int:
    """Return the count of ticks for which a fault has lasted without a break."""
    return ticks + elapsed if wrong else 0
