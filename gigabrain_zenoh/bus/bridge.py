"""From any thread onto the event loop: a deque, and one byte that says there is something in it.

Cheaper than `call_soon_threadsafe` per message: while the loop is busy, any number of arrivals cost
a single write.
"""

import asyncio
import contextlib
import os
import socket
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol


class Waker(Protocol):
    """Something that one thread can make readable for the loop of another."""

    def fileno(self) -> int:
        """What the loop watches."""
        ...

    def signal(self) -> None:
        """Make it readable. Raises BlockingIOError where it is more than readable already."""
        ...

    def clear(self) -> None:
        """Make it unreadable. Raises BlockingIOError where it was so already."""
        ...

    def close(self) -> None:
        """Free the descriptors."""
        ...


class EventFd:
    """Linux's own counter in a descriptor."""

    def __init__(self) -> None:
        self._fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def fileno(self) -> int:
        """What the loop watches."""
        return self._fd

    def signal(self) -> None:
        """Make it readable."""
        os.eventfd_write(self._fd, 1)

    def clear(self) -> None:
        """Make it unreadable."""
        os.eventfd_read(self._fd)

    def close(self) -> None:
        """Free the descriptor."""
        os.close(self._fd)


class SocketPair:
    """The same with two sockets, for macOS and Windows."""

    def __init__(self) -> None:
        self._read, self._write = socket.socketpair()
        self._read.setblocking(False)
        self._write.setblocking(False)

    def fileno(self) -> int:
        """What the loop watches."""
        return self._read.fileno()

    def signal(self) -> None:
        """Make it readable."""
        self._write.send(b"\1")

    def clear(self) -> None:
        """Make it unreadable."""
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
        # held while signalling: the number of a closed descriptor may be somebody else's at once
        self._closing = threading.RLock()  # a garbage collection in between may post as well
        self._waker = waker()
        self._loop.add_reader(self._waker.fileno(), self._drain)

    def post(self, function: Callable[[Any], object], argument: Any) -> None:
        """Have the loop call `function(argument)`. From any thread; never blocks."""
        if not self._open:
            return
        self._queue.append((function, argument))
        if not self._signalled:
            self._wake()

    def close(self) -> None:
        """Stop calling. What is still queued, or posted later, is dropped."""
        with self._closing:
            if not self._open:
                return
            self._open = False
        self._loop.remove_reader(self._waker.fileno())
        self._waker.close()
        self._queue.clear()

    def _wake(self) -> None:
        with self._closing, contextlib.suppress(BlockingIOError):  # full: it is readable already
            if self._open:
                self._signalled = True
                self._waker.signal()

    def _drain(self) -> None:
        with contextlib.suppress(BlockingIOError):
            self._waker.clear()
        self._signalled = False  # before emptying: what comes now signals again
        try:
            for _ in range(len(self._queue)):  # bounded: what comes meanwhile waits its turn
                if not self._open:
                    break
                function, argument = self._queue.popleft()
                function(argument)
        finally:
            if self._queue and not self._signalled:  # one of them raised: the others still go
                self._wake()
