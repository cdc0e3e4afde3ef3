"""Tells whether a robot under test had its cores in time, by the kernel's account."""

import asyncio
from collections.abc import Callable, Iterable

from gigabrain_zenoh.host import this_process

LOOK_S = 0.1
DISTURBED_MS = 30.0  # of 100: a tick and a half in which a part of the robot could not run


class RunQueueWatch:
    """Notes the longest that one thread of some processes has waited for a core within 0.1 s.

    A core that a virtual machine's host gave to others counts as a thread that waited for it, and
    so does this program's own event loop where it is held up: it is the network and the people.
    """

    def __init__(self, processes: Callable[[], Iterable[int | str]]) -> None:
        self._processes = processes
        self._before: dict[tuple[int | str, str], int] = {}
        self._task: asyncio.Task[None] | None = None
        self.longest_ms = 0.0

    def start(self) -> None:
        """Begin to look, ten times a second."""
        self._task = asyncio.create_task(self._watch())

    def close(self) -> None:
        """Look no more."""
        if self._task:
            self._task.cancel()

    def look(self) -> None:
        """Compare with the last look; threads that were not there then are not judged."""
        now = {
            (process, thread): waited_ns
            for process in self._processes()
            for thread, waited_ns in this_process.waited_ns_by_thread(process).items()
        }
        now |= {
            ("host", core): stolen_ns
            for core, stolen_ns in this_process.stolen_ns_by_core().items()
        }
        waits = (waited - self._before.get(thread, waited) for thread, waited in now.items())
        self.longest_ms = max(self.longest_ms, max(waits, default=0) / 1e6)
        self._before = now

    async def _watch(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            self.look()
            due_s = loop.time() + LOOK_S
            await asyncio.sleep(LOOK_S)
            self.longest_ms = max(self.longest_ms, (loop.time() - due_s) * 1e3)
