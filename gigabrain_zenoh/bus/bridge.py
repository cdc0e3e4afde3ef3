"""Hand-over from any thread to the event loop: bridge, mailbox, and queue of queries."""

import asyncio
import contextlib
import os
import socket
import threading
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Any, Generic, Protocol, TypeVar

from gigabrain_zenoh.bus.transport import Close


class Waker(Protocol):
    """A file descriptor that any thread can make readable, to wake the event loop."""

    def fileno(self) -> int:
        """Return the file descriptor that the loop watches."""
        ...

    def signal(self) -> None:
        """Make it readable."""
        ...

    def clear(self) -> None:
        """Make it unreadable, if it is readable."""
        ...

    def close(self) -> None:
        """Free the descriptors."""
        ...


class EventFd:
    """Waker with Linux's `eventfd`."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """Return the file descriptor that the loop watches."""
        return self._fd

    def signal(self) -> None:
        """Make it readable."""
        os.eventfd_write(self._fd, 1)

    def clear(self) -> None:
        """Make it unreadable, if it is readable."""
        try:  # suppress() would take three more calls per message
            os.eventfd_read(self._fd)
        except BlockingIOError:
            return

    def close(self) -> None:
        """Free the descriptor."""
        os.close(self._fd)


class SocketPair:
    """Waker with a pair of sockets, for macOS and Windows."""

    def __init__(self) -> None:
        self._read, self._write = socket.socketpair()
        self._read.setblocking(False)
        self._write.setblocking(False)

    def fileno(self) -> int:
        """Return the file descriptor that the loop watches."""
        return self._read.fileno()

    def signal(self) -> None:
        """Make it readable."""
        with contextlib.suppress(BlockingIOError):  # the buffer is full, so it is readable
            self._write.send(b"\1")

    def clear(self) -> None:
        """Make it unreadable, if it is readable."""
        with contextlib.suppress(BlockingIOError):
            self._read.recv(4096)

    def close(self) -> None:
        """Close both ends."""
        self._read.close()
        self._write.close()


WAKER: Callable[[], Waker] = EventFd if hasattr(os, "eventfd") else SocketPair


class Bridge:
    """Runs functions on the loop's thread, in the order in which they were posted."""

    def __init__(self, waker: Callable[[], Waker] = WAKER) -> None:
        self._loop = asyncio.get_running_loop()
        self._queue: deque[tuple[Callable[[Any], object], Any]] = deque()
        self._signalled = False
        self._open = True
        # held while signalling, as the number of a closed descriptor may be reused at once
        self._close_lock = threading.RLock()  # reentrant: garbage collection may post meanwhile
        self._waker = waker()
        self._loop.add_reader(self._waker.fileno(), self._drain)

    def post(self, function: Callable[[Any], object], argument: Any, *, lazy: bool = False) -> None:
        """Let the loop call `function(argument)`. Never blocks; may be called from any thread.

        A `lazy` call does not wake the loop. It waits for the next post that does.
        """
        if self._open:
            self._queue.append((function, argument))
            if not (lazy or self._signalled):
                self._wake()

    def close(self) -> None:
        """Stop. Calls that are queued, or posted later, are dropped."""
        with self._close_lock:
            if not self._open:
                return
            self._open = False
        self._loop.remove_reader(self._waker.fileno())
        self._waker.close()
        self._queue.clear()

    def _wake(self) -> None:
        with self._close_lock:
            if self._open:
                self._signalled = True
                self._waker.signal()

    def _drain(self) -> None:
        self._waker.clear()
        self._signalled = False  # before emptying, so that a later post signals again
        try:
            for _ in range(len(self._queue)):  # bounded: later posts wait for the next call
                if not self._open:
                    break
                function, argument = self._queue.popleft()
                function(argument)
        finally:
            if self._queue and not self._signalled:  # a function raised: call the others later
                self._wake()


T = TypeVar("T")
SPARE_SAMPLES = 8  # samples kept at depth 1, as the newest may be unreadable
MAX_KEYS = 64  # per mailbox


