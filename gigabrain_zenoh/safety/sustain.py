"""How long something has been wrong, in ticks of the robot's clock."""

import math

from gigabrain_schemas.base import TICK_NS

LONGEST_STEP_TICKS = 5  # a sample after a longer gap speaks for no more than this


def ticks_of(seconds: float) -> int:
    """Whole ticks that last at least `seconds`."""
    return math.ceil(seconds * 1e9 / TICK_NS - 1e-9)


def held(ticks: int, wrong: bool, elapsed: int) -> int:
    """The count of ticks for which it has been `wrong` without a break."""
    return ticks + elapsed if wrong else 0
