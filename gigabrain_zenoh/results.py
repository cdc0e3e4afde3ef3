"""Files that a long run leaves behind: looked at before it, written after it."""

from pathlib import Path

import msgspec

from gigabrain_zenoh.errors import ConfigError


def check_place(path: Path | None) -> None:
    """Before the run rather than after it. Raises ConfigError where nothing can be written."""
    if path and not path.parent.is_dir():
        raise ConfigError(f"cannot write {path}: no such folder")
    if path and path.is_dir():
        raise ConfigError(f"cannot write {path}: it is a folder")


def write(results: object, path: Path | None) -> None:
    """As JSON, where a file is wanted. Raises ConfigError where that cannot be written."""
    if path is None:
        return
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(results)) + b"\n")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
