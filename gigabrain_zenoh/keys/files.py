"""The files of an identity. Looking at them costs nothing; reading them takes `identity`."""

import os
import stat
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError

CA, CA_KEY = "ca.crt", "ca.key"
CERTIFICATE, KEY = "identity.crt", "identity.key"
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
