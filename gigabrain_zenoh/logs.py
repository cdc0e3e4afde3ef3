"""Logging of one process: JSON lines in the run folder, a console, and the bus."""

import asyncio
import contextlib
import itertools
import logging
import os
import queue
import re
import sys
import threading
import time
from collections.abc import Callable, Mapping
from logging.handlers import QueueHandler, QueueListener, RotatingFileHandler
from pathlib import Path
from typing import Any

from gigabrain_schemas.safety import LogRecord
from gigabrain_zenoh import errors
from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.host import log_text, run_folders

log = logging.getLogger(__name__)

QUEUED_RECORDS = 1000  # for each of file and console; more are dropped and counted
LAST_WORDS_S = 0.5  # how long the end of a process waits until they are written
FILE_BYTES = 10_000_000  # of one log file; then the next is begun
OLD_FILES = 2  # of a process, beside the one that is written


class Fault:
    """Something that is wrong for a while: logged once when it begins and once when it ends."""

    def __init__(self, log: logging.Logger, level: int = logging.WARNING) -> None:
        self._log, self._level = log, level
        self._times = 0

    @property
    def active(self) -> bool:
        """Whether the fault has begun and not ended."""
        return self._times > 0

    def begin(self, text: str, data: Mapping[str, Any] | None = None) -> None:
        """The fault is there; only the first call after an end is logged."""
        self._times += 1
        if self._times == 1:
            about = {"event": "fault", **(data or {})}
            self._log.log(self._level, "%s", text, extra={"data": about})

    def end(self, text: str) -> None:
        """The fault is gone; logged if it had begun, with how many times it was seen."""
        times, self._times = self._times, 0
        if times:
            about = {"event": "fault ended", "times": times}
            self._log.info("%s", text, extra={"data": about})


class BusHandler(logging.Handler):
    """Hands records of level info and above to `publish`, on the loop's thread it was made on."""

    def __init__(self, publish: Callable[[LogRecord], object], process: str) -> None:
        super().__init__(logging.INFO)
        self._publish, self._process = publish, process
        self._loop, self._thread = asyncio.get_running_loop(), threading.get_ident()
        self._busy = False
        self.lost = 0  # records that the bus did not take

    def emit(self, record: logging.LogRecord) -> None:
        """Publish at once, or from the loop when another thread is logging."""
        if threading.get_ident() == self._thread:
            self._send(record)
            return
        try:
            self._loop.call_soon_threadsafe(self._send, record)
        except RuntimeError:  # the loop is closed
            self.lost += 1

    def _send(self, record: logging.LogRecord) -> None:
        if self._busy:  # publishing logs something in its turn
            return
        self._busy = True
        try:
            self._publish(_message(record, self._process))
        except GigabrainError:
            self.lost += 1
        finally:
            self._busy = False


def _message(record: logging.LogRecord, process: str) -> LogRecord:
    """The record within the bounds of its message: the bus carries the gist, the file the whole."""
    known = log_text.fields(record, process)
    text = str(known.pop("text"))
    event, level = str(known.pop("event")), known.pop("level")
    data = {k: str(v) for k, v in known.items() if k not in ("t", "process", "traceback")}
    short = {_clean(k)[:64]: _clean(v)[:200] for k, v in list(data.items())[:12]}
    if traceback := known.get("traceback"):
        short["traceback"] = _clean(traceback)[-1500:]
    return LogRecord(
        process=process[:64],
        level=level,
        event=_clean(event)[:64],
        text=_clean(text)[:500],
        data=short,
    )


def _clean(text: str) -> str:
    return text.encode(errors="replace").decode()


class _JsonFormatter(logging.Formatter):
    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        return log_text.encode(log_text.fields(record, self._process)).decode()


class _ReadableFormatter(logging.Formatter):
    def __init__(self, process: str, colour: bool) -> None:
        super().__init__()
        self._process, self._colour = process, colour

    def format(self, record: logging.LogRecord) -> str:
        fields = log_text.fields(record, self._process)
        return log_text.readable(fields, colour=self._colour)


