"""Reads logs of a run from its files, and from the bus in the same form."""

import asyncio
import heapq
import re
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec

from gigabrain_schemas.safety import LogRecord
from gigabrain_schemas.topics import LOG
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.codec import DECODE_ERRORS
from gigabrain_zenoh.diagnostics.discovery import discover
from gigabrain_zenoh.diagnostics.listener import stop_on_broken_pipe
from gigabrain_zenoh.errors import ConfigError, unknown
from gigabrain_zenoh.host.files import cannot_read, open_regular
from gigabrain_zenoh.host.run_folders import past_runs, state_dir
from gigabrain_zenoh.host.signals import stop_signals
from gigabrain_zenoh.logs import FILE_BYTES, LEVELS, is_time
from gigabrain_zenoh.runtime.running import running

LOG_FILES = "*.jsonl*"  # driver.jsonl, and the older driver.jsonl.1
UNITS_S = {"s": 1, "m": 60, "h": 3600, "d": 86400}
MAX_EARLY = 10_000  # lines that may arrive while the files are read; the oldest are dropped
Line = Mapping[str, Any]


class LogFilter(msgspec.Struct, frozen=True, kw_only=True):
    """Selects the log lines to show."""

    process: str = ""  # empty for all
    level: str = "debug"  # lowest level to show
    since_ns: int = 0  # Unix time

    def __post_init__(self) -> None:
        if self.level not in LEVELS:
            raise unknown("log level", self.level, LEVELS)

    def accepts(self, line: Line) -> bool:
        """Return whether to show a line."""
        return (
            self.process
            in ("", line["process"], line.get("child"))  # or the supervisor's line about it
            and LEVELS.index(line["level"]) >= LEVELS.index(self.level)
            and line["t"] >= self.since_ns
        )


def ago_ns(text: str, now_ns: int) -> int:
    """Return the Unix time of `90s`, `10m`, `2h` or `1d` ago [ns]. Raises ConfigError."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([smhd])", text)
    if not found:
        raise ConfigError(f"--since {text}: expected a time such as 90s, 10m, 2h or 1d")
    return now_ns - round(float(found[1]) * UNITS_S[found[2]] * 1e9)


def run_folder(name: str = "") -> Path:
    """Return the folder of a run, by path or part of its name.

    Without a name it is the newest run that is still running, else the newest of all. Raises
    ConfigError and UnknownName.
    """
    if name and Path(name).is_dir():
        if not any(Path(name).glob(LOG_FILES)):
            raise ConfigError(f"{name}: no logs; expected files such as decision.jsonl")
        return Path(name)
    base = state_dir() / "runs"
    runs = past_runs(base)
    if not runs:
        raise ConfigError(f"{base}: no logs of any run; start one with `gigabrain demo`")
    found = [run for run in runs if name in run.name]
    if not found and any((run / f"{name}.jsonl").exists() for run in runs):
        raise ConfigError(f"no run {name!r}; did you mean `--process {name}`?")
    if not found:
        raise unknown("run", name, [run.name for run in runs[-5:]])
    live = {robot.run_dir for robot in running()} if not name else set()
    return next((run for run in reversed(found) if str(run) in live), found[-1])


def read(folder: Path, wanted: LogFilter, newest: int) -> list[Line]:
    """Return the newest lines of all processes of a run, oldest first. Raises ConfigError."""
    files = sorted(folder.glob(LOG_FILES))
    names = {path.name.partition(".jsonl")[0] for path in files}
    if wanted.process and wanted.process not in names:
        raise unknown("log of a process", wanted.process, names)
    try:
        lines = (line for path in files for line in _lines(path) if wanted.accepts(line))
        # keeps only the newest lines of a long run in memory
        numbered = heapq.nlargest(
            newest, enumerate(lines), key=lambda each: (each[1]["t"], each[0])
        )
    except OSError as error:
        raise cannot_read(error.filename, error) from None
    return [line for _, line in reversed(numbered)]


def _lines(path: Path) -> Iterator[Line]:
    """Yield the complete lines; the last line of a process that died may be cut off."""
    with open_regular(path, 2 * FILE_BYTES) as file:
        for text in file:
            try:
                line = msgspec.json.decode(text)
            except DECODE_ERRORS:
                continue
            if _is_complete(line):
                yield line


def _is_complete(line: object) -> bool:
    return (
        isinstance(line, dict)
        and is_time(line.get("t"))
        and line.get("level") in LEVELS
        and isinstance(line.get("process"), str)
        and isinstance(line.get("event"), str)
    )


def as_line(record: LogRecord) -> Line:
    """Return a record from the bus in the form of a line from a file."""
    known = {
        "t": record.stamp_ns or time.time_ns(),
        "level": record.level,
        "process": record.process,
        "event": record.event,
        "text": record.text,
    }
    return known | {name: value for name, value in record.data.items() if name not in known}


def _identity(line: Line) -> tuple[str, int]:
    """Return the key by which a line from a file equals its record from the bus."""
    return line["process"][:64], line["t"]


async def follow_log(
    bus: Bus, wanted: LogFilter, show: Callable[[Line], None], logged: Callable[[], list[Line]]
) -> None:
    """Pass the `logged` lines to `show`, then new ones, until a signal or a broken pipe.

    It calls `logged` in a thread, after all processes know of the subscription. So no line is lost
    or shown twice.
    """
    early: deque[Line] = deque(maxlen=MAX_EARLY)
    known: set[tuple[str, int]] | None = None

    def receive(_key: str, record: LogRecord) -> None:
        line = as_line(record)
        if not wanted.accepts(line):
            return
        if known is None:
            early.append(line)
        elif _identity(line) not in known:
            show(line)

    bus.subscribe(LOG, receive)
    with stop_signals() as stop, stop_on_broken_pipe(stop):
        stopped = asyncio.ensure_future(stop.wait())
        reading = asyncio.ensure_future(_read_after_subscribing(bus, logged))
        waiting = (stopped, bus.failed)
        await asyncio.wait((*waiting, reading), return_when=asyncio.FIRST_COMPLETED)
        if reading.done():
            lines = reading.result()
            known = set(map(_identity, lines))
            lines += [line for line in early if _identity(line) not in known]
            for line in sorted(lines, key=lambda line: line["t"]):
                show(line)
            await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
        reading.cancel()
        stopped.cancel()
    if bus.failed.done():
        bus.failed.result()  # raises its error, such as a broken pipe


async def _read_after_subscribing(bus: Bus, logged: Callable[[], list[Line]]) -> list[Line]:
    """Read the files after each process replied, and so knows of the subscription."""
    await discover(bus)
    return await asyncio.to_thread(logged)
