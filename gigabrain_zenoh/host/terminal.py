"""A terminal: text written from a thread, and lines typed in."""

import asyncio
import contextlib
import errno
import os
import queue
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Generic, Self, TextIO, TypeVar

T = TypeVar("T")
LINES = 1000  # may wait; more are dropped
MAX_LINE_BYTES = 256 * 1024  # a longer line comes in pieces
LAST_WORDS_S = 0.5  # until a display that hangs is left behind


class Display(Generic[T]):
    """Calls `show` for each item, in order; drops items while `room` of them wait.

    Used as `with Display(...) as display`, any number of times.
    """

    def __init__(self, show: Callable[[T], object], room: int) -> None:
        self._show = show
        self._waiting: queue.Queue[T | None] = queue.Queue(room)

    def __enter__(self) -> Self:
        self._thread = threading.Thread(target=self._work, name="display", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(queue.Full):
            self._waiting.put(None, timeout=LAST_WORDS_S)
        self._thread.join(LAST_WORDS_S)

    def put(self, item: T) -> None:
        """Queue an item. Never blocks."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(item)

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            self._show(item)


def writer(stream: TextIO) -> Callable[[str], None]:
    """Return a function that writes to a stream until its reader has gone.

    It bypasses the stream's buffer: at exit, Python would wait for the lock of that.
    """
    file, encoding, read = stream.fileno(), stream.encoding, True

    def write(text: str) -> None:
        nonlocal read
        data = text.encode(encoding, errors="backslashreplace")
        try:
            while read and data:
                data = data[os.write(file, data) :]
        except OSError as error:  # the pager has ended, or the terminal; a disk may have room again
            read = error.errno == errno.ENOSPC

    return write


READ_BYTES = 4096


class LineSplitter:
    """Cuts a stream of bytes into lines of any length."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that `data` completes, without newlines and empty lines."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > MAX_LINE_BYTES:
            lines.append(self.end())
        return [line for line in lines if line.strip()]

    def end(self) -> bytes:
        """Return the rest after the last newline."""
        rest, self._rest = self._rest, b""
        return rest


@contextlib.contextmanager
def typed_lines(take: Callable[[str], None]) -> Iterator[None]:
    """Call `take` with each line of standard input; does nothing if input is a file."""
    loop, fd, lines = asyncio.get_running_loop(), sys.stdin.fileno(), LineSplitter()

    def readable() -> None:
        data = os.read(fd, READ_BYTES)
        for line in lines.feed(data):
            take(line.decode(errors="replace"))
        if not data:
            loop.remove_reader(fd)

    try:
        loop.add_reader(fd, readable)
    except OSError:  # a file
        yield
        return
    try:
        yield
    finally:
        loop.remove_reader(fd)


async def typed_text() -> str | None:
    """Wait for a line of standard input, which may be empty; None at its end.

    It may be cancelled; a line that is typed later is then left for the next call.
    """
    loop = asyncio.get_running_loop()
    fd, text = sys.stdin.fileno(), b""
    while not text.endswith(b"\n"):
        await _readable(loop, fd)
        byte = os.read(fd, 1)  # the rest belongs to the next call
        if not byte:
            return None
        text += byte
    return text.decode(errors="replace").strip()


async def _readable(loop: asyncio.AbstractEventLoop, fd: int) -> None:
    ready = asyncio.Event()
    try:
        loop.add_reader(fd, ready.set)
    except OSError:  # a file, which is always readable
        return
    try:
        await ready.wait()
    finally:
        loop.remove_reader(fd)
