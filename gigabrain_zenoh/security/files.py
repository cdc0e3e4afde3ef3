"""The files of an identity. Looking at them costs nothing; reading them takes `identity`."""

import fcntl
import logging
import os
import stat
import tempfile
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import open_regular, read_bounded

log = logging.getLogger(__name__)

CA, CA_KEY = "ca.crt", "ca.key"
CERTIFICATE, KEY = "identity.crt", "identity.key"
MOST_BYTES = 65_536  # of a file that `made_once` makes
REMEDY = "copy the whole folder that `gigabrain keys issue` made"


def check_files(folder: Path) -> None:
    """Whether all files of an identity are there, and its key is private. Raises ConfigError."""
    if not folder.is_dir():
        raise ConfigError(
            f"{folder}: no folder with keys; make an identity with `gigabrain keys issue ROLE` "
            "and copy its folder here"
        )
    for name in (CA, CERTIFICATE, KEY):
        path = folder / name
        try:
            if not path.is_file():
                raise ConfigError(f"{folder}: {name} is missing; {REMEDY}")
        except PermissionError:
            raise unreadable(path) from None
        if not os.access(path, os.R_OK):
            raise unreadable(path)
    check_private(folder / KEY)


def check_private(path: Path) -> None:
    """Whether a key is its owner's alone. Raises ConfigError."""
    mode = stat.S_IMODE(path.stat().st_mode)
    if os.name == "posix" and mode & 0o077:
        raise ConfigError(f"{path} is open to others (mode {mode:04o}); chmod 600 {path}")


def made_once(path: Path, content: bytes) -> tuple[bytes, bool]:
    """What a private file holds, and whether it had to be made, with `content`. Raises ConfigError.

    Of several who make it at once one wins, and nobody sees it unfinished. An empty one, as a
    crash may leave it, is made anew.
    """
    try:
        if path.exists() and (found := read_bounded(path, MOST_BYTES)):
            check_private(path)
            return found, False
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}-") as new:  # 0600
            new.write(content)
            new.flush()
            os.fsync(new.fileno())
            try:
                os.link(new.name, path)
                return content, True
            except FileExistsError:
                check_private(path)
            with open_regular(path, MOST_BYTES) as old:
                fcntl.flock(old, fcntl.LOCK_EX)  # of several who heal it one does
                found = read_bounded(path, MOST_BYTES)
                if not found:
                    log.warning("%s was empty; it is made anew", path)
                    os.link(new.name, f"{new.name}-whole")
                    os.replace(f"{new.name}-whole", path)
                return found or content, not found
    except OSError as error:
        raise ConfigError(f"cannot read or write {path}: {error.strerror}") from None


def unreadable(path: Path) -> ConfigError:
    """The error for a file that this user may not read."""
    return ConfigError(f"{path} cannot be read by this user; run as its owner, or chown it")


def identity_folder(keys: str, host: str = "") -> Path:
    """The identity in the folder `keys`, or in its part for `host` where it holds several."""
    folder = Path(keys).expanduser()
    of_host = folder / host
    if host and not (folder / CERTIFICATE).exists() and of_host.is_dir():
        return of_host
    return folder
