"""Lateness of a device's data, by the stamps of its own clock or by what it echoes. Pure.

Where the two clocks began does not matter: the quickest data so far show their offset, and what
comes later than that is late. Lateness that was there from the first byte on cannot be seen; what
grows by less than MAX_DRIFT cannot be told from two clocks that differ.
"""

from collections import deque

MAX_UNANSWERED = 64  # messages whose echo is waited for
WINDOW_NS = 300_000_000  # data are late by what all of this window are,
MIN_WINDOW_SHARE = 0.8  # once this share of it has been seen
SILENCE_MS = 500.0  # without data, after which the device may have restarted,
RESTART_MS = 1000.0  # and was, if they would else be later by more than this
LATE_MS = 50.0  # from which on data are late, and show nothing of the clocks' drift
MAX_DRIFT = 0.01  # of two clocks against each other; an RC oscillator is no better
EARLY_MS = 100.0  # by which data may come too early, after a host that was held up
MAX_ODD = 3  # stamps in a row that cannot be, until the clock counts as a new one
SAMPLE_NS, SAMPLES = 1_000_000_000, 120  # of the drift, while nothing is late
MIN_DRIFT_SAMPLES = 10


class Window:
    """Keeps the values of the last 0.3 s, to give the least of them."""

    def __init__(self) -> None:
        self._seen = deque[tuple[int, float]]()  # when [ns], and what may still be the least
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
        """The least of the window, and no less than 0; 0 until the window is full."""
        if not self._seen or self._seen[-1][0] - self._began_ns < MIN_WINDOW_SHARE * WINDOW_NS:
            return 0.0
        return max(0.0, self._seen[0][1])


class EchoClock:
    """Lateness of a device that echoes the number of the newest message to it.

    The round trip beyond `usual_ms` counts, including what was late from the start.
    """

    def __init__(self, usual_ms: float) -> None:
        self._usual_ms = usual_ms
        self._sent = deque[tuple[int, int]](maxlen=MAX_UNANSWERED)  # number, and when [ns]
        self._late = Window()

    @property
    def late_ms(self) -> float:
        """The delay beyond the usual that all echoes of the last 0.3 s had [ms]."""
        return self._late.least

    def sent(self, number: int, now_ns: int) -> None:
        """Note that a message was sent."""
        self._sent.append((number, now_ns))

    def echoed(self, number: int, now_ns: int) -> None:
        """Note data that echo this message; only the first echo of each is timed."""
        numbers = [waiting for waiting, _ in self._sent]
        if number not in numbers:
            return
        for _ in range(numbers.index(number) + 1):
            _, sent_ns = self._sent.popleft()
        self._late.add((now_ns - sent_ns) / 1e6 - self._usual_ms, now_ns)


class DeviceClock:
    """Lateness by the stamps of a device's clock, which wraps at `wrap_ms`.

    Jitter does not count: of 0.3 s the quickest data do. While data are late, the clocks are
    assumed to drift as they did before.
    """

    def __init__(self, wrap_ms: int) -> None:
        self._wrap_ms = wrap_ms
        self.clear()

    def clear(self) -> None:
        """Start again: another device, or a restart of the same."""
        self._last: tuple[int, int] | None = None  # newest stamp [ms], and when it came [ns]
        self._device_ms = self._floor_ms = 0.0  # the unwrapped count; least offset of the clocks
        self._odd = 0
        self._excess = Window()  # by how much data come too late [ms]
        self._floors = deque[tuple[int, float]](maxlen=SAMPLES)

    @property
    def late_ms(self) -> float:
        """The delay of all data of the last 0.3 s against the quickest ever [ms]."""
        return self._excess.least

    def arrived(self, stamp_ms: int, now_ns: int) -> None:
        """Note data with this stamp."""
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
            if self._odd >= MAX_ODD:
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
        """The drift of the device's clock against the host's, 0 until it is known."""
        if len(self._floors) < MIN_DRIFT_SAMPLES:
            return 0.0
        (then_ns, then_ms), (now_ns, now_ms) = self._floors[0], self._floors[-1]
        return (now_ms - then_ms) / ((now_ns - then_ns) / 1e6)
