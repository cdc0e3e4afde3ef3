"""The audit trail of one process: on `robot/audit`, on disk, and for requests for its history.

On disk it is JSON lines, appended and synced; never overwritten, bounded in size. Acts of people
are in files of their own, so that a flood of other entries cannot remove them.
"""

import asyncio
import heapq
import logging
import os
import re
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from gigabrain_schemas.logs import AuditPage, AuditRecord, AuditRequest, What
from gigabrain_schemas.topics import AUDIT, AUDIT_LOG
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.host.escaping import printable, printable_json
from gigabrain_zenoh.host.files import cannot_read, read_bounded
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.logs import Fault

MAX_FILE_BYTES = 1_000_000  # of one file; then the next one is started
MAX_FILES = 8  # of acts, and of events, per process; the oldest is removed
FOLDER = "audit"  # within a robot's state folder
ACTS: tuple[What, ...] = ("boot", "end", "estop", "release", "enable", "take")
EVENTS = "-events"  # appended to the process in the names of files with all other entries


class AuditFile:
    """One process's part of the log, in `audit/`, newest last.

    `<process>-<number>.jsonl` has the acts of people, `<process>-events-<number>.jsonl` the rest.
    """

    def __init__(
        self, folder: Path, process: str, *, max_bytes: int = MAX_FILE_BYTES, kept: int = MAX_FILES
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
        """Return the last `count` entries, oldest first. Blocks."""
        return read_audit(self._folder.parent, count, self._process)

    def _append(self, name: str, records: Sequence[AuditRecord]) -> None:
        if not records:
            return
        lines = b"".join(msgspec.json.encode(record) + b"\n" for record in records)
        path = self._file_for(name, len(lines))
        torn = _ends_incomplete(path)
        with path.open("ab") as file:
            file.write(b"\n" * torn + lines)
            file.flush()
            os.fsync(file.fileno())

    def _file_for(self, name: str, added_bytes: int) -> Path:
        """Return the file to append to; if it is full, a new one, and remove the oldest."""
        files = _files(self._folder, name)
        if files and files[-1].stat().st_size + added_bytes <= self._max_bytes:
            return files[-1]
        number = _number(files[-1]) + 1 if files else 1
        for old in files[: max(0, len(files) + 1 - self._kept)]:
            old.unlink()
        return self._folder / f"{name}-{number:06d}.jsonl"


def read_audit(folder: Path, count: int, process: str = "") -> tuple[AuditRecord, ...]:
    """Return the last `count` entries in a robot's folder, in order of time.

    A line that a power cut left incomplete is skipped. Raises ConfigError.
    """
    names = {process, process + EVENTS}
    if not process:
        names = {path.name.rpartition("-")[0] for path in _all_files(folder / FOLDER)}
    logs = []
    for name in sorted(names):  # at equal times, acts precede events
        records: list[AuditRecord] = []
        for path in reversed(_files(folder / FOLDER, name)):
            try:
                text = read_bounded(path, 2 * MAX_FILE_BYTES)
            except OSError as error:
                raise cannot_read(path, error) from None
            records = [*_records(text.splitlines()), *records]
            if len(records) >= count:
                break
        logs.append(records[-count:])
    return in_order(logs)[-count:]


def in_order(logs: Iterable[Sequence[AuditRecord]]) -> tuple[AuditRecord, ...]:
    """Merge the logs of several processes by wall time; each keeps its own order.

    The merge starts at the newest entries, as the clock may have stepped back before them.
    """
    backwards = [_with_latest_time(log) for log in reversed(list(logs))]
    merged = heapq.merge(*backwards, key=lambda timed: timed[0], reverse=True)
    return tuple(record for _, record in merged)[::-1]


def _with_latest_time(log: Sequence[AuditRecord]) -> Iterator[tuple[int, AuditRecord]]:
    """Yield the entries, newest first, each with the earliest time of itself and all newer ones."""
    time_ns = 2**63
    for record in reversed(log):
        time_ns = min(time_ns, record.stamp_ns)
        yield time_ns, record


def _records(lines: Iterable[bytes]) -> Iterator[AuditRecord]:
    for line in lines:
        try:
            yield msgspec.json.decode(line, type=AuditRecord)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            continue


def _all_files(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*.jsonl") if re.search(r"-\d+\.jsonl$", path.name)]


def _files(folder: Path, process: str) -> list[Path]:
    found = [path for path in _all_files(folder) if path.name.rpartition("-")[0] == process]
    return sorted(found, key=_number)


def _number(path: Path) -> int:
    return int(path.stem.rpartition("-")[2])


def _ends_incomplete(path: Path) -> bool:
    """Return whether the last line has no newline, as after a power cut."""
    if not path.exists() or not path.stat().st_size:
        return False
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        return file.read(1) != b"\n"


WIDTH = 8  # characters of the longest of What


def readable(record: AuditRecord) -> str:
    """Return `2026-01-01 00:00:00 tick 205  estop  ann: stopped and latched; e-stop number 2`."""
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(record.stamp_ns / 1e9))
    verdict = "" if record.ok else " [refused]" if record.what != "refused" else ""
    code = f" {record.code}" if record.code else ""
    times = f" ({record.times} times)" if record.times > 1 else ""
    line = (
        f"{when} tick {record.tick:<7} {record.process:<7} {record.what:<{WIDTH}} "
        f"{record.source}{code}{verdict}: {record.text}{times}"
    )
    return printable(line)


def as_json(record: AuditRecord) -> str:
    """Return the entry as JSON in one line."""
    return printable_json(msgspec.json.encode(record).decode())


log = logging.getLogger(__name__)
REPEAT_NS = 1_000_000_000  # repetitions within this time are only counted
REFUSAL_REPEAT_NS = 60_000_000_000  # the same for refusals
REFUSALS: tuple[What, ...] = ("refused", "stranger")
MAX_SOURCES = 100  # counted separately within that time, for granted and for refused requests
MAX_CODES = 20  # counted separately in one entry
MAX_QUEUED = 1000  # entries that may wait for the disk
OTHER_SOURCES, OTHER_CODES = "others", "other"
Key = tuple[What, str, str]  # what, source, code; no code where a source has one entry for all


@dataclass
class _Recent:
    """Events of one source since its last entry, by code."""

    written_ns: int  # time of that entry
    codes: Counter[str] = field(default_factory=Counter)
    text: str = ""

    def add(self, code: str, text: str) -> None:
        known = code in self.codes or len(self.codes) < MAX_CODES
        self.codes[code if known else OTHER_CODES] += 1
        self.text = text


class AuditTrail:
    """Writes entries. Never waits for the disk, and cannot be flooded.

    Call `flush` about once a second.
    """

    def __init__(self, bus: Bus, folder: Path) -> None:
        self._bus = bus
        self._file = AuditFile(folder, bus.process)
        self._writer: BackgroundWriter[AuditRecord] = BackgroundWriter(
            self._file.append, MAX_QUEUED
        )
        self._recent: dict[bool, dict[Key, _Recent]] = {True: {}, False: {}}  # by `ok`
        self._unwritable = Fault(log)
        self._reading = asyncio.Lock()  # several decoding threads would delay the event loop
        bus.serve(AUDIT_LOG, self._history)

    def note(
        self, what: What, source: str, text: str = "", *, code: str = "", ok: bool = True
    ) -> None:
        """Write an entry about an event and its source.

        A source gets at most one entry of refusals a minute, for all codes together.
        """
        now_ns = self._bus.clock.now_ns()
        source, code, text = source[:64], code[:64], text[:500]
        known = self._recent[ok]
        key: Key = (what, source, "" if what == "refused" else code)
        if key not in known and len(known) >= MAX_SOURCES:
            key = (what, OTHER_SOURCES, "")
        recent = known.get(key)
        new = recent is None
        if recent is None:
            recent = known[key] = _Recent(now_ns)
        recent.add(code, text)
        if new or now_ns - recent.written_ns >= _repeat_ns(key):
            self._write_entry(key, recent, ok)

    def flush(self) -> None:
        """Write the repeated events, with their counts."""
        now_ns = self._bus.clock.now_ns()
        for ok, known in self._recent.items():
            for key, recent in list(known.items()):
                age_ns = now_ns - recent.written_ns
                if recent.codes and age_ns >= _repeat_ns(key):
                    self._write_entry(key, recent, ok)
                elif age_ns >= REFUSAL_REPEAT_NS:
                    del known[key]

    async def close(self) -> None:
        """Write the entries that are still waiting."""
        for ok, known in self._recent.items():
            for key, recent in known.items():
                if recent.codes:
                    self._write_entry(key, recent, ok)
            known.clear()
        await self._writer.close()

    def _write_entry(self, key: Key, recent: _Recent, ok: bool) -> None:
        what, source, _ = key
        (code, _), *others = recent.codes.most_common()
        counts = f"; {_counts(recent.codes)}" if others else ""
        record = AuditRecord(
            process=self._bus.process,
            what=what,
            source=source,
            ok=ok,
            code=code,
            text=recent.text[: 500 - len(counts)] + counts,
            times=recent.codes.total(),
        )
        recent.written_ns, recent.codes = self._bus.clock.now_ns(), Counter()
        written = self._writer.put(self._bus.publish(AUDIT, record))
        written.add_done_callback(self._written)

    def _written(self, written: asyncio.Future[str]) -> None:
        self._bus.counters["audit_lost"] = self._writer.lost
        if problem := written.result():
            self._unwritable.begin(problem)
        else:
            self._unwritable.end("the audit log is written again")

    async def _history(self, request: AuditRequest) -> AuditPage:
        async with self._reading:
            records = await asyncio.to_thread(self._file.newest, request.newest)
        return AuditPage(records=records)


def _repeat_ns(key: Key) -> int:
    what, source, _ = key
    return REFUSAL_REPEAT_NS if what in REFUSALS or source == OTHER_SOURCES else REPEAT_NS


def _counts(codes: Counter[str]) -> str:
    """Return `put robot/cmd_vel 199, query robot/release 1`, cut at 200 characters."""
    return ", ".join(f"{code} {times}" for code, times in codes.most_common())[:200]
