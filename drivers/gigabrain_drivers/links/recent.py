"""Keeps the newest value of a repeating device while it is recent. Pure."""

from typing import Generic, TypeVar

T = TypeVar("T")

MAX_AGE_PERIODS = 3  # a value expires after this many periods,
MIN_AGE_NS = 2_000_000_000  # but not before this age,
FIRST_AGE_NS = 30_000_000_000  # nor after this one; a first value, without a period, expires here


class Recent(Generic[T]):
    """The newest value of a repeating device. It expires after three periods.

    It expires after `min_age_ns` at the earliest, and after `first_age_ns` at the latest.
    """

    def __init__(self, min_age_ns: int = MIN_AGE_NS, first_age_ns: int = FIRST_AGE_NS) -> None:
        self._min_age_ns, self._first_age_ns = min_age_ns, first_age_ns
        self._value: T | None = None
        self._received_ns, self._max_age_ns = 0, first_age_ns

    def put(self, value: T, now_ns: int) -> None:
        """Store a new value."""
        if self.get(now_ns) is None:
            self._max_age_ns = self._first_age_ns
        else:  # at least half the old age: after a delay, several values arrive at once
            period_ns = now_ns - self._received_ns
            age_ns = max(MAX_AGE_PERIODS * period_ns, self._min_age_ns, self._max_age_ns // 2)
            self._max_age_ns = min(age_ns, self._first_age_ns)
        self._value, self._received_ns = value, now_ns

    def get(self, now_ns: int) -> T | None:
        """Return the newest value, or None if none is recent."""
        return self._value if now_ns - self._received_ns <= self._max_age_ns else None
