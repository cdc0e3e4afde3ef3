"""What a node goes by, in its own order: kept by nobody, said on the bus, or as it was once.

Messages give way to newer ones while a process is busy, and work beside is done in time or is not.
Whoever asks a node again, in a replay, has to know which of that there was.
"""

import concurrent.futures
from collections import deque
from collections.abc import Callable
from typing import Any

from gigabrain_schemas.heard import MOST, WAITED, Heard, Taken
from gigabrain_zenoh.host.bounded import put

Job = concurrent.futures.Future[Any]
EVERY_NS = 500_000_000  # from one word about it to the next
ROOM = MOST // 2  # entries that may wait; one more may be added while they are said
MOST_KEYS = 512  # of which the newest number is known
HIGHEST = 2**63 - 1


def done(job: Job, patience_s: float | None) -> bool:
    """Whether `job` is done after that long at most."""
    finished, _ = concurrent.futures.wait((job,), patience_s)
    return bool(finished)


class Journal:
    """Kept by nobody."""

    live = True  # whether what the node does has effects beside the bus

    def note(self, key: str, seq: int) -> None:
        """A message is looked at."""

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Whether work beside is done after that long at most. What follows may rest on it."""
        return done(job, patience_s)

    def flush(self) -> None:
        """Say what has not been said yet."""


class SaidJournal(Journal):
    """Said on the bus twice a second, as long as there is anything to say."""

    def __init__(self, say: Callable[[Heard], object], unix_ns: Callable[[], int]) -> None:
        self._say, self._unix_ns = say, unix_ns
        self._keys: dict[str, int] = {}
        self._taken: list[Taken] = []
        self._last: dict[str, int] = {}  # seq by key
        self._began_ns = 0

    def note(self, key: str, seq: int) -> None:
        """A message is looked at; by several parts of a node in turn, it is one."""
        if seq and self._last.get(key) == seq:
            return
        put(self._last, key, seq, MOST_KEYS)
        self._add(key, seq)

    def in_time(self, job: Job, patience_s: float) -> bool:
        """As it was, which is written down."""
        there = done(job, patience_s)
        self._add(WAITED, int(there))
        return there

    def flush(self) -> None:
        """Say what has not been said yet."""
        taken, keys = self._taken, tuple(self._keys)
        if taken:
            self._taken, self._keys = [], {}
            self._say(Heard(began_ns=self._began_ns, keys=keys, taken=tuple(taken)))

    def _add(self, key: str, seq: int) -> None:
        now_ns = self._unix_ns()
        after_ns = now_ns - self._began_ns
        if self._taken and (not 0 <= after_ns < EVERY_NS or len(self._taken) >= ROOM):
            self.flush()
        if not self._taken:
            self._began_ns, after_ns = now_ns, 0
        index = self._keys.setdefault(key, len(self._keys))
        self._taken.append(Taken(index, min(seq, HIGHEST), after_ns // 1000))


class PastJournal(Journal):
    """As it was: what was done in time then is waited for now, all else counts as undone."""

    live = False

    def __init__(self) -> None:
        self.outcomes: deque[bool] = deque()  # of what is waited for at the present message

    def in_time(self, job: Job, patience_s: float) -> bool:
        """As it was then; of work that nobody waited for then, once it is done."""
        there = self.outcomes.popleft() if self.outcomes else True
        return there and done(job, None)
