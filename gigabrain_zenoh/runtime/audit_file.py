"""The audit log on disk: JSON lines, appended and synced; never overwritten, bounded in size.

What people have done has files of its own: nothing else that is logged, and nothing that was
refused, can push it out.
"""

import heapq
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from gigabrain_schemas.audit import AuditRecord, What
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded_file import read_bounded

MAX_BYTES = 1_000_000  # of one file; then the next one is begun
KEPT = 8  # files of a kind per process; the oldest is removed
FOLDER = "audit"  # within the folder of what a robot remembers
ACTS: tuple[What, ...] = ("boot", "end", "estop", "release", "enable", "take")
EVENTS = "-events"  # at the end of the name of the files with everything else


class AuditFile:
    """One process's part of the log, in `audit/`, newest last.

    `<process>-<number>.jsonl` has what people have done, `<process>-events-<number>.jsonl` the
    rest.
    """

    def __init__(
        self, folder: Path, process: str, *, max_bytes: int = MAX_BYTES, kept: int = KEPT
    ) -> None:
        self._folder, self._process = folder / FOLDER, process
        self._max_bytes, self._kept = max_bytes, kept

    def append(self, records: Sequence[AuditRecord]) -> str:
        """Write and sync; returns the problem in one line, or an empty text. Blocks."""
        acts = [record for record in records if record.ok and record.what in ACTS]
        events = [record for record in records if not (record.ok and record.what in ACTS)]
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._append(self._process, acts)
            self._append(self._process + EVENTS, events)
        except OSError as error:
            return f"cannot write the audit log in {self._folder}: {error.strerror}"
        return ""

    def newest(self, count: int) -> tuple[AuditRecord, ...]:
        """The last `count` entries, oldest first. Blocks."""
        return read(self._folder.parent, count, self._process)

    def _append(self, name: str, records: Sequence[AuditRecord]) -> None:
        if not records:
            return
        lines = b"".join(msgspec.json.encode(record) + b"\n" for record in records)
        path = self._place(name, len(lines))
        torn = _torn(path)
        with path.open("ab") as file:
            file.write(b"\n" * torn + lines)
            file.flush()
            os.fsync(file.fileno())

    def _place(self, name: str, more: int) -> Path:
        """The file to append to; begins a new one, and removes the oldest, where one is full."""
        files = _files(self._folder, name)
        if files and files[-1].stat().st_size + more <= self._max_bytes:
            return files[-1]
        number = _number(files[-1]) + 1 if files else 1
        for old in files[: max(0, len(files) + 1 - self._kept)]:
            old.unlink()
        return self._folder / f"{name}-{number:06d}.jsonl"


def read(folder: Path, count: int, process: str = "") -> tuple[AuditRecord, ...]:
    """The last `count` entries that a robot's folder holds, in order of time.

    A line that was torn by a power cut is left out. Raises ConfigError.
    """
    names = {process, process + EVENTS}
    if not process:
        names = {path.name.rpartition("-")[0] for path in _all(folder / FOLDER)}
    found = []
    for name in sorted(names):  # of one moment acts come first
        mine: list[AuditRecord] = []
        for path in reversed(_files(folder / FOLDER, name)):
            try:
                text = read_bounded(path, 2 * MAX_BYTES)
            except OSError as error:
                raise ConfigError(f"cannot read {path}: {error.strerror}") from None
            mine = [*_records(text.splitlines()), *mine]
            if len(mine) >= count:
                break
        found.append(mine[-count:])
    return in_order(found)[-count:]


def in_order(logs: Iterable[Sequence[AuditRecord]]) -> tuple[AuditRecord, ...]:
    """Several processes' logs as one, by wall time; each keeps its own order."""
    return tuple(heapq.merge(*logs, key=lambda record: record.stamp_ns))


def _records(lines: Iterable[bytes]) -> Iterator[AuditRecord]:
    for line in lines:
        try:
            yield msgspec.json.decode(line, type=AuditRecord)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            continue


def _all(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.jsonl") if re.search(r"-\d+\.jsonl$", path.name)]


def _files(folder: Path, process: str) -> list[Path]:
    mine = [path for path in _all(folder) if path.name.rpartition("-")[0] == process]
    return sorted(mine, key=_number)


def _number(path: Path) -> int:
    return int(path.stem.rpartition("-")[2])


def _torn(path: Path) -> bool:
    """Whether the file ends in the middle of a line, as a power cut may leave it."""
    if not path.exists() or not path.stat().st_size:
        return False
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) != b"\n"
