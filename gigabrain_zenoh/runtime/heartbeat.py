"""A supervised process reports progress to its supervisor once a second.

Progress is judged by output per input. A loop that runs while scans arrive and no worlds are
published makes none; a process without input has nothing to do, and is healthy.
A beat is a log record like any other, which the supervisor does not show.
"""

import os
import select
from collections.abc import Callable

import msgspec

from gigabrain_zenoh.clock import Clock

EVENT = "progress"
PERIOD_NS = 1_000_000_000
STALL_S = 5.0  # without progress for this time a process counts as stuck
LOOK_S = 0.25  # how often a supervisor looks
STDOUT = 1
_LINE = msgspec.json.encode({"event": EVENT, "level": "debug"}) + b"\n"


class Progress:
    """Compares what came in with what was done, since the last call.

    `came` returns a value for each input that the work needs, which changes with every arrival;
    nothing where the process cannot work yet. `done` changes with each piece of work.
    """

    def __init__(self, came: Callable[[], tuple[object, ...]], done: Callable[[], object]) -> None:
        self._came, self._done = came, done
        self._before = came(), done()

    def __call__(self) -> bool:
        """Return whether something was done, or there was nothing to do."""
        (came, done), self._before = self._before, (self._came(), self._done())
        now = self._before[0]
        fed = len(now) == len(came) > 0 and all(a != b for a, b in zip(came, now, strict=True))
        return self._before[1] != done or not fed


class Silence:
    """Time without progress of a process [s], counted only while its supervisor ran.

    A suspended machine or a stopped supervisor is no reason to kill a process: of the time between
    two checks at most `LOOK_S` counts.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def end(self) -> None:
        """Start again from zero, after a beat."""
        self.seconds = 0.0

    def add(self, passed_s: float) -> bool:
        """Add the time since the last look; return whether the process is stuck."""
        self.seconds += min(passed_s, LOOK_S)
        return self.seconds >= STALL_S


async def beat(clock: Clock, progress: Callable[[], bool], out: int) -> None:
    """Write a line in each second with progress, until cancelled."""
    progress()  # counts from now on
    async for _ in clock.every(PERIOD_NS):
        if progress() and _has_room(out):
            os.write(out, _LINE)


def _has_room(out: int) -> bool:
    """Return whether a line fits: a stopped supervisor must not block its processes."""
    return bool(select.select((), (out,), (), 0)[1])
