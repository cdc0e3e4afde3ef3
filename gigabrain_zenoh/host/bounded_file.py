"""Files that people name: regular ones of a bounded size, whatever the path leads to.

A path may lead to /dev/zero, to a FIFO that nobody writes into, or to a file of many gigabytes.
"""

import os
import stat
from pathlib import Path
from typing import BinaryIO

from gigabrain_zenoh.errors import ConfigError

KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def open_regular(path: Path, most_bytes: int | None = None) -> BinaryIO:
    """Open a file to be read. Raises OSError, and ConfigError for anything but a regular file.

    Also for one of more than `most_bytes`.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a FIFO opens at once so
    try:
        about = os.fstat(fd)
        for is_kind, name in KINDS:
            if is_kind(about.st_mode):
                raise ConfigError(f"{path}: is {name}; expected a file")
        if most_bytes is not None and about.st_size > most_bytes:
            raise ConfigError(too_large(path, about.st_size, most_bytes))
        return open(fd, "rb")
    except BaseException:
        os.close(fd)
        raise


def read_bounded(path: Path, most_bytes: int) -> bytes:
    """The content of a regular file. Raises OSError, and ConfigError as `open_regular` does."""
    with open_regular(path, most_bytes) as file:
        data = file.read(most_bytes + 1)  # a file of /proc has no size, and another may grow
    if len(data) > most_bytes:
        raise ConfigError(too_large(path, len(data), most_bytes))
    return data


def too_large(path: Path, there: int, most_bytes: int) -> str:
    """What to say of a file that is."""
    return f"{path}: {there / 1e6:.1f} MB; expected at most {most_bytes / 1e6:g} MB"
