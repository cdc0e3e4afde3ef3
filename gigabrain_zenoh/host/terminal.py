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
LINES = 1000  # that may wait for a display; more are dropped
MAX_LINE_BYTES = 256 * 1024  # a longer line is split
CLOSE_TIMEOUT_S = 0.5  # then a display that hangs is abandoned


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
            self._waiting.put(None, timeout=CLOSE_TIMEOUT_S)
        self._thread.join(CLOSE_TIMEOUT_S)

    def put(self, item: T) -> None:
        """Queue an item. Never blocks."""
        with contextlib.suppress(queue.Full):
            self._waiting.put_nowait(item)

    def _work(self) -> None:
        while (item := self._waiting.get()) is not None:
            self._show(item)


def writer(stream: TextIO) -> Callable[[str], None]:
    """Return a function that writes to a stream until its reader is gone.

    It bypasses the stream's buffer, as Python waits for that buffer's lock at exit.
    """
    fd, encoding, has_reader = stream.fileno(), stream.encoding, True

    def write(text: str) -> None:
        nonlocal has_reader
        data = text.encode(encoding, errors="backslashreplace")
        try:
            while has_reader and data:
                data = data[os.write(fd, data) :]
        except OSError as error:  # the pager or terminal is gone; but a full disk may get space
            has_reader = error.errno == errno.ENOSPC

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
def typed_lines(on_line: Callable[[str], None]) -> Iterator[None]:
    """Call `on_line` with each line of standard input; does nothing if input is a file."""
    loop, fd, lines = asyncio.get_running_loop(), sys.stdin.fileno(), LineSplitter()

    def readable() -> None:
        data = os.read(fd, READ_BYTES)
        for line in lines.feed(data):
            on_line(line.decode(errors="replace"))
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
    """Wait for a line of standard input and return it stripped; None at the end of input.

    It may be cancelled; the next call then reads the next line.
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
