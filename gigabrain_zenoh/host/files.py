"""Files: durable writes, reads of bounded size, and results of long runs."""

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import msgspec

from gigabrain_zenoh.errors import ConfigError, DiskFull

KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a FIFO"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def expanded(path: str | Path) -> Path:
    """Return a path with `~` replaced by the home folder. Raises ConfigError if there is none."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise ConfigError(f"{path}: no such home folder; write the whole path") from None


def open_regular(path: Path, most_bytes: int | None = None) -> BinaryIO:
    """Open a regular file for reading. Raises OSError.

    Raises ConfigError for other kinds of files, and for more than `most_bytes`.
    """
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)  # a FIFO then opens at once
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
    """Return the content of a regular file. Raises OSError, and ConfigError like `open_regular`."""
    with open_regular(path, most_bytes) as file:
        data = file.read(most_bytes + 1)  # files of /proc report no size, and a file may grow
    if len(data) > most_bytes:
        raise ConfigError(too_large(path, len(data), most_bytes))
    return data


def too_large(path: Path, size_bytes: int, most_bytes: int) -> str:
    """Return the error text for a file that is too large."""
    return f"{path}: {size_bytes / 1e6:.1f} MB; expected at most {most_bytes / 1e6:g} MB"


# own code: python-atomicwrites, archived 2022, fails where a file system syncs no folders
CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP)  # from file systems that cannot sync a folder


def replace_file(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write `data` to `path`, durably. One writer at a time. Raises OSError."""
    with replacing(path, mode) as file:
        file.write(data)


@contextmanager
def replacing(path: Path, mode: int = 0o644) -> Iterator[BinaryIO]:
    """Yield a file that replaces `path`, durably, when the block ends. Raises OSError."""
    draft = path.with_name(f".{path.name}.new")
    try:
        with _synced(draft, mode) as file:
            yield file
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)  # frees its space on a full disk
        raise
    sync_folder(path.parent)


def create_file(path: Path, data: bytes) -> None:
    """Write the new private file `path`, durably and atomically; one of several writers succeeds.

    Raises FileExistsError where it exists, and OSError.
    """
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}-") as draft:  # 0600
        draft.write(data)
        draft.flush()
        os.fsync(draft.fileno())
        os.link(draft.name, path)
    sync_folder(path.parent)


def write_synced(path: Path, data: bytes, mode: int = 0o644) -> None:
    """Write a file's content to disk; sync its folder to make its name durable too."""
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
    """Write the names in a folder to disk. Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in CANNOT_SYNC:
            raise
    finally:
        os.close(fd)


FULL = (errno.ENOSPC, errno.EDQUOT)
PROBLEMS = {  # by errno: what is wrong, and what to do
    errno.EACCES: ("no permission", "change its rights, or choose another place"),
    errno.EEXIST: ("that name is taken", "choose another"),
    errno.EISDIR: ("it is a folder", "name a file"),
    errno.ELOOP: ("its symbolic links lead in a circle", "name the file itself"),
    errno.ENAMETOOLONG: ("the name is too long", "choose a shorter one"),
    errno.ENOENT: ("no such file or folder", "check the path"),
    errno.ENOTDIR: ("a part of the path is a file, not a folder", "check the path"),
    errno.EPERM: ("no permission", "change its rights, or choose another place"),
    errno.EROFS: ("the disk is read-only", "choose another place"),
    **dict.fromkeys(FULL, ("the disk is full", "free some space")),
}


def file_problem(error: OSError, remedy: str = "") -> str:
    """Return the cause of a file's error and what to do; `remedy` replaces the usual advice.

    A full disk always needs space.
    """
    code = error.errno or 0
    cause, advice = PROBLEMS.get(code, (error.strerror or str(error), "choose another file"))
    return f"{cause}; {advice if code in FULL else remedy or advice}"


def cannot_write(path: str | Path, error: OSError, remedy: str = "") -> ConfigError:
    """Return the error for a file or folder that cannot be written: DiskFull if it lacks space."""
    kind = DiskFull if error.errno in FULL else ConfigError
    return kind(f"cannot write {path}: {file_problem(error, remedy)}")


def cannot_read(path: str | Path, error: OSError) -> ConfigError:
    """Return the error for a file or folder that cannot be read."""
    return ConfigError(f"cannot read {path}: {file_problem(error)}")


def check_result_path(path: Path | None) -> None:
    """Raise ConfigError where `path` cannot be written; call this before a long run."""
    if path is None:
        return
    if not os.path.isdir(path.parent):
        raise ConfigError(f"cannot write {path}: no such folder; create it first")
    if os.path.isdir(path):
        raise ConfigError(f"cannot write {path}: it is a folder; name a file")
    if os.path.exists(path):  # do not open it: the reader of a FIFO would see its end
        return
    try:
        path.touch()
        os.unlink(os.path.realpath(path))  # of a dangling link remove the new file, not the link
    except OSError as error:
        raise cannot_write(path, error) from None


def check_new_file(path: Path) -> None:
    """Raise ConfigError where no new file `path`, with its folders, can be created."""
    if os.path.lexists(path):
        raise ConfigError(f"{path} exists; choose another file")
    folder = next(each for each in path.absolute().parents if os.path.lexists(each))
    if not os.path.isdir(folder):
        raise ConfigError(f"cannot write {path}: {folder} is not a folder; choose another path")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ConfigError(
            f"cannot write {path}: you may not write to {folder}; choose another folder"
        )


def check_picture_path(path: Path | None) -> None:
    """Raise ConfigError if no PNG can be written to `path`, or its suffix is not `.png`."""
    check_result_path(path)
    if path and path.suffix.lower() != ".png" and (path.is_file() or not path.exists()):
        raise ConfigError(f"cannot write {path}: it would be a PNG; expected a name like x.png")


def write_result(results: object, path: Path | None) -> None:
    """Write `results` as JSON, if a path is given. Raises ConfigError if that fails."""
    if path is None:
        return
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(results)) + b"\n")
    except OSError as error:
        raise cannot_write(path, error) from None
