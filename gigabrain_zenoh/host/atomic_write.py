"""Files that survive a crash and a power cut: the old content or the new, never half of either.

Write a draft beside the file, sync it, rename it, sync the folder. Without the last step a power
cut may bring the old file back after it was reported as written.
"""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

NOT_SYNCED = (errno.EINVAL, errno.ENOTSUP)  # from file systems that cannot sync a folder


def replace_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write `data` to `path`, durably. One writer at a time. Raises OSError."""
    with replacing(path, mode) as file:
        file.write(data)


@contextmanager
def replacing(path: Path, mode: int = 0o644) -> Iterator[BinaryIO]:
    """A file to write what is to replace `path`, durably, when the block ends. Raises OSError."""
    draft = path.with_name(f".{path.name}.new")
    try:
        with _synced(draft, mode) as file:
            yield file
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)  # a full disk would stay full
        raise
    sync_folder(path.parent)


def create_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write the new file `path`, durably; of several writers one wins, nobody sees half a file.

    Raises FileExistsError where it exists, and OSError.
    """
    draft = path.with_name(f".{path.name}.{os.getpid()}.new")
    try:
        write_synced(draft, data, mode)
        os.link(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    sync_folder(path.parent)


def write_synced(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file's content to disk; its name is there once the folder is synced."""
    with _synced(path, mode) as file:
        file.write(data)


@contextmanager
def _synced(path: Path, mode: int) -> Iterator[BinaryIO]:
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


def make_folder(path: Path) -> None:
    """Create a folder and its parents, durably. Raises OSError."""
    if path.exists():
        return
    make_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync_folder(path.parent)


def sync_folder(path: Path) -> None:
    """Bring the names in a folder to disk. Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in NOT_SYNCED:
            raise
    finally:
        os.close(fd)
