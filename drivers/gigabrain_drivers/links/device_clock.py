"""Delay of a device's data, from the stamps of its own clock or from its echoes. Pure.

The fastest data so far give the offset of the two clocks; slower data are late. Stamps do not
show a delay that exists from the start. A delay that grows by less than MAX_DRIFT is not
distinguished from clock drift.
"""

from collections import deque

MAX_UNANSWERED = 64  # messages that wait for an echo
WINDOW_NS = 300_000_000  # the delay is the minimum in this window,
MIN_WINDOW_SHARE = 0.8  # once this share of it has passed
SILENCE_MS = 500.0  # after a longer silence, the device may have restarted;
RESTART_MS = 1000.0  # it did, if its data would otherwise be later by more than this
LATE_MS = 50.0  # drift is not measured while the delay is longer
MAX_DRIFT = 0.01  # between the two clocks; an RC oscillator may drift as much
EARLY_MS = 100.0  # data may arrive too early by this, after a delay of the host
MAX_INVALID = 3  # the clock counts as new after this many impossible stamps in a row
DRIFT_PERIOD_NS, MAX_DRIFT_SAMPLES = 1_000_000_000, 120  # of the offset, to measure drift
MIN_DRIFT_SAMPLES = 10


class SlidingMinimum:
    """The minimum of the values of the last 0.3 s."""

    def __init__(self) -> None:
        self._minima = deque[tuple[int, float]]()  # time [ns] and value of possible minima
        self._began_ns = 0
        self.newest = 0.0

    def add(self, value: float, now_ns: int) -> None:
        """Add a value, received at `now_ns`."""
        if not self._minima or now_ns - self._minima[-1][0] > WINDOW_NS:
            self._began_ns = now_ns
        while self._minima and self._minima[-1][1] >= value:
            self._minima.pop()
        self._minima.append((now_ns, value))
        self.newest = value
        while now_ns - self._minima[0][0] > WINDOW_NS:
            self._minima.popleft()

    @property
    def minimum(self) -> float:
        """The minimum in the window, at least 0; 0 until the window is full."""
        if not self._minima or self._minima[-1][0] - self._began_ns < MIN_WINDOW_SHARE * WINDOW_NS:
            return 0.0
        return max(0.0, self._minima[0][1])


class EchoClock:
    """Delay of a device that echoes the number of the newest message to it.

    The delay is the round trip minus `usual_ms`; it includes delays that exist from the start.
    """

    def __init__(self, usual_ms: float) -> None:
        self._usual_ms = usual_ms
        self._sent = deque[tuple[int, int]](maxlen=MAX_UNANSWERED)  # number, and time [ns]
        self._late = SlidingMinimum()

    @property
    def late_ms(self) -> float:
        """The minimum delay of the echoes in the last 0.3 s, minus the usual one [ms]."""
        return self._late.minimum

    def sent(self, number: int, now_ns: int) -> None:
        """Record a sent message."""
        self._sent.append((number, now_ns))

    def echoed(self, number: int, now_ns: int) -> None:
        """Record an echo of a message; only the first echo counts."""
        numbers = [waiting for waiting, _ in self._sent]
        if number not in numbers:
            return
        for _ in range(numbers.index(number) + 1):
            _, sent_ns = self._sent.popleft()
        self._late.add((now_ns - sent_ns) / 1e6 - self._usual_ms, now_ns)


class DeviceClock:
    """Delay from the stamps of a device's clock, which wraps at `wrap_ms`.

    The fastest data in 0.3 s count, so jitter has no effect. While data are late, the clocks are
    assumed to drift as before.
    """

    def __init__(self, wrap_ms: int) -> None:
        self._wrap_ms = wrap_ms
        self.clear()

    def clear(self) -> None:
        """Reset all state, for another device or one that restarted."""
        self._last: tuple[int, int] | None = None  # newest stamp [ms], and its arrival [ns]
        self._device_ms = self._offset_ms = 0.0  # unwrapped stamp; minimum offset of the clocks
        self._invalid = 0  # impossible stamps in a row
        self._delay = SlidingMinimum()  # [ms]
        self._offsets = deque[tuple[int, float]](maxlen=MAX_DRIFT_SAMPLES)

    @property
    def late_ms(self) -> float:
        """The minimum delay of data in the last 0.3 s, relative to the fastest data ever [ms]."""
        return self._delay.minimum

    def arrived(self, stamp_ms: int, now_ns: int) -> None:
        """Record data with the stamp `stamp_ms`."""
        if self._last is None:
            self._begin(stamp_ms, now_ns)
            return
        last_ms, last_ns = self._last
        passed_ms, silent_ms = (stamp_ms - last_ms) % self._wrap_ms, (now_ns - last_ns) / 1e6
        went_back = stamp_ms < last_ms or silent_ms - passed_ms > RESTART_MS
        if silent_ms > SILENCE_MS and (went_back or 2 * silent_ms > self._wrap_ms):
            self._begin(stamp_ms, now_ns)
        elif passed_ms > silent_ms + self._delay.newest + EARLY_MS:
            self._invalid += 1
            if self._invalid >= MAX_INVALID:
                self._begin(stamp_ms, now_ns)
        else:
            self._invalid, self._last = 0, (stamp_ms, now_ns)
            self._device_ms += passed_ms
            self._update_delay(now_ns, silent_ms)

    def _begin(self, stamp_ms: int, now_ns: int) -> None:
        self.clear()
        self._last, self._offset_ms = (stamp_ms, now_ns), now_ns / 1e6

    def _update_delay(self, now_ns: int, elapsed_ms: float) -> None:
        late = self.late_ms >= LATE_MS
        self._offset_ms += elapsed_ms * (self._drift() if late else MAX_DRIFT)
        current_ms = now_ns / 1e6 - self._device_ms
        self._offset_ms = min(self._offset_ms, current_ms)
        self._delay.add(current_ms - self._offset_ms, now_ns)
        if not late and (not self._offsets or now_ns - self._offsets[-1][0] >= DRIFT_PERIOD_NS):
            self._offsets.append((now_ns, self._offset_ms))

    def _drift(self) -> float:
        """Return the drift of the device's clock against the host's; 0 until it is known."""
        if len(self._offsets) < MIN_DRIFT_SAMPLES:
            return 0.0
        (first_ns, first_ms), (last_ns, last_ms) = self._offsets[0], self._offsets[-1]
        return (last_ms - first_ms) / ((last_ns - first_ns) / 1e6)