class Mailbox(Generic[T]):
    """Queues of at most `depth` samples for a busy event loop; new samples replace the oldest.

    Each key has its own queue, so that no camera displaces another one's samples. With `depth` 1,
    only the newest readable sample of a key is delivered. A sample is unreadable if `on_sample`
    returns False. The mailbox keeps a few spares, so that unreadable samples do not displace a
    readable one.
    """

    def __init__(
        self,
        bridge: Bridge,
        on_sample: Callable[[T], bool | None],
        depth: int,
        *,
        lazy: bool = False,
    ) -> None:
        self._bridge, self._on_sample, self._lazy = bridge, on_sample, lazy
        self._newest_only = depth == 1
        self._size = SPARE_SAMPLES if self._newest_only else depth
        self._queues: dict[str, deque[T]] = {}
        self._adding = threading.Lock()
        self._posted = False

    def put(self, sample: T, key: str = "") -> None:
        """Store a sample and wake the event loop, unless the mailbox is lazy.

        Never blocks; may be called from any thread.
        """
        queue = self._queues.get(key)
        if queue is None:
            queue = self._add(key)
        queue.append(sample)
        if not self._posted:
            self._posted = True
            self._bridge.post(Mailbox._deliver, self, lazy=self._lazy)

    def _add(self, key: str) -> deque[T]:
        with self._adding:
            queues = dict(self._queues)  # a copy, as the loop may be iterating over them
            queue = queues.setdefault(key, deque(maxlen=self._size))
            if len(queues) > MAX_KEYS:  # the first one is added again with its next sample
                queues.pop(next(iter(queues)))
            self._queues = queues
            return queue

    def _deliver(self) -> None:
        self._posted = False  # before emptying, so that samples arriving from now on post again
        for queue in self._queues.values():
            count = len(queue)
            waiting = [queue.popleft() for _ in range(count)]
            if self._newest_only and count > 1:
                self._deliver_newest(waiting)
                continue
            for sample in waiting:
                self._on_sample(sample)

    def _deliver_newest(self, waiting: list[T]) -> None:
        for sample in reversed(waiting):
            if self._on_sample(sample) is not False:
                break


MAX_WAITING = 32  # queries per key; beyond that the oldest are refused
MAX_CONCURRENT = 32  # answers per key, unless it is urgent
MAX_STARTS = 4  # new answers per turn of the loop


class _QueriedKey(Generic[T]):
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
        return bool(self.waiting) and (self.urgent or self.answering < MAX_CONCURRENT)


class QueryQueue(Generic[T]):
    """All queries of a process. `refuse` is called for dropped ones, from any thread."""

    def __init__(self, bridge: Bridge, refuse: Callable[[T], None]) -> None:
        self._bridge, self._refuse = bridge, refuse
        self._urgent: deque[_QueriedKey[T]] = deque()
        self._others: deque[_QueriedKey[T]] = deque()
        self._tasks: set[asyncio.Task[None]] = set()
        self._posted = False

    def serve(
        self, answer: Callable[[T], Awaitable[None]], *, urgent: bool
    ) -> tuple[Callable[[T], None], Close]:
        """Register a key; return a function that adds a query, and one that closes the key.

        Queries may be added from any thread.
        """
        key = _QueriedKey(answer, urgent)
        keys = self._urgent if urgent else self._others
        keys.append(key)

        def put(query: T) -> None:
            key.waiting.append(query)
            while len(key.waiting) > MAX_WAITING:
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
            self._bridge.post(QueryQueue._begin, self)

    def _begin(self) -> None:
        """Start up to MAX_STARTS queries; the others wait for the next turn of the loop."""
        self._posted = False  # before reading, so that new queries wake the loop again
        for _ in range(MAX_STARTS):
            if not (key := self._next()):
                return
            key.answering += 1
            task = asyncio.get_running_loop().create_task(self._answer(key, key.waiting.popleft()))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)
        self._wake()

    def _next(self) -> _QueriedKey[T] | None:
        """Return the next key with a query to start: urgent keys first, then round-robin."""
        for keys in (self._urgent, self._others):
            for _ in range(len(keys)):
                keys.rotate(-1)
                if keys[-1].ready:
                    return keys[-1]
        return None

    async def _answer(self, key: _QueriedKey[T], query: T) -> None:
        try:
            await key.answer(query)
        finally:
            key.answering -= 1
            if key.waiting:
                self._wake()
