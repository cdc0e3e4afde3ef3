"""A folder of ports belongs to one emulator at a time."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.posix import fcntl


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Have the folder for this process alone, until it ends or dies. Raises ConfigError."""
    with contextlib.ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, descriptor)
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ConfigError(
                f"another emulator has its ports in {folder}; end it, or take another folder "
                "(--ports)"
            ) from None
        except OSError as error:
            raise no_ports(folder, error) from None
        yield


def no_ports(folder: Path, error: OSError) -> ConfigError:
    """What to say when ports cannot be made."""
    return ConfigError(f"no ports can be made in {folder}: {error.strerror}; expected a folder")
