"""A supervised process reports progress to its supervisor once a second.

Progress means work for the inputs that arrive: a loop that gets scans but publishes no worlds makes
none. A process without input has nothing to do, and is healthy.
A beat is a log record that the supervisor does not show.
"""

import os
import select
from collections.abc import Callable

import msgspec

from gigabrain_zenoh.clock import Clock

EVENT = "progress"
PERIOD_NS = 1_000_000_000
STALL_S = 5.0  # without progress for this time a process counts as stuck
LOOK_S = 0.25  # period of the checks of a supervisor
STDOUT = 1
_LINE = msgspec.json.encode({"event": EVENT, "level": "debug"}) + b"\n"


class Progress:
    """Compares the arrived inputs with the work done since the last call.

    `inputs` returns one value per required input, which changes with each arrival; an empty tuple
    while the process cannot work yet. `work` returns a value that changes with each piece of work.
    """

    def __init__(
        self, inputs: Callable[[], tuple[object, ...]], work: Callable[[], object]
    ) -> None:
        self._inputs, self._work = inputs, work
        self._last = inputs(), work()

    def __call__(self) -> bool:
        """Return whether work was done, or there was nothing to do."""
        (before, work), self._last = self._last, (self._inputs(), self._work())
        now = self._last[0]
        fed = len(now) == len(before) > 0 and all(a != b for a, b in zip(before, now, strict=True))
        return self._last[1] != work or not fed


class Silence:
    """Time without progress of a process [s], counted only while its supervisor ran.

    A suspended machine or a stopped supervisor is no reason to kill a process. So at most `LOOK_S`
    of the time between two checks counts.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def end(self) -> None:
        """Start again from zero, after a beat."""
        self.seconds = 0.0

    def add(self, passed_s: float) -> bool:
        """Add the time since the last check; return whether the process is stuck."""
        self.seconds += min(passed_s, LOOK_S)
        return self.seconds >= STALL_S


async def beat(clock: Clock, progress: Callable[[], bool], out: int) -> None:
    """Write a line in each second with progress, until cancelled."""
    progress()  # forget earlier work
    async for _ in clock.every(PERIOD_NS):
        if progress() and _has_room(out):
            os.write(out, _LINE)


def _has_room(out: int) -> bool:
    """Return whether a line fits: a stopped supervisor must not block its processes."""
    return bool(select.select((), (out,), (), 0)[1])
