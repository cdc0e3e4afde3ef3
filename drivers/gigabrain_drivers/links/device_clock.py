"""Delay of a device's data, from the stamps of its own clock or from its echoes. Pure.

The fastest data so far give the offset of the two clocks; slower data are late. A delay that is
present from the first byte on cannot be detected. A delay that grows by less than MAX_DRIFT looks
the same as clock drift.
"""

from collections import deque

MAX_UNANSWERED = 64  # messages that wait for their echo
WINDOW_NS = 300_000_000  # the delay is the least one of this window,
MIN_WINDOW_SHARE = 0.8  # after at least this share of it
SILENCE_MS = 500.0  # after this silence, the device may have restarted;
RESTART_MS = 1000.0  # it did if its data would otherwise be later by more than this
LATE_MS = 50.0  # data with a longer delay are not used to measure drift
MAX_DRIFT = 0.01  # between two clocks; an RC oscillator is no better
EARLY_MS = 100.0  # data may arrive this much too early, after a delay of the host
MAX_INVALID = 3  # after this many impossible stamps in a row, the clock counts as new
SAMPLE_NS, SAMPLES = 1_000_000_000, 120  # of the drift, while nothing is late
MIN_DRIFT_SAMPLES = 10


class Window:
    """The minimum of the values of the last 0.3 s."""

    def __init__(self) -> None:
        self._seen = deque[tuple[int, float]]()  # time [ns] and value, of possible minima
        self._began_ns = 0
        self.newest = 0.0

    def add(self, value: float, now_ns: int) -> None:
        """Add a value."""
        if not self._seen or now_ns - self._seen[-1][0] > WINDOW_NS:
            self._began_ns = now_ns
        while self._seen and self._seen[-1][1] >= value:
            self._seen.pop()
        self._seen.append((now_ns, value))
        self.newest = value
        while now_ns - self._seen[0][0] > WINDOW_NS:
            self._seen.popleft()

    @property
    def least(self) -> float:
        """The minimum of the window, at least 0; 0 until the window is full."""
        if not self._seen or self._seen[-1][0] - self._began_ns < MIN_WINDOW_SHARE * WINDOW_NS:
            return 0.0
        return max(0.0, self._seen[0][1])


class EchoClock:
    """Delay of a device that echoes the number of the newest message to it.

    The delay is the round trip minus `usual_ms`; it includes delays that exist from the start.
    """

    def __init__(self, usual_ms: float) -> None:
        self._usual_ms = usual_ms
        self._sent = deque[tuple[int, int]](maxlen=MAX_UNANSWERED)  # number, and time [ns]
        self._late = Window()

    @property
    def late_ms(self) -> float:
        """The least delay of all echoes of the last 0.3 s, beyond the usual one [ms]."""
        return self._late.least

    def sent(self, number: int, now_ns: int) -> None:
        """Record a sent message."""
        self._sent.append((number, now_ns))

    def echoed(self, number: int, now_ns: int) -> None:
        """Record data that echo a message; only its first echo counts."""
        numbers = [waiting for waiting, _ in self._sent]
        if number not in numbers:
            return
        for _ in range(numbers.index(number) + 1):
            _, sent_ns = self._sent.popleft()
        self._late.add((now_ns - sent_ns) / 1e6 - self._usual_ms, now_ns)


class DeviceClock:
    """Delay from the stamps of a device's clock, which wraps at `wrap_ms`.

    The fastest data of 0.3 s count, so jitter does not. While data are late, the clocks are assumed
    to drift as before.
    """

    def __init__(self, wrap_ms: int) -> None:
        self._wrap_ms = wrap_ms
        self.clear()

    def clear(self) -> None:
        """Start again, for another device, or for one that restarted."""
        self._last: tuple[int, int] | None = None  # newest stamp [ms], and its arrival [ns]
        self._device_ms = self._floor_ms = 0.0  # unwrapped stamp; least offset of the clocks
        self._odd = 0
        self._excess = Window()  # delay of data [ms]
        self._floors = deque[tuple[int, float]](maxlen=SAMPLES)

    @property
    def late_ms(self) -> float:
        """The least delay of the data of the last 0.3 s, relative to the fastest data ever [ms]."""
        return self._excess.least

    def arrived(self, stamp_ms: int, now_ns: int) -> None:
        """Record data with this stamp."""
        if self._last is None:
            self._begin(stamp_ms, now_ns)
            return
        before_ms, then_ns = self._last
        passed_ms, silent_ms = (stamp_ms - before_ms) % self._wrap_ms, (now_ns - then_ns) / 1e6
        went_back = stamp_ms < before_ms or silent_ms - passed_ms > RESTART_MS
        if silent_ms > SILENCE_MS and (went_back or 2 * silent_ms > self._wrap_ms):
            self._begin(stamp_ms, now_ns)
        elif passed_ms > silent_ms + self._excess.newest + EARLY_MS:
            self._odd += 1
            if self._odd >= MAX_INVALID:
                self._begin(stamp_ms, now_ns)
        else:
            self._odd, self._last = 0, (stamp_ms, now_ns)
            self._device_ms += passed_ms
            self._judge(now_ns, silent_ms)

    def _begin(self, stamp_ms: int, now_ns: int) -> None:
        self.clear()
        self._last, self._floor_ms = (stamp_ms, now_ns), now_ns / 1e6

    def _judge(self, now_ns: int, elapsed_ms: float) -> None:
        late = self.late_ms >= LATE_MS
        self._floor_ms += elapsed_ms * (self._drift() if late else MAX_DRIFT)
        offset_ms = now_ns / 1e6 - self._device_ms
        self._floor_ms = min(self._floor_ms, offset_ms)
        self._excess.add(offset_ms - self._floor_ms, now_ns)
        if not late and (not self._floors or now_ns - self._floors[-1][0] >= SAMPLE_NS):
            self._floors.append((now_ns, self._floor_ms))

    def _drift(self) -> float:
        """The drift of the device's clock against the host's; 0 until it is known."""
        if len(self._floors) < MIN_DRIFT_SAMPLES:
            return 0.0
        (then_ns, then_ms), (now_ns, now_ms) = self._floors[0], self._floors[-1]
        return (now_ms - then_ms) / ((now_ns - then_ns) / 1e6)
