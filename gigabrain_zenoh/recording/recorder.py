"""Writes received messages to the disk in a thread of its own, and survives faults of the disk."""

import itertools
import logging
import os
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct

from gigabrain_schemas.base import TICK_S
from gigabrain_zenoh.bus.headers import Header, SequenceGaps, header_of
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.bus.zenoh.workarounds import LONGEST_S
from gigabrain_zenoh.config.settings import RecorderConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.host.files import file_problem
from gigabrain_zenoh.logs import Fault
from gigabrain_zenoh.recording.bag_reader import PICTURE_KEYS, PICTURES_NOTE
from gigabrain_zenoh.recording.bag_writer import BagWriter, ReceivedMessage

log = logging.getLogger(__name__)

MB = 1_000_000
WRITE_INTERVAL_S = 0.3  # maximum; shorter intervals take more CPU time, due to cold caches
RETRY_S = 1.0  # between two attempts to write to a full disk
MAX_CHANNELS = 1000  # pairs of key and encoding; a client may invent any number
MAX_INDEX_ENTRIES = 1_000_000  # of one file: 80 MB of memory, and 13 MB in the file
OTHER_KEYS = "others"  # name of the count of messages beyond MAX_CHANNELS
MAX_BATCH_NS = round(LONGEST_S * 1e9)  # newer stamps count as the time of reception


def unused_path(path: Path, number: int = 0) -> Path:
    """Return the first of `path`, NAME_1, NAME_2, … from `number` on that does not exist."""
    numbered = (
        path.with_name(f"{path.stem}_{n}{path.suffix}") if n else path
        for n in itertools.count(number)
    )
    return next(name for name in numbered if not os.path.lexists(name))


class _Exposure(NamedTuple):
    """The newest chosen exposure of a camera."""

    boot: int
    at: float  # [ticks]
    due: float  # [ticks], earliest next exposure
    topics: tuple[str, ...]  # recorded of this exposure: picture, depth


class PictureThinning:
    """Chooses exposures of each camera at a rate, by the robot's time; both picture and depth.

    A rate of 0 chooses none.
    """

    def __init__(self, hz: float) -> None:
        self._period = 1.0 / hz / TICK_S if hz else 0.0  # [ticks]
        self._chosen: dict[str, _Exposure] = {}  # by camera

    def is_left_out(self, key: str, header: Header, now_ns: int) -> bool:
        """Return whether to leave out a picture or depth message."""
        if not self._period:
            return True
        topic, _, camera = key.rpartition("/")
        at = header.basis or (header.stamp_ns or now_ns) / 1e9 / TICK_S
        before = self._chosen.get(camera)
        if before is None or before.boot != header.boot or at < before.at:
            chosen = _Exposure(header.boot, at, at + self._period, (topic,))
        elif at == before.at and topic not in before.topics:
            chosen = before._replace(topics=(*before.topics, topic))
        elif at >= before.due:
            due = max(before.due, at - self._period) + self._period
            chosen = _Exposure(header.boot, at, due, (topic,))
        else:
            return True
        put_newest(self._chosen, camera, chosen, MAX_CHANNELS)
        return False


