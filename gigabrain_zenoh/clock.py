"""Time. Everything that waits or measures takes a Clock, so tests can run without waiting."""

import asyncio
import heapq
import itertools
import time
from collections.abc import AsyncIterator


class Clock:
    """The host's clocks."""

    def now_ns(self) -> int:
        """Return the time since an arbitrary start [ns]; it never goes backwards."""
        return time.monotonic_ns()

    def unix_ns(self) -> int:
        """Return the time since 1970 [ns], for people and recordings; it may jump."""
        return time.time_ns()

    def boot_ns(self) -> int:
        """Return the time since an arbitrary start [ns], including suspended time.

        It does not jump when the clock is set. A host without such a clock returns Unix time.
        """
        boot = getattr(time, "CLOCK_BOOTTIME", None)
        return time.time_ns() if boot is None else time.clock_gettime_ns(boot)

    async def sleep_ns(self, duration_ns: int) -> None:
        """Let other tasks run for `duration_ns`."""
        await asyncio.sleep(duration_ns / 1e9)

    async def every(self, period_ns: int) -> AsyncIterator[int]:
        """Yield the current time [ns] each period. Missed periods are skipped, not caught up.

        All later times are whole periods after the first.
        """
        due = self.now_ns()
        while True:
            now = self.now_ns()
            yield now
            due += period_ns * max(1, (now - due) // period_ns + 1)
            await self.sleep_ns(max(0, due - self.now_ns()))


class FakeClock(Clock):
    """A clock the test moves. Sleepers wake in order of their due time, so runs repeat exactly."""

    def __init__(self) -> None:
        self._now = 0
        self._sleepers: list[tuple[int, int, asyncio.Future[None]]] = []
        self._count = itertools.count()

    def now_ns(self) -> int:
        """Current fake time [ns]."""
        return self._now

    def unix_ns(self) -> int:
        """Current fake time after 2001-09-09 [ns]."""
        return 1_000_000_000_000_000_000 + self._now

    def boot_ns(self) -> int:
        """Current fake time [ns]."""
        return self._now

    async def sleep_ns(self, duration_ns: int) -> None:
        """Wait until the test has moved the clock far enough."""
        wake: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (self._now + duration_ns, next(self._count), wake))
        await wake

    async def advance(self, duration_ns: int) -> None:
        """Move time forward, waking sleepers on the way."""
        end = self._now + duration_ns
        await self._settle()
        while self._sleepers and self._sleepers[0][0] <= end:
            due, _, wake = heapq.heappop(self._sleepers)
            self._now = max(self._now, due)
            if not wake.done():
                wake.set_result(None)
            await self._settle()
        self._now = end

    def stall(self, duration_ns: int) -> None:
        """Move time forward without waking sleepers, as on a suspended machine."""
        self._now += duration_ns

    async def _settle(self) -> None:
        for _ in range(10):  # more task switches than any node needs between two sleeps
            await asyncio.sleep(0)
