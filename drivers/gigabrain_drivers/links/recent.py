"""Keeps a value that a device repeats, as long as it is recent. Pure."""

from typing import Generic, TypeVar

T = TypeVar("T")

PERIODS = 3  # without a new value, and the last one is not recent any more,
MIN_AGE_NS = 2_000_000_000  # but not before
FIRST_AGE_NS = 30_000_000_000  # the same for the first value, whose period is not known yet


class Recent(Generic[T]):
    """The newest of the values that a device repeats. It expires after three of its periods."""

    def __init__(self) -> None:
        self._value: T | None = None
        self._came_ns, self._max_age_ns = 0, FIRST_AGE_NS

    def put(self, value: T, now_ns: int) -> None:
        """Take a new value."""
        if self.get(now_ns) is None:
            self._max_age_ns = FIRST_AGE_NS
        else:  # at least half of what it was: after a delay, several values come at once
            period_ns = now_ns - self._came_ns
            self._max_age_ns = max(PERIODS * period_ns, MIN_AGE_NS, self._max_age_ns // 2)
        self._value, self._came_ns = value, now_ns

    def get(self, now_ns: int) -> T | None:
        """Return the newest value, or None where there is none that is recent."""
        return self._value if now_ns - self._came_ns <= self._max_age_ns else None