class Intake:
    """Bounded queue from any thread to the writer. It never delays the bus.

    Messages beyond its size or beyond MAX_CHANNELS are dropped and counted. It calls `hurry` when a
    quarter of it is full.
    """

    def __init__(
        self,
        max_bytes: int,
        unix_ns: Callable[[], int],
        hurry: Callable[[], object] = int,
        pictures: PictureThinning | None = None,
    ) -> None:
        self._max_bytes, self._unix_ns, self._hurry = max_bytes, unix_ns, hurry
        self._lock, self._pictures = threading.Lock(), pictures
        self._waiting: list[tuple[int, str, str, bytes]] = []
        self._parsed: list[ReceivedMessage] = []  # the oldest, with their headers
        self._held_bytes = 0  # waiting, or being written
        self._newest_ns = 0
        self._channels: set[tuple[str, str]] = set()  # keys and encodings
        self.gaps = SequenceGaps()
        self.seen: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.left_out: Counter[str] = Counter()  # pictures beyond the wanted rate
        self.bytes: Counter[str] = Counter()  # received, without those left out

    def receive(self, key: str, encoding: str, payload: bytes) -> None:
        """Queue one message, or drop it. May be called from any thread."""
        now_ns, size = self._unix_ns(), len(payload)
        with self._lock:
            if not self._is_known(key, encoding):
                self.seen[OTHER_KEYS] += 1
                self.dropped[OTHER_KEYS] += 1
                return
            if self._pictures and self._is_left_out(self._pictures, key, payload, now_ns):
                return
            self.seen[key] += 1
            self.bytes[key] += size
            if self._held_bytes + size > self._max_bytes:
                self._parse()  # earlier messages are counted before this one
                self.gaps.count(key, header_of(payload))
                self.dropped[key] += 1
                return
            before, self._held_bytes = self._held_bytes, self._held_bytes + size
            self._waiting.append((now_ns, key, encoding, payload))
        if before < self._max_bytes // 4 <= before + size:
            self._hurry()

    def _is_left_out(
        self, pictures: PictureThinning, key: str, payload: bytes, now_ns: int
    ) -> bool:
        if not key.startswith(PICTURE_KEYS):
            return False
        header = header_of(payload)
        if not pictures.is_left_out(key, header, now_ns):
            return False
        self._parse()  # earlier messages are counted before this one
        self.gaps.count(key, header)
        self.left_out[key] += 1
        return True

    def _is_known(self, key: str, encoding: str) -> bool:
        """Return whether a key and encoding are among the first MAX_CHANNELS."""
        channel = key, encoding
        if channel not in self._channels and len(self._channels) < MAX_CHANNELS:
            self._channels.add(channel)
        return channel in self._channels

    def take_batch(self) -> list[ReceivedMessage]:
        """Return all queued messages, oldest first; they count as held until `release`."""
        with self._lock:
            self._parse()
            batch, self._parsed = self._parsed, []
        return batch

    def release(self, batch: list[ReceivedMessage]) -> None:
        """Release the space of a written batch."""
        with self._lock:
            self._held_bytes -= sum(len(message.payload) for message in batch)

    def add_lost(self, lost: Counter[str]) -> None:
        """Count messages that could not be written to the disk as dropped."""
        with self._lock:
            self.dropped += lost

    def counts(self) -> tuple[int, int, int]:
        """Return the number of messages seen, dropped, and never received."""
        with self._lock:
            return self.seen.total(), self.dropped.total(), self.gaps.missing.total()

    def _parse(self) -> None:
        """Read the headers of waiting messages; together this takes less time than one by one."""
        newest_ns, parsed, count = self._newest_ns, self._parsed, self.gaps.count
        for taken_ns, key, encoding, payload in self._waiting:
            header = header_of(payload)
            count(key, header)
            recent = 0 < taken_ns - header.stamp_ns < MAX_BATCH_NS
            received_ns = header.stamp_ns if recent else taken_ns
            newest_ns = received_ns if received_ns > newest_ns else newest_ns + 1
            parsed.append(ReceivedMessage(newest_ns, key, encoding, payload, header))
        self._newest_ns = newest_ns
        self._waiting.clear()


class Status(Struct, frozen=True, kw_only=True):
    """Progress of a recording."""

    path: Path
    seconds: float  # since its start
    size: int  # [bytes] on the disk, of all its files
    files: int
    seen: int  # messages received
    written: int  # of these, on the disk
    dropped: int  # of these, lost because the disk was too slow or full
    missing: int  # messages never received, by their senders' count
    fault: str  # current fault of the disk, or an empty text


