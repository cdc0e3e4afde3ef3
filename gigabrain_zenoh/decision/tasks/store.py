"""Tasks on disk: they survive a restart of decision."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.decision.tasks.executive import Saved
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import make_folder, read_bounded, replace_file

MOST_BYTES = 1_000_000


class TaskFile:
    """One small file, replaced as a whole and synced; nowhere, where there is no folder."""

    def __init__(self, folder: str) -> None:
        self._path = Path(folder) / "tasks.json" if folder else None

    def read(self) -> tuple[Saved, str]:
        """What there was to do, and a problem in one line. What cannot be read is set aside."""
        if self._path is None:
            return Saved(), ""
        try:
            return msgspec.json.decode(read_bounded(self._path, MOST_BYTES), type=Saved), ""
        except FileNotFoundError:
            return Saved(), ""
        except OSError as error:
            return Saved(), f"{self._path} cannot be read: {error.strerror}; nothing is to be done"
        except (ConfigError, *DECODE_ERRORS) as error:
            return Saved(), self._set_aside(self._path, error)

    def write(self, newest: Sequence[Saved]) -> str:
        """Write the last of `newest`; the problem in one line, or an empty text."""
        if self._path is None:
            return ""
        try:
            make_folder(self._path.parent)
            replace_file(self._path, msgspec.json.encode(newest[-1]))
        except OSError as error:
            return f"cannot write {self._path}: {error.strerror}; tasks will not survive a restart"
        return ""

    def _set_aside(self, path: Path, error: Exception) -> str:
        bad = path.with_suffix(".bad")
        try:
            path.replace(bad)
        except OSError as problem:
            return f"{path} is damaged ({error}) and stays: {problem.strerror}"
        return f"{path} is damaged ({error}); it is {bad} now, and nothing is to be done"
