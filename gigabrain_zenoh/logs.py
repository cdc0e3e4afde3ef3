"""Logging of one process: JSON lines in the run folder, a console, and the bus."""

import asyncio
import contextlib
import logging
import os
import re
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

from gigabrain_schemas.safety import LogRecord
from gigabrain_zenoh import errors, log_text
from gigabrain_zenoh.errors import ConfigError, GigabrainError


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


class _Console(logging.StreamHandler[TextIO]):
    pass


class _File(logging.FileHandler):
    """A log file whose disk may fill up: that is said once, and again when there is room."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, encoding="utf-8")
        self._fault, self._failed = Fault(logging.getLogger(__name__)), False

    def emit(self, record: logging.LogRecord) -> None:
        self._failed = False
        super().emit(record)
        if not self._failed:
            self._fault.end(f"{self.baseFilename} is written again")

    def handleError(self, record: logging.LogRecord) -> None:
        self._failed = True
        self._fault.begin(f"cannot write {self.baseFilename}: {sys.exc_info()[1]}")


def setup(process: str, run_dir: Path | None, *, json_console: bool, level: str = "info") -> None:
    """Log to `<run_dir>/<process>.jsonl` and to stderr; a second call replaces the first.

    Raises ConfigError when the folder cannot be written, UnknownName for a level that is none.
    """
    if level not in log_text.LEVELS:
        raise errors.unknown("log level", level, log_text.LEVELS)
    handlers: list[logging.Handler] = [] if run_dir is None else [_file(process, run_dir)]
    console = _Console(sys.stderr)
    console.setFormatter(
        _JsonFormatter(process) if json_console else _ReadableFormatter(process, _colour())
    )
    root = logging.getLogger()
    for old in [h for h in root.handlers if isinstance(h, (_Console, _File))]:
        root.removeHandler(old)
        with contextlib.suppress(OSError):  # what a full disk still owed
            old.close()
    for handler in [*handlers, console]:
        root.addHandler(handler)
    root.setLevel(level.upper())


def _file(process: str, run_dir: Path) -> logging.Handler:
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        handler = _File(run_dir / f"{process}.jsonl")
    except OSError as error:
        raise _unwritable(run_dir, error) from None
    handler.setFormatter(_JsonFormatter(process))
    return handler


def _colour() -> bool:
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb"
    return not plain and sys.stderr.isatty()


def new_run_dir(base: Path | None, label: str) -> Path:
    """Create `<base>/<UTC stamp>-<label>-<pid>`; `base` None is the user's state folder (XDG).

    Raises ConfigError when it cannot be created.
    """
    base = base or state_dir() / "runs"
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    name = f"{stamp}-{re.sub(r'[^A-Za-z0-9._-]+', '-', label)}-{os.getpid()}"
    path, n = base / name, 1
    while True:
        try:
            path.mkdir(parents=True)
            return path
        except FileExistsError:  # an earlier run of this process in this second
            n += 1
            path = base / f"{name}-{n}"
        except OSError as error:
            raise _unwritable(base, error) from None


def state_dir() -> Path:
    """Where runs and robots leave what they have to remember (XDG). Raises ConfigError."""
    given = os.environ.get("XDG_STATE_HOME", "")
    if os.path.isabs(given):  # the XDG base directory specification ignores relative paths
        return Path(given) / "gigabrain"
    try:
        return Path.home() / ".local" / "state" / "gigabrain"
    except RuntimeError:
        raise ConfigError("there is no home folder; set XDG_STATE_HOME to a folder") from None


def _unwritable(folder: Path, error: OSError) -> ConfigError:
    return ConfigError(
        f"cannot write the run folder {folder}: {error.strerror}; "
        "make it writable, or set XDG_STATE_HOME to a folder that is"
    )
