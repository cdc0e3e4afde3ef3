"""When to start a dead process again, and when to give it up. Pure: the times are passed in."""

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True)
class Backoff:
    """How long to wait after a death, and how many deaths are too many."""

    first_s: float = 0.2
    factor: float = 2.0
    longest_s: float = 5.0
    deaths: int = 5  # this many ...
    window_s: float = 60.0  # ... within this time, and it is given up
    reset_after_s: float = 10.0  # up this long, and the next wait is the first again


class Patience:
    """What is left of the patience with one process."""

    def __init__(self, backoff: Backoff) -> None:
        self._backoff = backoff
        self._deaths: deque[float] = deque()
        self._next_s = backoff.first_s

    def died(self, now_s: float, up_s: float) -> float | None:
        """Seconds to wait before the next start, or None to give up; `up_s` is since ready."""
        backoff = self._backoff
        self._deaths.append(now_s)
        while now_s - self._deaths[0] > backoff.window_s:
            self._deaths.popleft()
        if len(self._deaths) >= backoff.deaths:
            return None
        delay_s = backoff.first_s if up_s >= backoff.reset_after_s else self._next_s
        self._next_s = min(delay_s * backoff.factor, backoff.longest_s)
        return delay_s
