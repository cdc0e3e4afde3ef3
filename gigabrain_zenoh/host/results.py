"""Result files of long runs: checked before the run, written after it."""

from pathlib import Path

import msgspec

from gigabrain_zenoh.errors import ConfigError


def check_place(path: Path | None) -> None:
    """Raise ConfigError where `path` cannot be written; call this before a long run."""
    if path and not path.parent.is_dir():
        raise ConfigError(f"cannot write {path}: no such folder")
    if path and path.is_dir():
        raise ConfigError(f"cannot write {path}: it is a folder")


def write(results: object, path: Path | None) -> None:
    """Write `results` as JSON, if a path is given. Raises ConfigError if that fails."""
    if path is None:
        return
    try:
        path.write_bytes(msgspec.json.format(msgspec.json.encode(results)) + b"\n")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
