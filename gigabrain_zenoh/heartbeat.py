"""A supervised process tells its supervisor once a second that it gets on with its work.

What counts is progress, not existence: a number that must have changed. On the supervisor's end of
the pipe it is a record like any other, which is not shown to people.
"""

import os
import select
from collections.abc import Callable

import msgspec

from gigabrain_zenoh.clock import Clock

EVENT = "progress"
PERIOD_NS = 1_000_000_000
STUCK_S = 3.5  # so long without a word, and a process counts as stuck
STDOUT = 1
_LINE = msgspec.json.encode({"event": EVENT, "level": "debug"}) + b"\n"


async def beat(clock: Clock, progress: Callable[[], int], out: int = STDOUT) -> None:
    """Until cancelled; says nothing in a second in which nothing was done."""
    done = progress()
    async for _ in clock.every(PERIOD_NS):
        before, done = done, progress()
        if done != before and _has_room(out):
            os.write(out, _LINE)


def _has_room(out: int) -> bool:
    """Whether a line fits: a supervisor that stands still must not hold its processes up."""
    return bool(select.select((), (out,), (), 0)[1])
