"""Two processes on one network inside this one, on a clock that the test moves."""

import asyncio
import threading
from collections.abc import Callable

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.host.journal import Job, Journal, done
from gigabrain_zenoh.qa.faults.waiting import PATIENCE_S


class PatientJournal(Journal):
    """Waits for a node's background work however slow this machine is.

    For rigs that compare results; what a node does when its work is late has tests of its own.
    """

    def in_time(self, job: Job, patience_s: float) -> bool:
        return done(job, PATIENCE_S)


class Net:
    """Two processes on one network, on one clock."""

    def __init__(self) -> None:
        self.network, self.clock = LocalNetwork(), FakeClock()
        self.one, self.two = self.bus("one"), self.bus("two")

    def bus(self, process: str) -> Bus:
        return Bus(self.network.transport(), self.clock, process)


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0)


async def until(condition: Callable[[], object], deadline_s: float = 60.0) -> None:
    """Wait until `condition` holds. Raises TimeoutError when it never does."""
    async with asyncio.timeout(deadline_s):
        while not condition():  # noqa: ASYNC110 - what is waited for is set by threads
            await asyncio.sleep(0.001)


def in_thread(work: Callable[[], None]) -> threading.Thread:
    """A thread that has just begun to `work`."""
    thread = threading.Thread(target=work)
    thread.start()
    return thread
