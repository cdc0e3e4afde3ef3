"""Folders of past runs: limits their number and size, and marks those in use."""

import contextlib
import fcntl
import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

log = logging.getLogger(__name__)

MAX_RUNS = 50
MAX_BYTES = 1_000_000_000  # of all folders together
LOCK = ".in_use"  # locked by the supervisor for as long as it runs


def hold(folder: Path) -> None:
    """Mark a folder as in use until this process ends. Raises OSError."""
    fcntl.flock(os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600), fcntl.LOCK_EX)


@contextlib.contextmanager
def tidied(base: Path) -> Iterator[None]:
    """Prune `base`, and keep other supervisors from pruning it while the block runs.

    Create and `hold` the new folder inside the block. Raises OSError.
    """
    with contextlib.suppress(FileExistsError):  # if `base` is a file, the next line raises
        base.mkdir(parents=True)
    lock = os.open(base, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        prune(base)
        yield
    finally:
        os.close(lock)


def prune(base: Path, max_runs: int = MAX_RUNS, max_bytes: int = MAX_BYTES) -> None:
    """Remove the oldest run folders until there is room for one more within the limits.

    Folders in use are kept. Folders that cannot be removed are skipped, and do not fail the run.
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
    """Return the total size of all files in `folder` [bytes]."""
    total = 0
    for parent, _, names in os.walk(folder):
        for name in names:
            with contextlib.suppress(OSError):  # another process has removed the file
                total += os.lstat(os.path.join(parent, name)).st_size
    return total


def _in_use(folder: Path) -> bool:
    try:
        lock = os.open(folder / LOCK, os.O_RDWR)
    except OSError:  # not marked, so no process holds it
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    else:
        return False
    finally:
        os.close(lock)
