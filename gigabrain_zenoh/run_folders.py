"""The folders of past runs: how many are kept, and which are in use."""

import contextlib
import fcntl
import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

log = logging.getLogger(__name__)

MAX_RUNS = 50
MAX_BYTES = 1_000_000_000  # of all together
LOCK = ".in_use"  # locked by the supervisor for as long as it runs


def hold(folder: Path) -> None:
    """Mark a folder as in use until this process ends. Raises OSError."""
    fcntl.flock(os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600), fcntl.LOCK_EX)


@contextlib.contextmanager
def tidied(base: Path) -> Iterator[None]:
    """Make room in `base`, and keep others from tidying up before the new folder is held.

    Raises OSError.
    """
    with contextlib.suppress(FileExistsError):  # perhaps no folder, which the next line says
        base.mkdir(parents=True)
    lock = os.open(base, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        prune(base)
        yield
    finally:
        os.close(lock)


def prune(base: Path, max_runs: int = MAX_RUNS, max_bytes: int = MAX_BYTES) -> None:
    """Remove the oldest run folders until the rest, with one more to come, is within the limits.

    Folders in use stay. What cannot be removed stays too: a run does not fail for that.
    """
    runs = sorted((path for path in base.glob("*") if path.is_dir()), key=lambda path: path.name)
    sizes = {path: _size(path) for path in runs}
    for path in runs:
        if len(sizes) < max_runs and sum(sizes.values()) <= max_bytes:
            return
        if _in_use(path):
            continue
        shutil.rmtree(path, ignore_errors=True)
        if path.exists():
            log.warning("cannot remove the old run folder %s", path)
        else:
            del sizes[path]


def _size(folder: Path) -> int:
    """The bytes of all files in it."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # another supervisor is tidying up as well
                total += os.lstat(os.path.join(parent, name)).st_size
    return total


def _in_use(folder: Path) -> bool:
    try:
        lock = os.open(folder / LOCK, os.O_RDWR)
    except OSError:  # not marked, so nobody holds it
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    else:
        return False
    finally:
        os.close(lock)
