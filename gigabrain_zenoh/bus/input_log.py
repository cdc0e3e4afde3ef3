"""The inputs that a node consumed and the requests that it accepted, in order, for replay.

A busy process skips messages, and background work may finish too late. A replay repeats both.
"""

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.logs import (
    FINISHED,
    MAX_ENTRIES,
    WAITED,
    AcceptedRequest,
    ConsumedInput,
    InputLog,
)
from gigabrain_schemas.topics import REQUEST_LOG
from gigabrain_zenoh.host.bounded import put_newest
from gigabrain_zenoh.host.threads import Job, done

if TYPE_CHECKING:
    from gigabrain_zenoh.bus.bus import Bus

PUBLISH_PERIOD_NS = 500_000_000
MAX_WAITING = MAX_ENTRIES // 2  # entries; publishing may add more
MAX_KEYS = 512  # whose newest seq is remembered
MAX_SEQ = 2**63 - 1


class InputLogger:
    """An input log that records nothing."""

    live = True  # False in a replay: the node may have no effects outside the bus

    def note(self, key: str, seq: int) -> None:
        """Record that a message is used."""

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Wait for background work; return whether it is done within `patience_s`."""
        return done(job, patience_s)

    def when_done(self, job: Job, then: Callable[[Job], None]) -> None:
        """Call `then(job)` on the event loop once background work is done."""
        loop = asyncio.get_running_loop()

        def finish() -> None:
            self._note_finished()
            then(job)

        def wake(_job: Job) -> None:
            with contextlib.suppress(RuntimeError):  # the loop is closed
                loop.call_soon_threadsafe(finish)

        job.add_done_callback(wake)

    def flush(self) -> None:
        """Publish all entries that are not published yet."""

    def _note_finished(self) -> None:
        """Record that the result of background work is used from now on."""


class PublishedInputLogger(InputLogger):
    """Publishes the input log twice a second, unless it is empty."""

    def __init__(self, publish: Callable[[InputLog], object], unix_ns: Callable[[], int]) -> None:
        self._publish, self._unix_ns = publish, unix_ns
        self._keys: dict[str, int] = {}
        self._entries: list[ConsumedInput] = []
        self._last: dict[str, int] = {}  # seq by key
        self._began_ns = 0

    def note(self, key: str, seq: int) -> None:
        """Record that a message is used; several uses in a row count as one."""
        if seq and self._last.get(key) == seq:
            return
        put_newest(self._last, key, seq, MAX_KEYS)
        self._add(key, seq)

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Wait for background work, and record whether it was done in time."""
        finished = done(job, patience_s)
        self._add(WAITED, int(finished))
        return finished

    def flush(self) -> None:
        """Publish all entries that are not published yet."""
        entries, keys = self._entries, tuple(self._keys)
        if entries:
            self._entries, self._keys = [], {}
            self._publish(InputLog(began_ns=self._began_ns, keys=keys, taken=tuple(entries)))

    def _note_finished(self) -> None:
        self._add(FINISHED, 1)

    def _add(self, key: str, seq: int) -> None:
        now_ns = self._unix_ns()
        after_ns = now_ns - self._began_ns
        due = not 0 <= after_ns < PUBLISH_PERIOD_NS or len(self._entries) >= MAX_WAITING
        if self._entries and due:
            self.flush()
        if not self._entries:
            self._began_ns, after_ns = now_ns, 0
        index = self._keys.setdefault(key, len(self._keys))
        self._entries.append(ConsumedInput(index, min(seq, MAX_SEQ), after_ns // 1000))


class ReplayedInputLogger(InputLogger):
    """Repeats recorded outcomes: waits for work that was done in time, and for no other."""

    live = False

    def __init__(self) -> None:
        self.outcomes: deque[bool] = deque()  # of `in_time`, as recorded for the present message
        self._unfinished: deque[tuple[Job, Callable[[Job], None]]] = deque()

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Return the recorded outcome; wait for work without one."""
        finished = self.outcomes.popleft() if self.outcomes else True
        return finished and done(job, None)

    def when_done(self, job: Job, then: Callable[[Job], None]) -> None:
        """Queue `then(job)` for `finish`."""
        self._unfinished.append((job, then))

    def finish(self) -> None:
        """Wait for the oldest queued work, and call its `then`."""
        if self._unfinished:
            job, then = self._unfinished.popleft()
            done(job, None)
            then(job)


def log_accepted(bus: "Bus", key: str, request: Message, basis: int) -> None:
    """Publish an accepted request on `key`, for replay.

    `basis` is the tick of the newest world that was used.
    """
    text = msgspec.json.encode(request).decode()
    accepted = AcceptedRequest(process=bus.process, service=key, request=text)
    sent = bus.publish(REQUEST_LOG, accepted, basis=basis)
    bus.input_log.note(REQUEST_LOG.key, sent.seq)
