"""What latched the gate, on disk: it survives a restart, and is there before anybody is told."""

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from gigabrain_schemas.base import Cause
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import make_folder, read_bounded, replace_file

MOST_BYTES = 65_536
UNREADABLE = Cause(
    code="latch_unreadable",
    text="the file that remembers what latched the gate cannot be read",
    latching=True,
    remedy="look at the robot, then release it",
)


class Latched(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of the file."""

    causes: tuple[Cause, ...] = ()
    estop_generation: Annotated[int, Meta(ge=0, le=2**62)] = 0  # and it can still count on


class LatchFile:
    """One small file, replaced as a whole and synced."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._path = folder, folder / "latch.json"
        self._written = Latched()

    def read(self) -> Latched:
        """What was latched when the driver ended; a file that cannot be read counts as latched.

        Raises ConfigError when the folder cannot be written.
        """
        try:
            make_folder(self._folder)
            found = msgspec.json.decode(read_bounded(self._path, MOST_BYTES), type=Latched)
        except FileNotFoundError:
            found = Latched()
        except (ConfigError, *DECODE_ERRORS):
            found = Latched(causes=(UNREADABLE,))
        except OSError as error:
            raise ConfigError(_unwritable(self._folder, error)) from None
        self.write(found)
        return found

    def keep(self, latched: Latched) -> str:
        """Write; the problem in one line, or an empty text. From one thread at a time."""
        try:
            self.write(latched)
        except ConfigError as error:
            return str(error)
        return ""

    def write(self, latched: Latched) -> None:
        """On disk when this returns. Raises ConfigError when the folder cannot be written."""
        if latched == self._written and self._path.exists():
            return
        try:
            replace_file(self._path, msgspec.json.encode(latched))
        except OSError as error:
            raise ConfigError(_unwritable(self._folder, error)) from None
        self._written = latched


def _unwritable(folder: Path, error: OSError) -> str:
    return (
        f"cannot write {folder}: {error.strerror}; make it writable, "
        "or name another with --state-dir or XDG_STATE_HOME"
    )