class _File(RotatingFileHandler):
    """A log file whose disk may fill up: that is said once, and again when there is room."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, maxBytes=FILE_BYTES, backupCount=OLD_FILES, encoding="utf-8")
        self._fault, self._failed = Fault(log), False

    def emit(self, record: logging.LogRecord) -> None:
        self._failed = False
        super().emit(record)
        if not self._failed:
            self._fault.end(f"{self.baseFilename} is written again")

    def handleError(self, record: logging.LogRecord) -> None:
        self._failed = True
        self._fault.begin(f"cannot write {self.baseFilename}: {sys.exc_info()[1]}")


class Background(QueueHandler):
    """Formats records where they are logged, and has `sink` write them in a thread of its own.

    So a full disk, or a console that nobody reads, holds up neither the event loop nor the end of
    the process. When `QUEUED_RECORDS` wait, more are dropped; how many is logged later.
    """

    def __init__(self, sink: logging.Handler, formatter: logging.Formatter, name: str) -> None:
        self._records: queue.Queue[logging.LogRecord] = queue.Queue(QUEUED_RECORDS)
        super().__init__(self._records)
        self.setFormatter(formatter)
        self.lost = 0
        self._sink, self._name, self._closed = sink, name, False
        self._listener = QueueListener(self._records, sink)
        self._listener.start()

    def enqueue(self, record: logging.LogRecord) -> None:
        """Have the record written, or count it as lost."""
        try:
            self._records.put_nowait(record)
            if self.lost:
                self._records.put_nowait(self._loss())
                self.lost = 0
        except queue.Full:
            self.lost += 1

    def _loss(self) -> logging.LogRecord:
        """Tell this sink alone: to log it would take the locks of the others."""
        text, lost = f"{self.lost} records did not reach the {self._name}", self.lost
        record = logging.LogRecord(log.name, logging.WARNING, "", 0, text, None, None)
        record.data = {"event": "log records lost", "lost": lost}
        return self.prepare(record)  # type: ignore[no-any-return]

    def flush(self) -> None:
        """Wait until all is written, `LAST_WORDS_S` at most."""
        waiting = self._records
        with waiting.all_tasks_done:
            waiting.all_tasks_done.wait_for(lambda: not waiting.unfinished_tasks, LAST_WORDS_S)

    def close(self) -> None:
        """Write what waits, and close the sink; one that hangs is left behind."""
        self.flush()
        super().close()
        if not self._closed and not self._records.unfinished_tasks:
            self._closed = True
            self._listener.stop()
            with contextlib.suppress(OSError):  # what a full disk still owed
                self._sink.close()


def setup(process: str, run_dir: Path | None, *, json_console: bool, level: str = "info") -> None:
    """Log to `<run_dir>/<process>.jsonl` and to stderr; a second call replaces the first.

    Raises ConfigError when the folder cannot be written, UnknownName for a level that is none.
    """
    if level not in log_text.LEVELS:
        raise errors.unknown("log level", level, log_text.LEVELS)
    sinks = [] if run_dir is None else [_file(process, run_dir)]
    console = _JsonFormatter(process) if json_console else _ReadableFormatter(process, _colour())
    sinks.append(Background(logging.StreamHandler(sys.stderr), console, "console"))
    root = logging.getLogger()
    for old in _sinks():
        root.removeHandler(old)
        old.close()
    for sink in sinks:
        root.addHandler(sink)
    root.setLevel(level.upper())


def flush() -> None:
    """Wait until what was logged is written, but not for what hangs."""
    for sink in _sinks():
        sink.flush()


def _sinks() -> list[Background]:
    return [one for one in logging.getLogger().handlers if isinstance(one, Background)]


def _file(process: str, run_dir: Path) -> Background:
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        file = _File(run_dir / f"{process}.jsonl")
    except OSError as error:
        raise _unwritable(run_dir, error) from None
    return Background(file, _JsonFormatter(process), "log file")


def _colour() -> bool:
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return not plain and sys.stderr.isatty()


def new_run_dir(base: Path | None, label: str) -> Path:
    """Create `<base>/<UTC stamp>-<label>-<pid>`; `base` None is the user's state folder (XDG).

    Old run folders are removed first (see `run_folders`), and this one is marked as in use. Raises
    ConfigError when it cannot be created.
    """
    base = base or state_dir() / "runs"
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    name = f"{stamp}-{re.sub(r'[^A-Za-z0-9._-]+', '-', label)}-{os.getpid()}"
    try:
        with run_folders.tidied(base):
            for n in itertools.count(1):
                path = base / (name if n == 1 else f"{name}-{n}")
                if not path.exists():  # by an earlier run of this process in this second
                    break
            path.mkdir()
            run_folders.hold(path)
            return path
    except OSError as error:
        raise _unwritable(base, error) from None


def state_dir() -> Path:
    """Return the folder in which runs and robots keep their state. Raises ConfigError."""
    from platformdirs import user_state_path  # 10 ms, of which not every command has need

    try:
        return user_state_path("gigabrain")
    except RuntimeError:
        raise ConfigError("there is no home folder; set XDG_STATE_HOME to a folder") from None


def _unwritable(folder: Path, error: OSError) -> ConfigError:
    return ConfigError(
        f"cannot write the run folder {folder}: {error.strerror}; "
        "make it writable, or set XDG_STATE_HOME to a folder that is"
    )
