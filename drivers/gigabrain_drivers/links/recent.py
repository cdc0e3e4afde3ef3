"""Keeps a value that a device repeats, as long as it is recent. Pure."""

from typing import Generic, TypeVar

T = TypeVar("T")

PERIODS = 3  # without a new value, and the last one is not recent any more,
MIN_AGE_NS = 2_000_000_000  # but not before
FIRST_AGE_NS = 30_000_000_000  # the same for the first value, whose period is not known yet


class Recent(Generic[T]):
    """The newest of the values that a device repeats. It expires after three of its periods.

    But not before `min_age_ns`, and at the latest after `first_age_ns`.
    """

    def __init__(self, min_age_ns: int = MIN_AGE_NS, first_age_ns: int = FIRST_AGE_NS) -> None:
        self._min_age_ns, self._first_age_ns = min_age_ns, first_age_ns
        self._value: T | None = None
        self._came_ns, self._max_age_ns = 0, first_age_ns

    def put(self, value: T, now_ns: int) -> None:
        """Take a new value."""
        if self.get(now_ns) is None:
            self._max_age_ns = self._first_age_ns
        else:  # at least half of what it was: after a delay, several values come at once
            period_ns = now_ns - self._came_ns
            age_ns = max(PERIODS * period_ns, self._min_age_ns, self._max_age_ns // 2)
            self._max_age_ns = min(age_ns, self._first_age_ns)
        self._value, self._came_ns = value, now_ns

    def get(self, now_ns: int) -> T | None:
        """Return the newest value, or None where there is none that is recent."""
        return self._value if now_ns - self._came_ns <= self._max_age_ns else None
