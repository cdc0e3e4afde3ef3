"""Queues queries for the event loop: bounded, a few per loop turn, urgent ones first.

Any client may send thousands of queries. Neither the robot's ticks nor an e-stop may wait for them.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

from gigabrain_zenoh.bus.bridge import Bridge
from gigabrain_zenoh.bus.transport import Close

T = TypeVar("T")

WAITING = 32  # queries of a key that may wait; beyond that the oldest are refused
ANSWERING = 32  # queries of a key that are answered concurrently, unless urgent
SLICE = 4  # queries started in one turn of the loop


class _Key(Generic[T]):
    """Waiting queries of one key."""

    def __init__(self, answer: Callable[[T], Awaitable[None]], urgent: bool) -> None:
        self.answer, self.urgent = answer, urgent
        self.waiting: deque[T] = deque()
        self.answering = 0

    @property
    def ready(self) -> bool:
        """Return whether a waiting query may start.

        Urgent queries are not limited, as their answers may wait for a disk.
        """
        return bool(self.waiting) and (self.urgent or self.answering < ANSWERING)


class Questions(Generic[T]):
    """All queries of a process; `refuse` is called for dropped queries, from any thread."""

    def __init__(self, bridge: Bridge, refuse: Callable[[T], None]) -> None:
        self._bridge, self._refuse = bridge, refuse
        self._urgent: deque[_Key[T]] = deque()
        self._others: deque[_Key[T]] = deque()
        self._tasks: set[asyncio.Task[None]] = set()
        self._posted = False

    def serve(
        self, answer: Callable[[T], Awaitable[None]], *, urgent: bool
    ) -> tuple[Callable[[T], None], Close]:
        """Register a key; return a function that adds a query, and one that closes the key.

        Queries may be added from any thread.
        """
        key = _Key(answer, urgent)
        keys = self._urgent if urgent else self._others
        keys.append(key)

        def put(query: T) -> None:
            key.waiting.append(query)
            while len(key.waiting) > WAITING:
                self._refuse(key.waiting.popleft())
            self._wake()

        def close() -> None:
            if key in keys:
                keys.remove(key)
            while key.waiting:
                self._refuse(key.waiting.popleft())

        return put, close

    def close(self) -> None:
        """Cancel running answers and start no more."""
        self._urgent.clear()
        self._others.clear()
        for task in self._tasks:
            task.cancel()

    def _wake(self) -> None:
        if not self._posted:
            self._posted = True
            self._bridge.post(Questions._begin, self)

    def _begin(self) -> None:
        """Start up to SLICE queries; the others wait for the next turn of the loop."""
        self._posted = False  # before reading, so that new queries wake the loop again
        for _ in range(SLICE):
            if not (key := self._next()):
                return
            key.answering += 1
            task = asyncio.get_running_loop().create_task(self._answer(key, key.waiting.popleft()))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        self._wake()

    def _next(self) -> _Key[T] | None:
        """Return the next key with a query to start: urgent keys first, then round-robin."""
        for keys in (self._urgent, self._others):
            for _ in range(len(keys)):
                keys.rotate(-1)
                if keys[-1].ready:
                    return keys[-1]
        return None

    async def _answer(self, key: _Key[T], query: T) -> None:
        try:
            await key.answer(query)
        finally:
            key.answering -= 1
            if key.waiting:
                self._wake()
