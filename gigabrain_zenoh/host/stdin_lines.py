"""Lines that a person types into a running command."""

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable, Iterator

from gigabrain_zenoh.host.child import Lines

READ_BYTES = 4096


@contextlib.contextmanager
def typed_lines(take: Callable[[str], None]) -> Iterator[None]:
    """Call `take` with each line of standard input; does nothing if input is a file."""
    loop, fd, lines = asyncio.get_running_loop(), sys.stdin.fileno(), Lines()

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
