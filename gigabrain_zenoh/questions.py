"""Queries on their way to the loop: bounded, a few at a time, and the urgent ones first.

Whoever may ask anything at all can ask by the thousand; neither the robot's ticks nor an e-stop
may wait for that.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Generic, TypeVar

from gigabrain_zenoh.bridge import Bridge
from gigabrain_zenoh.transport import Close

T = TypeVar("T")

WAITING = 32  # queries of a key that may wait; the oldest give way
ANSWERING = 32  # queries of a key that are being answered
SLICE = 4  # queries begun in one turn of the loop


class _Key(Generic[T]):
    """The queries of one key."""

    def __init__(self, answer: Callable[[T], Awaitable[None]], urgent: bool) -> None:
        self.answer, self.urgent = answer, urgent
        self.waiting: deque[T] = deque()
        self.answering = 0

    @property
    def ready(self) -> bool:
        """Whether one can be begun; an urgent one always can, its answer may wait for a disk."""
        return bool(self.waiting) and (self.urgent or self.answering < ANSWERING)


class Questions(Generic[T]):
    """All queries of a process; `refuse` is called for those that give way, in any thread."""

    def __init__(self, bridge: Bridge, refuse: Callable[[T], None]) -> None:
        self._bridge, self._refuse = bridge, refuse
        self._urgent: deque[_Key[T]] = deque()
        self._others: deque[_Key[T]] = deque()
        self._tasks: set[asyncio.Task[None]] = set()
        self._posted = False

    def serve(
        self, answer: Callable[[T], Awaitable[None]], *, urgent: bool
    ) -> tuple[Callable[[T], None], Close]:
        """Where to put queries of one more key, from any thread, and what ends it."""
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
        """Answer no more."""
        self._urgent.clear()
        self._others.clear()
        for task in self._tasks:
            task.cancel()

    def _wake(self) -> None:
        if not self._posted:
            self._posted = True
            self._bridge.post(Questions._begin, self)

    def _begin(self) -> None:
        """Begin a few; the others wait for the next turn of the loop."""
        self._posted = False  # before looking: what comes now wakes again
        for _ in range(SLICE):
            if not (key := self._next()):
                return
            key.answering += 1
            task = asyncio.get_running_loop().create_task(self._answer(key, key.waiting.popleft()))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        self._wake()

    def _next(self) -> _Key[T] | None:
        """The next key's turn; those that are urgent always have it."""
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
