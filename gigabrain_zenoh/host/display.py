"""Shows text and pages from a thread, so that a stopped terminal (Ctrl-S) blocks no event loop."""

import contextlib
import errno
import os
import queue
import threading
from collections.abc import Callable
from typing import Generic, Self, TextIO, TypeVar

T = TypeVar("T")

LINES = 1000  # may wait; more are dropped
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
