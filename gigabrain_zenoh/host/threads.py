"""Work in threads beside the event loop: results due at a given scan, and writes to slow disks."""

import asyncio
import concurrent.futures
import logging
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, Generic, TypeVar

Job = Future[Any]
PATIENCE_S = 0.1  # a scan waits this long for a result that is due
Take = Callable[[], None]  # uses the result, in the thread of `at_scan`
Work = Callable[[], Take]  # called in the worker thread
InTime = Callable[[Future[Any], float], bool]  # returns whether work is done within a time [s]


def done(job: Job, patience_s: float | None) -> bool:
    """Return whether `job` is done within `patience_s`."""
    finished, _ = concurrent.futures.wait((job,), patience_s)
    return bool(finished)


class ScheduledWorker:
    """One thread, with at most one piece of work at a time."""

    def __init__(self, patience_s: float = PATIENCE_S, in_time: InTime = done) -> None:
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="scheduled")
        self._job: Future[Take] | None = None
        self._scans_left = 0  # until the result is due
        self._patience_s, self._in_time = patience_s, in_time
        self.late = 0  # number of scans at which a result was due but not ready

    @property
    def idle(self) -> bool:
        """Return whether no work is in progress."""
        return self._job is None

    @property
    def overdue(self) -> int:
        """Return the number of scans since the result was due; 0 if none is."""
        return max(0, -self._scans_left) if self._job else 0

    def start(self, work: Work, scans: int) -> None:
        """Start `work`, whose result is due in `scans` scans."""
        self._job, self._scans_left = self._pool.submit(work), scans

    def hasten(self, scans: int) -> None:
        """Make the result of work in progress due in at most `scans` scans."""
        self._scans_left = min(self._scans_left, scans)

    def at_scan(self) -> None:
        """Use the result, if it is due at this scan and ready. Raises the error of the work."""
        if self._job is None:
            return
        self._scans_left -= 1
        if self._scans_left > 0:
            return
        if not self._in_time(self._job, self._patience_s):
            self.late += 1
            return
        job, self._job = self._job, None
        job.result()()

    def finish(self) -> None:
        """Wait for the work in progress, and use its result."""
        job, self._job = self._job, None
        if job:
            job.result()()

    def close(self) -> None:
        """End the thread after the work in progress."""
        self._pool.shutdown()


log = logging.getLogger(__name__)
T = TypeVar("T")


class BackgroundWriter(Generic[T]):
    """Queue whose items are passed to `write` in a worker thread, in order and in batches.

    The function `write` returns a problem in one line, or an empty text once all items are on disk.
    When more than `room` items wait, the oldest are dropped.
    """

    def __init__(self, write: Callable[[Sequence[T]], str], room: int) -> None:
        self._write = write
        self._items: deque[T] = deque(maxlen=room)
        self._waiting: list[asyncio.Future[str]] = []
        self._task: asyncio.Task[None] | None = None
        self.lost = 0  # number of dropped items

    def put(self, item: T) -> asyncio.Future[str]:
        """Queue `item` for writing; the future resolves to the problem, or to an empty text."""
        self.lost += len(self._items) == self._items.maxlen
        self._items.append(item)
        done: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self._waiting.append(done)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._work(), name="background_writer")
        return done

    async def close(self) -> None:
        """Wait until all items are written."""
        if self._task:
            await self._task

    async def _work(self) -> None:
        while self._waiting:
            items, self._items = tuple(self._items), deque(maxlen=self._items.maxlen)
            waiting, self._waiting = self._waiting, []
            try:
                problem = await asyncio.to_thread(self._write, items)
            except Exception as error:
                # any error must reach the waiting futures, and later items must still be written
                log.exception("writing failed")
                problem = f"{type(error).__name__}: {error}"
            for done in waiting:
                if not done.done():
                    done.set_result(problem)
