"""From any thread onto the event loop: a deque, and one byte that says there is something in it.

Cheaper than `call_soon_threadsafe` per message: while the loop is busy, any number of arrivals cost
a single write.
"""

import asyncio
import contextlib
import os
import socket
from collections import deque
from collections.abc import Callable
from typing import Any


class Bridge:
    """Runs functions on the loop's thread, in the order in which they were posted."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._queue: deque[tuple[Callable[[Any], None], Any]] = deque()
        self._signalled = False
        self._open = True
        if hasattr(os, "eventfd"):
            self._read_fd = self._write_fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
            self._sockets: tuple[socket.socket, ...] = ()
        else:  # macOS and Windows have no eventfd
            self._sockets = socket.socketpair()
            for end in self._sockets:
                end.setblocking(False)
            self._read_fd, self._write_fd = (end.fileno() for end in self._sockets)
        self._loop.add_reader(self._read_fd, self._drain)

    def post(self, function: Callable[[Any], None], argument: Any) -> None:
        """Have the loop call `function(argument)`. From any thread; never blocks."""
        self._queue.append((function, argument))
        if self._signalled or not self._open:
            return
        self._signalled = True
        with contextlib.suppress(OSError):  # closed between the check and the write
            self._signal()

    def close(self) -> None:
        """Stop calling. What is still queued is dropped."""
        if not self._open:
            return
        self._open = False
        self._loop.remove_reader(self._read_fd)
        if self._sockets:
            for end in self._sockets:
                end.close()
        else:
            os.close(self._read_fd)

    def _signal(self) -> None:
        if self._sockets:
            self._sockets[1].send(b"\1")
        else:
            os.eventfd_write(self._write_fd, 1)

    def _drain(self) -> None:
        try:
            if self._sockets:
                self._sockets[0].recv(4096)
            else:
                os.eventfd_read(self._read_fd)
        except BlockingIOError:
            pass
        self._signalled = False  # before emptying: what comes now signals again
        for _ in range(len(self._queue)):  # bounded: what comes meanwhile waits for the next turn
            function, argument = self._queue.popleft()
            function(argument)
