"""The inputs that a node consumed and the requests that it accepted, in order, for replay.

A busy process skips messages, and work in other threads is done in time or not. A replay needs to
know both.
"""

from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.input_log import (
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
ROOM = MAX_ENTRIES // 2  # entries that may wait; one more may be added while they are said
MOST_KEYS = 512  # of which the newest number is known
HIGHEST = 2**63 - 1


class InputLogger:
    """Kept by nobody."""

    live = True  # whether what the node does has effects beside the bus

    def note(self, key: str, seq: int) -> None:
        """A message is looked at."""

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Whether work beside is done after that long at most. What follows may rest on it."""
        return done(job, patience_s)

    def flush(self) -> None:
        """Say what has not been said yet."""


class PublishedInputLogger(InputLogger):
    """Said on the bus twice a second, as long as there is anything to say."""

    def __init__(self, say: Callable[[InputLog], object], unix_ns: Callable[[], int]) -> None:
        self._say, self._unix_ns = say, unix_ns
        self._keys: dict[str, int] = {}
        self._taken: list[ConsumedInput] = []
        self._last: dict[str, int] = {}  # seq by key
        self._began_ns = 0

    def note(self, key: str, seq: int) -> None:
        """A message is looked at; by several parts of a node in turn, it is one."""
        if seq and self._last.get(key) == seq:
            return
        put_newest(self._last, key, seq, MOST_KEYS)
        self._add(key, seq)

    def in_time(self, job: Job, patience_s: float) -> bool:
        """As it was, which is written down."""
        there = done(job, patience_s)
        self._add(WAITED, int(there))
        return there

    def flush(self) -> None:
        """Say what has not been said yet."""
        taken, keys = self._taken, tuple(self._keys)
        if taken:
            self._taken, self._keys = [], {}
            self._say(InputLog(began_ns=self._began_ns, keys=keys, taken=tuple(taken)))

    def _add(self, key: str, seq: int) -> None:
        now_ns = self._unix_ns()
        after_ns = now_ns - self._began_ns
        if self._taken and (not 0 <= after_ns < EVERY_NS or len(self._taken) >= ROOM):
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

    def in_time(self, job: Job, patience_s: float) -> bool:
        """As it was then; of work that nobody waited for then, once it is done."""
        there = self.outcomes.popleft() if self.outcomes else True
        return there and done(job, None)


def log_accepted(bus: "Bus", key: str, request: Message, basis: int) -> None:
    """Tell that from now on a request counts which was asked on `key`.

    `basis` is the tick of the newest world that was thought about.
    """
    text = msgspec.json.encode(request).decode()
    accepted = AcceptedRequest(process=bus.process, service=key, request=text)
    sent = bus.publish(REQUEST_LOG, accepted, basis=basis)
    bus.input_log.note(REQUEST_LOG.key, sent.seq)
