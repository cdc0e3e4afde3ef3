"""Logging of one process: JSON lines in the run folder, a console, and the bus."""

import asyncio
import contextlib
import logging
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Mapping
from logging.handlers import QueueHandler, QueueListener, RotatingFileHandler
from pathlib import Path
from typing import Any, Final

import msgspec

from gigabrain_schemas.safety import LogRecord
from gigabrain_zenoh import errors
from gigabrain_zenoh.errors import GigabrainError, without_logins
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.run_folders import unwritable_runs

LEVELS: Final = ("debug", "info", "warning", "error", "critical")
_SHOWN_APART = frozenset({"t", "level", "process", "event", "text", "traceback"})
_COLOURS = {"debug": "2", "warning": "33", "error": "31", "critical": "1;31"}
_FORMATTER = logging.Formatter()


def is_time(t: object) -> bool:
    """Return whether `t` is a time in nanoseconds that can be shown."""
    return type(t) is int and 0 <= t < 2**63


def level_of(record: logging.LogRecord) -> str:
    """Return the highest of LEVELS that is not above the record's own level."""
    return _level(record.levelno)


def level_named(name: str) -> str:
    """Return the level of LEVELS for names such as `WARN` or `Fatal`; info for unknown names."""
    return _level(logging.getLevelNamesMapping().get(name.upper(), logging.INFO))


