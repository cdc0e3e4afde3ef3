"""Statistics of topics: rate, size, delay and lost messages, and latencies along the chain."""

import itertools
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

from msgspec import Struct

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import BODY, CMD_VEL, INTENT, SCAN, STATE, WORLD, Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.headers import SequenceGaps, header_of

M = TypeVar("M", bound=Message)

MAX_ARRIVALS = 2000  # kept per key
MAX_KEYS = 1000  # a client may publish on any number of keys
HOPS: tuple[Topic[Any], ...] = (SCAN, WORLD, INTENT, CMD_VEL)
CHAIN: tuple[Topic[Any], ...] = (*HOPS, STATE, BODY)


class Arrival(Struct, frozen=True):
    """Time and size of one message."""

    at_ns: int  # monotonic
    size: int  # [bytes]
    delay_ns: int | None  # since its stamp, by this host's clock; None without a stamp


class StreamStats(Struct, frozen=True, kw_only=True):
    """Statistics of one key over some time. Gaps are times between consecutive arrivals."""

    count: int
    hz: float
    bytes_s: float
    size: int  # [bytes], median
    gap_min_ms: float | None = None
    gap_max_ms: float | None = None
    gap_std_ms: float | None = None
    delay_min_ms: float | None = None
    delay_median_ms: float | None = None
    delay_max_ms: float | None = None


class Stream:
    """Newest arrivals on one key."""

    def __init__(self) -> None:
        self.arrivals: deque[Arrival] = deque(maxlen=MAX_ARRIVALS)

    def add(self, size: int, stamp_ns: int, at_ns: int, unix_ns: int) -> None:
        """Add a message; `stamp_ns` is 0 for a message without a stamp."""
        delay_ns = unix_ns - stamp_ns if stamp_ns else None
        self.arrivals.append(Arrival(at_ns, size, delay_ns))

    def stats(self, since_ns: int, now_ns: int) -> StreamStats | None:
        """Return statistics of the arrivals after `since_ns`; None without any."""
        newest = itertools.takewhile(lambda a: a.at_ns > since_ns, reversed(self.arrivals))
        arrivals = [a for a in newest if a.at_ns <= now_ns][::-1]
        if not arrivals:
            return None
        times = [a.at_ns for a in arrivals]
        gaps = [(b - a) / 1e6 for a, b in itertools.pairwise(times)]
        delays = [a.delay_ns / 1e6 for a in arrivals if a.delay_ns is not None]
        span_s = (times[-1] - times[0]) / 1e9
        seconds = max((now_ns - since_ns) / 1e9, 1e-9)
        return StreamStats(
            count=len(arrivals),
            hz=len(gaps) / span_s if span_s else len(arrivals) / seconds,
            bytes_s=sum(a.size for a in arrivals) / seconds,
            size=round(statistics.median(a.size for a in arrivals)),
            gap_min_ms=min(gaps, default=None),
            gap_max_ms=max(gaps, default=None),
            gap_std_ms=statistics.pstdev(gaps) if gaps else None,
            delay_min_ms=min(delays, default=None),
            delay_median_ms=statistics.median(delays) if delays else None,
            delay_max_ms=max(delays, default=None),
        )

    def age_s(self, now_ns: int) -> float | None:
        """Return the time since the newest message [s]; None before the first."""
        return max(0, now_ns - self.arrivals[-1].at_ns) / 1e9 if self.arrivals else None


class TopicMonitor:
    """Streams by key. Zenoh's thread adds to them, the event loop's thread reads them."""

    def __init__(
        self,
        now_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._now_ns, self._unix_ns = now_ns, unix_ns
        self._lock = threading.Lock()
        self._streams: dict[str, Stream] = {}
        self._gaps = SequenceGaps()

    def add(self, key: str, _encoding: str, payload: bytes) -> None:
        """Count one message."""
        header = header_of(payload)
        with self._lock:
            stream = self._streams.get(key)
            if stream is None and len(self._streams) >= MAX_KEYS:
                return
            stream = stream or self._streams.setdefault(key, Stream())
            stream.add(len(payload), header.stamp_ns, self._now_ns(), self._unix_ns())
            self._gaps.count(key, header)

    def streams(self) -> dict[str, Stream]:
        """Return all streams, by key."""
        with self._lock:
            return dict(sorted(self._streams.items()))

    def stats(self, since_ns: int) -> dict[str, StreamStats]:
        """Return statistics of the arrivals after `since_ns`, by key."""
        with self._lock:
            now_ns = self._now_ns()
            found = {key: s.stats(since_ns, now_ns) for key, s in self._streams.items()}
        return {key: stats for key, stats in sorted(found.items()) if stats}

    def missing(self, key: str) -> int:
        """Return the number of messages that were sent on `key` but did not arrive."""
        with self._lock:
            return self._gaps.missing[key]


@contextmanager
def monitored(bus: Bus, pattern: str) -> Iterator[TopicMonitor]:
    """Count the messages on `pattern` while the block runs."""
    monitor = TopicMonitor()
    close = bus.tap(pattern, monitor.add)
    try:
        yield monitor
    finally:
        close()


class ChainMonitor:
    """Newest message per topic of the chain, and the stamp of the first one for each basis."""

    def __init__(self) -> None:
        self._newest: dict[str, Message] = {}
        self._sent_ns: dict[str, dict[int, int]] = {topic.key: {} for topic in HOPS}

    def add(self, key: str, message: Message) -> None:
        """Add a message. All processes of the chain must use the clock of one host."""
        self._newest[key] = message
        if key in self._sent_ns:
            self._sent_ns[key].setdefault(message.basis, message.stamp_ns)

    @property
    def complete(self) -> bool:
        """Return whether each topic has a message, and one scan has passed all hops."""
        passed_all = set.intersection(*(set(sent) for sent in self._sent_ns.values()))
        return bool(passed_all) and all(topic.key in self._newest for topic in CHAIN)

    def get(self, topic: Topic[M]) -> M:
        """Return the newest message on `topic`."""
        message = self._newest[topic.key]
        assert isinstance(message, topic.type)
        return message

    def sizes(self) -> list[int]:
        """Return the size of the newest message of each hop [bytes]."""
        return [len(codec.encode(self.get(topic))) for topic in HOPS]

    def between(self, before: Topic[Any], after: Topic[Any]) -> float:
        """Return the median time from one hop to another [ms]; only once `complete`."""
        return median_ms(self._sent_ns[before.key], self._sent_ns[after.key])


def median_ms(before: Mapping[int, int], after: Mapping[int, int]) -> float:
    """Return the median difference of two times per tick [ns], over common ticks [ms]."""
    both = before.keys() & after.keys()
    return statistics.median((after[tick] - before[tick]) / 1e6 for tick in both)


def monitor_chain(bus: Bus) -> ChainMonitor:
    """Subscribe a new ChainMonitor to all topics of the chain."""
    monitor = ChainMonitor()
    for topic in CHAIN:
        bus.subscribe(topic, monitor.add)
    return monitor