class Recorder:
    """One recording, in one or several consecutive files. Used as a context manager."""

    def __init__(
        self,
        path: Path,
        config: RecorderConfig,
        open_file: Callable[[Path], BagWriter] | None = None,
    ) -> None:
        self._path, self._config = path, config
        self._open = open_file or self._default_open
        start_unix_ns, start_ns = time.time_ns(), time.monotonic_ns()
        self._wake, self._ended = threading.Event(), False
        self.intake = Intake(
            round(config.queue_mb * MB),
            lambda: start_unix_ns + time.monotonic_ns() - start_ns,
            self._wake.set,
            None if config.pictures is None else PictureThinning(config.pictures),
        )
        self._start_s = time.monotonic()
        self._files = self._closed_bytes = self._written = 0
        self._file: BagWriter | None = None
        self._kept: dict[str, ReceivedMessage] = {}  # newest of topics kept for late subscribers
        self._flushed_s, self._retry_s = time.monotonic(), 0.0
        self._fault_text, self._fault = "", Fault(log, logging.ERROR)
        self._pool = ThreadPoolExecutor(1, "recorder")
        self.done: Future[None] | None = None  # ends early only after a programming error

    def begin(self) -> None:
        """Create the file now, so that an error is raised at once.

        Without this call the file is created at the first message, with retries every second.
        Raises ConfigError.
        """
        self._file = self._open_file(self._path)

    def __enter__(self) -> "Recorder":
        self.done = self._pool.submit(self._run)
        return self

    def __exit__(self, *_: object) -> None:
        """Write remaining messages and finish the file."""
        self._ended = True
        self._wake.set()
        self._pool.shutdown()

    def status(self) -> Status:
        """Return the current progress."""
        seen, dropped, missing = self.intake.counts()
        file = self._file
        return Status(
            path=file.path if file else self._path,
            seconds=time.monotonic() - self._start_s,
            size=self._closed_bytes + (file.size if file else 0),
            files=self._files,
            seen=seen,
            written=self._written + (file.written if file else 0),
            dropped=dropped,
            missing=missing,
            fault=self._fault_text,
        )

    def _default_open(self, path: Path) -> BagWriter:
        notes, pictures = dict(self._config.notes), self._config.pictures
        if pictures is not None:
            notes[PICTURES_NOTE] = f"{pictures:g} Hz"
        return BagWriter(path, viewers=self._config.viewers, notes=notes)

    def _open_file(self, path: Path) -> BagWriter:
        """Create the next file. Raises ConfigError."""
        file = self._open(path)
        self._files += 1
        return file

    def _run(self) -> None:
        while not self._ended:
            self._wake.wait(WRITE_INTERVAL_S)
            self._wake.clear()
            self._write_batch()
        self._write_batch()
        self._finish()

    def _write_batch(self) -> None:
        batch = self.intake.take_batch()
        for message in batch:
            self._write(message)
        self.intake.release(batch)
        if time.monotonic() - self._flushed_s >= self._config.flush_s:
            self._flush()

    def _write(self, message: ReceivedMessage) -> None:
        topic = topic_of(message.key)
        if topic and topic.keep:
            self._kept[message.key] = message
        file = self._file or self._reopen(message)
        if file is None:
            self.intake.add_lost(Counter((message.key,)))
            return
        try:
            file.add(message)
        except OSError as error:
            self._abandon(file, f"cannot write {file.path}: {file_problem(error)}")
            return
        if self._is_full(file, message):
            self._finish()

    def _is_full(self, file: BagWriter, message: ReceivedMessage) -> bool:
        split_mb, split_s = self._config.split_mb, self._config.split_s
        new_bytes = file.size - file.repeated_bytes  # repeated maps may exceed a small `split_mb`
        return (
            file.index_entries >= MAX_INDEX_ENTRIES
            or (split_mb is not None and new_bytes >= split_mb * MB)
            or (split_s is not None and message.log_ns - file.first_ns >= split_s * 1_000_000_000)
        )

    def _flush(self) -> None:
        self._flushed_s = time.monotonic()
        file = self._file
        if file is None:
            return
        try:
            file.flush()
            if file.is_deleted():
                log.warning("%s was deleted; recording continues in another file", file.path)
                self._finish()
            elif self._disk_is_low(file):
                self._finish()
                self._report(self._low_text())
        except OSError as error:
            self._abandon(file, f"cannot write {file.path}: {file_problem(error)}")

    def _finish(self) -> None:
        """Finish the current file with its index; if that fails, recovery can repair it later."""
        file = self._file
        if file is None:
            return
        try:
            file.flush()
            now = self.status()
            names = ("written", "dropped", "missing", "seen")
            file.add_notes("gigabrain.recorded", {name: str(getattr(now, name)) for name in names})
            file.finish()
        except OSError as error:
            self._abandon(file, f"cannot finish {file.path}: {file_problem(error)}")
        else:
            self._close(file)

    def _close(self, file: BagWriter) -> None:
        self._closed_bytes += file.size
        self._written += file.written
        self._file = None
        file.close()

    def _abandon(self, file: BagWriter, text: str) -> None:
        """Count messages that are not on the disk as lost; keep the file with the others."""
        self.intake.add_lost(file.pending)
        self._close(file)
        if not file.written:
            file.path.unlink(missing_ok=True)
            self._files -= 1
        self._report(text)

    def _disk_is_low(self, file: BagWriter) -> bool:
        return file.free_bytes() < self._config.keep_free_mb * MB

    def _low_text(self) -> str:
        limit = f"{self._config.keep_free_mb:g} MB"
        return f"not recording: less than {limit} are free on the disk of {self._path}"

    def _report(self, text: str) -> None:
        self._fault_text = text
        self._retry_s = time.monotonic() + RETRY_S
        self._fault.begin(f"{text}; messages are lost until there is space")

    def _reopen(self, message: ReceivedMessage) -> BagWriter | None:
        """Start a new file with the newest kept messages; return None while the disk is full."""
        if time.monotonic() < self._retry_s:
            return None
        try:
            file = self._file = self._open_file(unused_path(self._path, self._files))
        except ConfigError as error:
            self._report(str(error))
            return None
        try:
            earlier = (kept for kept in self._kept.values() if kept is not message)
            file.repeat(earlier, message.log_ns)
            low = self._disk_is_low(file)
        except OSError as error:
            self._abandon(file, f"cannot write {file.path}: {file_problem(error)}")
            return None
        if low:
            self._abandon(file, self._low_text())
            return None
        self._fault_text = ""
        self._fault.end(f"recording again, into {file.path}")
        return file
