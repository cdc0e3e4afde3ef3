"""The file of all runs of the fault suite: a line each, so that a suite can be continued."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
from msgspec import Struct

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.files import read_bounded
from gigabrain_zenoh.qa.faults.fault import Fault, Try
from gigabrain_zenoh.qa.faults.rig import Options

MOST_BYTES = 100_000_000


class Line(Struct, frozen=True, kw_only=True):
    """One run, and what of."""

    number: int
    name: str
    options: Options
    run: Try


_line = msgspec.json.Decoder(Line)


class TriesFile:
    """Appends runs to a file, and knows those of before that were made with the same options."""

    def __init__(self, path: Path, options: Options) -> None:
        self._path, self._options = path, options

    def read(self) -> dict[int, Sequence[Try]]:
        """Return the runs in the file, by the fault's number. Raises ConfigError."""
        runs: dict[int, list[Try]] = {}
        try:
            text = read_bounded(self._path, MOST_BYTES) if self._path.exists() else b""
            for line in map(_line.decode, text.splitlines()):
                if line.options == self._options:
                    runs.setdefault(line.number, []).append(line.run)
        except (OSError, msgspec.MsgspecError) as error:
            raise ConfigError(f"cannot go on with {self._path}: {error}") from None
        return dict(runs)

    def append(self, fault: Fault, run: Try) -> None:
        """Write down one run."""
        line = Line(number=fault.number, name=fault.name, options=self._options, run=run)
        with self._path.open("ab") as file:
            file.write(msgspec.json.encode(line) + b"\n")
