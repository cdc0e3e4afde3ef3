"""`gigabrain schema export`: the messages, for other languages."""

from pathlib import Path

from gigabrain_schemas.golden import export as write
from gigabrain_zenoh.errors import ConfigError


def export(folder: Path) -> None:
    """Write JSON Schema of every message, and the tables of topics and services.

    Example: gigabrain schema export schemas/

    Parameters
    ----------
    folder
        Where to; made if it is not there.
    """
    try:
        written = write(folder)
    except OSError as error:
        raise ConfigError(f"cannot write {folder}: {error.strerror}") from None
    print(f"{len(written)} files in {folder}")
