"""Work beside the scans, whose result is taken at a scan that is fixed beforehand.

So what follows from it does not depend on how fast this machine is, unless it is too slow.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from gigabrain_zenoh.host.journal import done

PATIENCE_S = 0.1  # how long a scan waits for a result that is due

Take = Callable[[], None]  # makes the result count, in the scans' own thread
Work = Callable[[], Take]
InTime = Callable[[Future[Any], float], bool]  # whether work is done after so long [s]


class Background:
    """One thread, and at most one piece of work at a time."""

    def __init__(self, patience_s: float = PATIENCE_S, in_time: InTime = done) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="mapping")
        self._job: Future[Take] | None = None
        self._left = 0  # scans until the result is due
        self._patience_s, self._in_time = patience_s, in_time
        self.late = 0  # how often a result was not there when it was due

    @property
    def idle(self) -> bool:
        """Whether nothing is under way."""
        return self._job is None

    @property
    def overdue(self) -> int:
        """For how many scans a result has been due and not there."""
        return max(0, -self._left) if self._job else 0

    def start(self, work: Work, scans: int) -> None:
        """Begin; the result is due in so many scans."""
        self._job, self._left = self._pool.submit(work), scans

    def hasten(self, scans: int) -> None:
        """Make the result due in `scans` at most, if there is work under way."""
        self._left = min(self._left, scans)

    def at_scan(self) -> None:
        """Take the result, when it is due at this scan and there. Raises what the work raised."""
        if self._job is None:
            return
        self._left -= 1
        if self._left > 0:
            return
        if not self._in_time(self._job, self._patience_s):
            self.late += 1
            return
        job, self._job = self._job, None
        job.result()()

    def finish(self) -> None:
        """Take the result of what is under way, however long that takes."""
        job, self._job = self._job, None
        if job:
            job.result()()

    def close(self) -> None:
        """End the thread, after what is under way."""
        self._pool.shutdown()
