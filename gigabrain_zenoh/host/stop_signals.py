"""Stop signals inside an event loop: work stops in an orderly way."""

import asyncio
from collections.abc import Coroutine, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from gigabrain_zenoh.host.interrupts import LIMIT_S, interrupts

T = TypeVar("T")


@contextmanager
def stop_signals(limit_s: float = LIMIT_S) -> Iterator[asyncio.Event]:
    """Yield an event that the first SIGINT, SIGTERM or SIGHUP sets; further signals do nothing.

    A command that has not ended `limit_s` after the signal is terminated by force.
    """
    stop, loop = asyncio.Event(), asyncio.get_running_loop()

    def react() -> None:
        loop.call_soon_threadsafe(stop.set)

    interrupts.limit_s = limit_s
    with interrupts.installed(), interrupts.reacting(react):
        yield stop


def run_async(work: Coroutine[Any, Any, T]) -> T:
    """Run a command's coroutine until it ends; the first signal cancels it.

    Raises KeyboardInterrupt if a signal ended it. Unlike `asyncio.run`, it also does so for SIGTERM
    and SIGHUP, and never interrupts asyncio's own code. It also receives SIGINT where a shell has
    set it to be ignored.
    """

    async def cancelled_by_signal() -> T:
        loop, task = asyncio.get_running_loop(), asyncio.current_task()
        assert task

        def react() -> None:
            loop.call_soon_threadsafe(task.cancel)

        with interrupts.reacting(react):
            return await work

    with interrupts.reacting(None):
        try:
            return asyncio.run(cancelled_by_signal())
        except asyncio.CancelledError:
            if not interrupts.received:
                raise
            raise KeyboardInterrupt from None