def _level(number: int) -> str:
    return LEVELS[min(max(number // 10 - 1, 0), len(LEVELS) - 1)]


def fields(record: logging.LogRecord, process: str) -> dict[str, Any]:
    """Return `{"t": unix_ns, "level", "process", "event", "text"}` and the record's own `data`.

    `data` is passed as `extra={"data": {...}}`. Its key `event` names the event; other keys cannot
    replace the fields above. Addresses in texts have no user and password.
    """
    data = getattr(record, "data", {})
    known: dict[str, Any] = {
        "t": int(record.created * 1e9),
        "level": level_of(record),
        "process": process,
        "event": str(data.get("event", "log")),
        "text": _text_of(record),
    }
    if record.exc_info:
        known["traceback"] = _FORMATTER.formatException(record.exc_info)
    whole = known | {str(k): v for k, v in data.items() if k not in known}
    return {k: without_logins(v) if isinstance(v, str) else v for k, v in whole.items()}


def _text_of(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except (TypeError, ValueError, KeyError):  # a library's arguments do not match its format
        return f"{record.msg} {record.args}"


# own code: json.dumps, as in structlog, raises on cycles and writes NaN, which is not JSON
def encode(record: Mapping[str, Any]) -> bytes:
    """Return one line of JSON without a newline, for any values; NaN becomes null."""
    try:
        return _ENCODER.encode(record)
    except (TypeError, ValueError, OverflowError, RecursionError):
        # a cycle, a lone surrogate or an unusual key: write the line in a simpler form
        return _ENCODER.encode({ascii(key)[1:-1]: _safe(value) for key, value in record.items()})


def readable(record: Mapping[str, Any], *, colour: bool = False) -> str:
    """Return `12:03:44 driver     warning  text key=value`, in local time, without a newline."""
    clock = time.strftime("%H:%M:%S", time.localtime(record["t"] / 1e9))
    level, text = str(record["level"]), printable(record.get("text") or record["event"])
    data = [
        f"{printable(key)}={printable(_value(value))}"
        for key, value in record.items()
        if key not in _SHOWN_APART
    ]
    shown = f"\033[{_COLOURS[level]}m{level:<8}\033[0m" if colour and level in _COLOURS else level
    line = f"{clock} {printable(record['process']):<10} {shown:<8} {' '.join([text, *data])}"
    rest = str(record.get("traceback", "")).splitlines()
    return "\n".join([line, *("    " + printable(more) for more in rest)])


def _plain(value: object) -> object:
    """Convert values that msgspec does not know: numpy to numbers, others to text."""
    to_list = getattr(value, "tolist", None)
    return to_list() if callable(to_list) else str(value)


def _safe(value: object) -> object:
    return value if isinstance(value, int) else ascii(value)


def _value(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str) and value and " " not in value:
        return value
    return encode({"": value})[4:-1].decode()


_ENCODER = msgspec.json.Encoder(enc_hook=_plain)
log = logging.getLogger(__name__)
QUEUED_RECORDS = 1000  # per file and console; more are dropped and counted
QUIET_NS = 1_000_000_000  # without the fault; then a QuietFault ends
LAST_WORDS_S = 0.5  # the end of a process waits this long for its last records
FILE_BYTES = 10_000_000  # of one log file; then the next is started
OLD_FILES = 2  # kept per process, besides the current one


class Fault:
    """A fault that lasts: logged once when it begins and once when it ends."""

    def __init__(self, log: logging.Logger, level: int = logging.WARNING) -> None:
        self._log, self._level = log, level
        self._times = 0

    @property
    def active(self) -> bool:
        """Return whether the fault is present."""
        return self._times > 0

    def begin(self, text: str, data: Mapping[str, Any] | None = None) -> None:
        """Begin the fault, or count it again; only the first call after an end is logged."""
        self._times += 1
        if self._times == 1:
            about = {"event": "fault", **(data or {})}
            self._log.log(self._level, "%s", text, extra={"data": about})

    def end(self, text: str) -> None:
        """End the fault; if it had begun, log that with the number of its occurrences."""
        times, self._times = self._times, 0
        if times:
            about = {"event": "fault ended", "times": times}
            self._log.info("%s", text, extra={"data": about})


class QuietFault:
    """A fault that ends after a second without it, as good and bad messages may alternate."""

    def __init__(self, log: logging.Logger) -> None:
        self._fault, self._last_ns = Fault(log), 0

    def begin(self, text: str, now_ns: int) -> None:
        """Log the fault, unless it is already present."""
        self._last_ns = now_ns
        self._fault.begin(text)

    def end(self, text: str, now_ns: int) -> None:
        """Log the end of the fault, if it did not occur for a second."""
        if self._fault.active and now_ns - self._last_ns >= QUIET_NS:
            self._fault.end(text)


class BusHandler(logging.Handler):
    """Passes records of level info and above to `publish`, on its event loop's thread."""

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
        if self._busy:  # publishing itself logs a record
            return
        self._busy = True
        try:
            self._publish(_message(record, self._process))
        except GigabrainError:
            self.lost += 1
        finally:
            self._busy = False


def _message(record: logging.LogRecord, process: str) -> LogRecord:
    """Return the record, shortened to the limits of its message; the file contains all of it.

    It has the same time as its line in the file, so that readers can match them.
    """
    known = fields(record, process)
    text = str(known.pop("text"))
    event, level = str(known.pop("event")), known.pop("level")
    data = {k: str(v) for k, v in known.items() if k not in ("t", "process", "traceback")}
    short = {_clean(k)[:64]: _clean(v)[:200] for k, v in list(data.items())[:12]}
    if traceback := known.get("traceback"):
        short["traceback"] = _clean(traceback)[-1500:]
    return LogRecord(
        stamp_ns=known["t"],
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
        return encode(fields(record, self._process)).decode()


class _ReadableFormatter(logging.Formatter):
    def __init__(self, process: str, colour: bool) -> None:
        super().__init__()
        self._process, self._colour = process, colour

    def format(self, record: logging.LogRecord) -> str:
        return readable(fields(record, self._process), colour=self._colour)


class _File(RotatingFileHandler):
    """A log file that reports a full disk once, and its end once."""

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


class QueuedHandler(QueueHandler):
    """Formats records in the thread that logs them; `sink` writes them in its own thread.

    So a full disk, or a blocked console, delays neither the event loop nor the end of the process.
    When `QUEUED_RECORDS` wait, more are dropped; their number is logged later.
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
        """Queue the record, or count it as lost."""
        try:
            self._records.put_nowait(record)
            if self.lost:
                self._records.put_nowait(self._loss())
                self.lost = 0
        except queue.Full:
            self.lost += 1

    def _loss(self) -> logging.LogRecord:
        """Build a record about lost records for this sink; logging it would lock the others."""
        text, lost = f"{self.lost} records did not reach the {self._name}", self.lost
        record = logging.LogRecord(log.name, logging.WARNING, "", 0, text, None, None)
        record.data = {"event": "log records lost", "lost": lost}
        return self.prepare(record)  # type: ignore[no-any-return]

    def flush(self) -> None:
        """Wait until all records are written, at most `LAST_WORDS_S`."""
        waiting = self._records
        with waiting.all_tasks_done:
            waiting.all_tasks_done.wait_for(lambda: not waiting.unfinished_tasks, LAST_WORDS_S)

    def close(self) -> None:
        """Write all queued records, and close the sink, unless it hangs."""
        self.flush()
        super().close()
        if not self._closed and not self._records.unfinished_tasks:
            self._closed = True
            self._listener.stop()
            with contextlib.suppress(OSError):  # buffered data on a full disk
                self._sink.close()


def setup(process: str, run_dir: Path | None, *, json_console: bool, level: str = "info") -> None:
    """Log to `<run_dir>/<process>.jsonl` and to stderr; a later call replaces an earlier one.

    Raises ConfigError if the folder cannot be written, and UnknownName for an unknown level.
    """
    if level not in LEVELS:
        raise errors.unknown("log level", level, LEVELS)
    sinks = [] if run_dir is None else [file_sink(process, run_dir)]
    console = _JsonFormatter(process) if json_console else _ReadableFormatter(process, _colour())
    sinks.append(QueuedHandler(logging.StreamHandler(sys.stderr), console, "console"))
    root = logging.getLogger()
    for old in _sinks():
        root.removeHandler(old)
        old.close()
    for sink in sinks:
        root.addHandler(sink)
    root.setLevel(level.upper())


def flush() -> None:
    """Wait until all records are written, but not for a sink that hangs."""
    for sink in _sinks():
        sink.flush()


def _sinks() -> list[QueuedHandler]:
    return [sink for sink in logging.getLogger().handlers if isinstance(sink, QueuedHandler)]


def file_sink(process: str, run_dir: Path) -> QueuedHandler:
    """Return a handler that writes `<run_dir>/<process>.jsonl`. Raises ConfigError."""
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        file = _File(run_dir / f"{process}.jsonl")
    except OSError as error:
        raise unwritable_runs(run_dir, error) from None
    return QueuedHandler(file, _JsonFormatter(process), "log file")


def _colour() -> bool:
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return not plain and sys.stderr.isatty()
