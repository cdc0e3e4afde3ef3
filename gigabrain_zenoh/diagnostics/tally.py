"""What is heard on each key: how often, how large, how late, and what came last."""

import itertools
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from msgspec import Struct

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.recording.headers import SequenceGaps, header_of

ROOM = 2000  # arrivals that are remembered per key
MOST_KEYS = 1000  # that are listened to; anybody may make up another


class Arrival(Struct, frozen=True):
    """One message."""

    at_ns: int  # monotonic
    size: int  # [bytes]
    delay_ns: int | None  # since it was stamped, by this host's clock; None without a stamp


class Figures(Struct, frozen=True, kw_only=True):
    """A stream over some time. Gaps are between neighbouring arrivals [ms]."""

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
    """What came on one key."""

    def __init__(self) -> None:
        self.arrivals: deque[Arrival] = deque(maxlen=ROOM)
        self.count = 0
        self.encoding = ""
        self.newest = b""

    def hear(self, encoding: str, payload: bytes, stamp_ns: int, at_ns: int, unix_ns: int) -> None:
        """Take one message, stamped by its sender or with 0."""
        delay_ns = unix_ns - stamp_ns if stamp_ns else None
        self.arrivals.append(Arrival(at_ns, len(payload), delay_ns))
        self.count += 1
        self.encoding, self.newest = encoding, payload

    def figures(self, since_ns: int, now_ns: int) -> Figures | None:
        """Of what came after `since_ns`; None where nothing did."""
        newest = itertools.takewhile(lambda a: a.at_ns > since_ns, reversed(self.arrivals))
        some = [a for a in newest if a.at_ns <= now_ns][::-1]
        if not some:
            return None
        times = [a.at_ns for a in some]
        gaps = [(b - a) / 1e6 for a, b in itertools.pairwise(times)]
        delays = [a.delay_ns / 1e6 for a in some if a.delay_ns is not None]
        span_s = (times[-1] - times[0]) / 1e9
        seconds = max((now_ns - since_ns) / 1e9, 1e-9)
        return Figures(
            count=len(some),
            hz=len(gaps) / span_s if span_s else len(some) / seconds,
            bytes_s=sum(a.size for a in some) / seconds,
            size=round(statistics.median(a.size for a in some)),
            gap_min_ms=min(gaps, default=None),
            gap_max_ms=max(gaps, default=None),
            gap_std_ms=statistics.pstdev(gaps) if gaps else None,
            delay_min_ms=min(delays, default=None),
            delay_median_ms=statistics.median(delays) if delays else None,
            delay_max_ms=max(delays, default=None),
        )

    def age_s(self, now_ns: int) -> float | None:
        """Since the newest message [s]; None before the first."""
        return max(0, now_ns - self.arrivals[-1].at_ns) / 1e9 if self.arrivals else None


class Tally:
    """All keys. Filled in Zenoh's own thread, read in the loop's."""

    def __init__(
        self,
        now_ns: Callable[[], int] = time.monotonic_ns,
        unix_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._now_ns, self._unix_ns = now_ns, unix_ns
        self._lock = threading.Lock()
        self._streams: dict[str, Stream] = {}
        self._gaps = SequenceGaps()

    def hear(self, key: str, encoding: str, payload: bytes) -> None:
        """Take one message."""
        header = header_of(payload)
        with self._lock:
            stream = self._streams.get(key)
            if stream is None and len(self._streams) >= MOST_KEYS:
                return
            stream = stream or self._streams.setdefault(key, Stream())
            stream.hear(encoding, payload, header.stamp_ns, self._now_ns(), self._unix_ns())
            self._gaps.see(key, header)

    def streams(self) -> dict[str, Stream]:
        """What came so far, by key."""
        with self._lock:
            return dict(sorted(self._streams.items()))

    def figures(self, since_ns: int) -> dict[str, Figures]:
        """Of all that came after `since_ns`, by key."""
        with self._lock:
            now_ns = self._now_ns()
            found = {key: s.figures(since_ns, now_ns) for key, s in self._streams.items()}
        return {key: figures for key, figures in sorted(found.items()) if figures}

    def missing(self, key: str) -> int:
        """Messages that were sent on `key` and never came."""
        with self._lock:
            return self._gaps.missing[key]


@contextmanager
def tallied(bus: Bus, pattern: str) -> Iterator[Tally]:
    """What is heard on `pattern` while the block runs."""
    tally = Tally()
    close = bus.tap(pattern, tally.hear)
    try:
        yield tally
    finally:
        close()
