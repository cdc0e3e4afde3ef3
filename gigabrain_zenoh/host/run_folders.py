"""Folders of past runs: limits their number and size, and marks those in use."""

import contextlib
import itertools
import logging
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import cannot_write, make_folder
from gigabrain_zenoh.host.posix import fcntl

log = logging.getLogger(__name__)

MAX_RUNS = 50
MAX_BYTES = 1_000_000_000  # of all folders together
REMEDY = "make it writable, or set XDG_STATE_HOME to a folder that is"
LOCK = ".in_use"  # locked by the supervisor while it runs; contains the run's number


def hold(folder: Path, number: int = 0) -> None:
    """Mark a folder as in use until this process ends, and number it. Raises OSError."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)
    with contextlib.suppress(OSError):  # on a full disk it stays without a number
        os.write(lock, str(number).encode())


def past_runs(base: Path) -> list[Path]:
    """Return all run folders, oldest first.

    They are numbered because the clock may step back. Folders of earlier versions have no number:
    they come first, sorted by name.
    """
    return sorted((p for p in base.glob("*") if p.is_dir()), key=lambda p: (_number(p), p.name))


def _number(folder: Path) -> int:
    try:
        return int((folder / LOCK).read_bytes())
    except (OSError, ValueError):
        return 0


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
    runs = past_runs(base)
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


@contextlib.contextmanager
def state_locked(folder: Path, label: str, host: str) -> Iterator[None]:
    """Keep other supervisors of this host of a deployment from `folder` while the block runs.

    Raises ConfigError where one runs, or where the folder cannot be written, and DiskFull.
    """
    with contextlib.ExitStack() as closing:
        try:
            make_folder(folder)
            path = folder / f".{quote(host, safe='')}{LOCK}"
            fcntl.flock(closing.enter_context(path.open("wb")), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"a robot {label} runs here already, with its state in {folder}; "
                "stop it, or give this one a `namespace` of its own"
            ) from None
        except OSError as error:
            raise cannot_write(folder, error, REMEDY) from None
        yield


def new_run_dir(base: Path | None, label: str) -> Path:
    """Create `<base>/<UTC stamp>-<label>-<pid>`; `base` None is the user's state folder (XDG).

    Only this user can read it. Old run folders are removed first (see `prune`), and this one is
    marked as in use. Raises ConfigError when it cannot be created, and DiskFull.
    """
    base = base or state_dir() / "runs"
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    name = f"{stamp}-{re.sub(r'[^A-Za-z0-9._-]+', '-', label)}-{os.getpid()}"
    try:
        with tidied(base):
            for n in itertools.count(1):
                path = base / (name if n == 1 else f"{name}-{n}")
                if not path.exists():  # an earlier run of this process in this second has it
                    break
            number = max(map(_number, past_runs(base)), default=0) + 1
            path.mkdir(mode=0o700)
            hold(path, number)
            return path
    except OSError as error:
        raise unwritable_runs(base, error) from None


def state_dir() -> Path:
    """Return the folder in which runs and robots keep their state. Raises ConfigError."""
    from platformdirs import user_state_path  # takes 10 ms, and few commands need it

    try:
        return user_state_path("gigabrain")
    except RuntimeError:
        raise ConfigError("there is no home folder; set XDG_STATE_HOME to a folder") from None


def unwritable_runs(folder: Path, error: OSError) -> ConfigError:
    """Return the error for a run folder that cannot be written."""
    return cannot_write(f"the run folder {folder}", error, REMEDY)
