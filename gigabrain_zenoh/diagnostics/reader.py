"""Whether anybody still reads what a command prints."""

import asyncio
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

STDOUT: Final = 1  # the descriptor; whoever replaced sys.stdout prints elsewhere


@contextmanager
def ended_with_reader(stop: asyncio.Event) -> Iterator[None]:
    """`stop` is set as soon as nobody has the other end of the pipe that this process prints to.

    Else `gigabrain log --follow | head -1` would end only with the next line, which may never come.
    """
    loop = asyncio.get_running_loop()
    if not stat.S_ISFIFO(os.fstat(STDOUT).st_mode):
        yield
        return

    def gone() -> None:
        loop.remove_reader(STDOUT)
        stop.set()

    loop.add_reader(STDOUT, gone)  # a pipe's writing end is never readable: only its end wakes us
    try:
        yield
    finally:
        loop.remove_reader(STDOUT)
