"""Percentiles, by nearest rank."""

import math
from bisect import bisect_left, insort
from collections import deque
from collections.abc import Sequence


def percentile(ordered: Sequence[float], share: float) -> float | None:
    """The smallest of `ordered` (ascending) that at least `share` of them do not exceed."""
    if not ordered:
        return None
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]


class Newest:
    """The newest `most` values. Kept in order as they come: to ask must not hold a loop up."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._arrived: deque[float] = deque()
        self._ordered: list[float] = []

    def __len__(self) -> int:
        return len(self._ordered)

    def add(self, value: float) -> None:
        """Take one in; beyond `most` the oldest gives way."""
        if len(self._arrived) == self._most:
            del self._ordered[bisect_left(self._ordered, self._arrived.popleft())]
        self._arrived.append(value)
        insort(self._ordered, value)

    def percentile(self, share: float) -> float | None:
        """The value that `share` of them do not exceed; None before the first."""
        return percentile(self._ordered, share)
