"""Brings what the intake holds to the disk, in its own thread, and outlives the disk's faults."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from msgspec import Struct

from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.recording.bagfile import BagFile, topic_of
from gigabrain_zenoh.recording.intake import Arrival, Intake

log = logging.getLogger(__name__)

MB = 1_000_000
LOOK_S = 0.3  # how often the queue is emptied, at least: every time costs cold caches
RETRY_S = 1.0  # how often a full disk is tried again
Open = Callable[[Path], BagFile]


class Status(Struct, frozen=True, kw_only=True):
    """How a recording is doing."""

    path: Path
    seconds: float  # since its start
    size: int  # [bytes] on the disk, of all its files
    files: int
    seen: int  # messages that came
    written: int  # of these, on the disk
    dropped: int  # of these, lost here: the disk was too slow, or full
    missing: int  # messages that never came, by their senders' count
    fault: str  # what is wrong with the disk now


class Recorder:
    """One recording, of one file or of several in a row. Used as a context manager."""

    def __init__(self, path: Path, config: RecorderConfig, open_file: Open | None = None) -> None:
        self._path, self._config = path, config
        self._open = open_file or self._default_open
        began_unix, began = time.time_ns(), time.monotonic_ns()
        room = round(config.queue_mb * MB)
        self._wake, self._ended = threading.Event(), False
        self.intake = Intake(room, lambda: began_unix + time.monotonic_ns() - began, self._wake.set)
        self._began_s = time.monotonic()
        self._count = self._done_bytes = self._written = 0
        self._file: BagFile | None = None
        self._kept: dict[str, Arrival] = {}  # newest of what late joiners ask for
        self._flushed_s, self._retry_s = time.monotonic(), 0.0
        self._fault_text, self._fault = "", Fault(log, logging.ERROR)
        self._pool = ThreadPoolExecutor(1, "recorder")
        self.done: Future[None] | None = None  # settled early by a fault of ours alone

    def begin(self) -> None:
        """Make the file now, so that one that cannot be written is told at once.

        Without this call it is made, or tried again every second, when there is something to write.
        Raises ConfigError.
        """
        self._file = self._next()

    def __enter__(self) -> "Recorder":
        self.done = self._pool.submit(self._run)
        return self

    def __exit__(self, *_: object) -> None:
        """Write what is left and finish the file."""
        self._ended = True
        self._wake.set()
        self._pool.shutdown()

    def status(self) -> Status:
        """How it is doing now."""
        seen, dropped, missing = self.intake.counts()
        file = self._file
        return Status(
            path=file.path if file else self._path,
            seconds=time.monotonic() - self._began_s,
            size=self._done_bytes + (file.size if file else 0),
            files=self._count,
            seen=seen,
            written=self._written + (file.written if file else 0),
            dropped=dropped,
            missing=missing,
            fault=self._fault_text,
        )

    def _default_open(self, path: Path) -> BagFile:
        return BagFile(path, viewers=self._config.viewers, notes=self._config.notes)

    def _next(self) -> BagFile:
        """The next file of the row. Raises ConfigError where it cannot be made."""
        path = self._path
        if self._count:
            path = path.with_name(f"{path.stem}_{self._count}{path.suffix}")
        file = self._open(path)
        self._count += 1
        return file

    def _run(self) -> None:
        while not self._ended:
            self._wake.wait(LOOK_S)
            self._wake.clear()
            self._turn()
        self._turn()
        self._finish()

    def _turn(self) -> None:
        batch = self.intake.hand_over()
        for arrival in batch:
            self._write(arrival)
        self.intake.written(batch)
        if time.monotonic() - self._flushed_s >= self._config.flush_s:
            self._flush()

    def _write(self, arrival: Arrival) -> None:
        topic = topic_of(arrival.key)
        if topic and topic.keep:
            self._kept[arrival.key] = arrival
        file = self._file or self._again(arrival)
        if file is None:
            self.intake.lose(Counter((arrival.key,)))
            return
        try:
            file.add(arrival)
        except OSError as error:
            self._broken(file, f"cannot write {file.path}: {error.strerror}")
            return
        if self._full(file, arrival):
            self._finish()

    def _full(self, file: BagFile, arrival: Arrival) -> bool:
        split_mb, split_s = self._config.split_mb, self._config.split_s
        too_big = split_mb is not None and file.size >= split_mb * MB
        return too_big or (
            split_s is not None and arrival.log_ns - file.first_ns >= split_s * 1_000_000_000
        )

    def _flush(self) -> None:
        self._flushed_s = time.monotonic()
        file = self._file
        if file is None:
            return
        try:
            file.flush()
            if file.free_bytes() < self._config.keep_free_mb * MB:
                self._finish()
                self._complain(self._low())
        except OSError as error:
            self._broken(file, f"cannot write {file.path}: {error.strerror}")

    def _finish(self) -> None:
        """End the present file well, or leave it to be recovered."""
        file = self._file
        if file is None:
            return
        try:
            file.flush()
            file.note("gigabrain.recorded", self._counts())
            file.finish()
        except OSError as error:
            self._broken(file, f"cannot finish {file.path}: {error.strerror}")
        else:
            self._put_away(file)

    def _put_away(self, file: BagFile) -> None:
        self._done_bytes += file.size
        self._written += file.written
        self._file = None
        file.close()

    def _counts(self) -> dict[str, str]:
        now = self.status()
        counts = {name: getattr(now, name) for name in ("written", "dropped", "missing", "seen")}
        return {name: str(count) for name, count in counts.items()}

    def _broken(self, file: BagFile, text: str) -> None:
        """What has not reached the disk is lost; what has is left as it is."""
        self.intake.lose(file.pending)
        self._put_away(file)
        if not file.written:
            file.path.unlink(missing_ok=True)
            self._count -= 1
        self._complain(text)

    def _low(self) -> str:
        least = f"{self._config.keep_free_mb:g} MB"
        return f"not recording: less than {least} are free on the disk of {self._path}"

    def _complain(self, text: str) -> None:
        self._fault_text = text
        self._retry_s = time.monotonic() + RETRY_S
        self._fault.begin(f"{text}; messages are lost until there is room")

    def _again(self, arrival: Arrival) -> BagFile | None:
        """A new file, with what late joiners ask for at its head; None while the disk is full."""
        if time.monotonic() < self._retry_s:
            return None
        try:
            file = self._file = self._next()
        except ConfigError as error:
            self._complain(str(error))
            return None
        try:
            for kept in self._kept.values():
                if kept is not arrival:
                    file.add(kept._replace(log_ns=arrival.log_ns), again=True)
            low = file.free_bytes() < self._config.keep_free_mb * MB
        except OSError as error:
            self._broken(file, f"cannot write {file.path}: {error.strerror}")
            return None
        if low:
            self._broken(file, self._low())
            return None
        self._fault_text = ""
        self._fault.end(f"recording again, into {file.path}")
        return file
