"""How late scans are answered by who thinks about them, on the robot's own clock."""

from collections import deque

from gigabrain_schemas.base import TICK_NS

ON_TIME_TICKS = 2  # from a scan to the first state after its answer
REMEMBERED_TICKS = 100
TICK_S = TICK_NS / 1e9


class Lateness:
    """What the slowest answer of the last two seconds has taken beyond what is usual.

    An answer is over when the next state is looked at: as long as somebody thinks, or is not let
    think, states wait. With time in lock-step every answer is in time.
    """

    def __init__(self) -> None:
        self._boot = 0
        self._open: tuple[int, int] | None = None  # the tick in which it began, and of its scan
        self._late: deque[tuple[int, int]] = deque()  # when, and by how much [ticks]

    def sees(self, boot: int, tick: int) -> None:
        """A state is looked at."""
        if boot != self._boot:
            self._boot, self._open = boot, None
            self._late.clear()
        if self._open and tick > self._open[0]:
            self._late.append((tick, tick - 1 - self._open[1]))
            self._open = None
        while self._late and tick - self._late[0][0] > REMEMBERED_TICKS:
            self._late.popleft()

    def thinks(self, tick: int, basis: int) -> None:
        """In this tick somebody begins to think about the scan of the tick `basis`."""
        self._open = tick, basis

    @property
    def seconds(self) -> float:
        """By how much longer than usual it takes; 0 where it does not."""
        most = max((late for _, late in self._late), default=0)
        return max(0, most - ON_TIME_TICKS) * TICK_S
