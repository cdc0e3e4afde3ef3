"""Writes files in a worker thread, so that a slow or full disk does not delay the event loop."""

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

log = logging.getLogger(__name__)

T = TypeVar("T")


class Scribe(Generic[T]):
    """Queue whose items are passed to `write` in a worker thread, in order and in batches.

    The function `write` returns a problem in one line, or an empty text once all is on disk. When
    more than `room` items wait, the oldest are dropped.
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
            self._task = asyncio.create_task(self._work(), name="scribe")
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
