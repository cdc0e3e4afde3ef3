"""A file that grows by whole pieces: what a full disk cuts off is taken away again."""

import contextlib
import fcntl
import os
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import open_regular

SYNC = getattr(os, "fdatasync", os.fsync)  # macOS has no fdatasync


class Tape:
    """A new file, locked for as long as it is being written. Raises ConfigError if it exists."""

    def __init__(self, path: Path) -> None:
        self.path, self.size = path, 0
        try:
            if not path.parent.is_dir():
                path.parent.mkdir(parents=True)
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        except FileExistsError as error:
            raise ConfigError(f"{error.filename} exists; choose another file") from None
        except OSError as error:
            raise ConfigError(f"cannot write {path}: {error.strerror}") from None
        fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)  # whoever recovers keeps off

    def write(self, data: bytes) -> int:
        """Append all of `data`, or nothing and raise OSError."""
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except OSError:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.size)
                os.lseek(self._fd, self.size, os.SEEK_SET)
            raise
        self.size += len(data)
        return len(data)

    def tell(self) -> int:
        """How much has been written [bytes]."""
        return self.size

    def flush(self) -> None:
        """Nothing waits here."""

    def sync(self) -> None:
        """Have the disk keep what has been written. Raises OSError."""
        SYNC(self._fd)

    def free_bytes(self) -> int:
        """Room on the disk."""
        disk = os.fstatvfs(self._fd)
        return disk.f_bavail * disk.f_frsize

    def close(self) -> None:
        """Close and unlock."""
        os.close(self._fd)


def being_written(path: Path) -> bool:
    """Whether somebody is recording into `path` now."""
    with open_regular(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
