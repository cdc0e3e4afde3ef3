"""The inputs that a node consumed and the requests that it accepted, in order, for replay.

A busy process skips messages, and work in other threads is done in time or not. A replay needs to
know both.
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

EVERY_NS = 500_000_000  # from one word about it to the next
MAX_WAITING = MAX_ENTRIES // 2  # entries; more may be added while they are published
MAX_KEYS = 512  # of which the newest number is known
HIGHEST = 2**63 - 1


class InputLogger:
    """An input log that keeps nothing."""

    live = True  # whether what the node does has effects beside the bus

    def note(self, key: str, seq: int) -> None:
        """Record that a message is used."""

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Return whether background work is done within that time; the node may use its result."""
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
        """Record that background work counts from now on."""


class PublishedInputLogger(InputLogger):
    """Publishes the input log twice a second, if it holds anything."""

    def __init__(self, publish: Callable[[InputLog], object], unix_ns: Callable[[], int]) -> None:
        self._publish, self._unix_ns = publish, unix_ns
        self._keys: dict[str, int] = {}
        self._taken: list[ConsumedInput] = []
        self._last: dict[str, int] = {}  # seq by key
        self._began_ns = 0

    def note(self, key: str, seq: int) -> None:
        """Record that a message is used; several uses in a row count as one."""
        if seq and self._last.get(key) == seq:
            return
        put_newest(self._last, key, seq, MAX_KEYS)
        self._add(key, seq)

    def in_time(self, job: Job, patience_s: float) -> bool:
        """As it was, which is written down."""
        there = done(job, patience_s)
        self._add(WAITED, int(there))
        return there

    def flush(self) -> None:
        """Publish all entries that are not published yet."""
        taken, keys = self._taken, tuple(self._keys)
        if taken:
            self._taken, self._keys = [], {}
            self._publish(InputLog(began_ns=self._began_ns, keys=keys, taken=tuple(taken)))

    def _note_finished(self) -> None:
        self._add(FINISHED, 1)

    def _add(self, key: str, seq: int) -> None:
        now_ns = self._unix_ns()
        after_ns = now_ns - self._began_ns
        if self._taken and (not 0 <= after_ns < EVERY_NS or len(self._taken) >= MAX_WAITING):
            self.flush()
        if not self._taken:
            self._began_ns, after_ns = now_ns, 0
        index = self._keys.setdefault(key, len(self._keys))
        self._taken.append(ConsumedInput(index, min(seq, HIGHEST), after_ns // 1000))


class ReplayedInputLogger(InputLogger):
    """As it was: what was done in time then is waited for now, all else counts as undone."""

    live = False

    def __init__(self) -> None:
        self.outcomes: deque[bool] = deque()  # of what is waited for at the present message
        self._unfinished: deque[tuple[Job, Callable[[Job], None]]] = deque()

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Return the recorded outcome; wait for work without one."""
        there = self.outcomes.popleft() if self.outcomes else True
        return there and done(job, None)

    def when_done(self, job: Job, then: Callable[[Job], None]) -> None:
        """Keep it until `finish`."""
        self._unfinished.append((job, then))

    def finish(self) -> None:
        """Wait for the oldest work that is not finished, which counts from now on."""
        if self._unfinished:
            job, then = self._unfinished.popleft()
            done(job, None)
            then(job)


def log_accepted(bus: "Bus", key: str, request: Message, basis: int) -> None:
    """Publish that a request on `key` counts from now on.

    `basis` is the tick of the newest world used.
    """
    text = msgspec.json.encode(request).decode()
    accepted = AcceptedRequest(process=bus.process, service=key, request=text)
    sent = bus.publish(REQUEST_LOG, accepted, basis=basis)
    bus.input_log.note(REQUEST_LOG.key, sent.seq)
