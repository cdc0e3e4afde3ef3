"""How long a robot has come no nearer to where it is going."""

import math

NEARER_M = 0.3  # what counts as nearer
DETOUR_M = 1.0  # so much longer from one plan to the next is another way
THERE_M = 0.05  # of way is left where all that remains is to turn and stand
ANEW = 3  # times at most either begins its time anew, until the robot is nearer than ever


class Progress:
    """Measures what is left of the way.

    A detour that has become necessary has its own time, and so has the goal once it is reached,
    again where the robot had to give way there.
    """

    def __init__(self, tick: int) -> None:
        self._since = tick  # it has come no nearer
        self._record = self._nearest = self._left = math.inf  # [m]: ever, on this way, and now
        self._times = 0
        self._was_held = False

    def measure(self, left: float, tick: int) -> None:
        """So much of the way [m] is left now."""
        if self._was_held and left > self._left:  # an operator has driven it away meanwhile
            self._nearest += left - self._left
            self._record += left - self._left
        self._was_held = False
        if left < self._record - NEARER_M:
            self._record, self._times = left, 0
        detour, there = left > self._left + DETOUR_M, left <= THERE_M < self._left
        anew = (detour or there) and self._times < ANEW
        self._times += anew
        self._left = left
        if anew or left < self._nearest - NEARER_M:
            self._nearest, self._since = left, tick

    def hold(self, ticks: int) -> None:
        """Leave out so many ticks, in which the robot could not follow the route."""
        self._since += ticks
        self._was_held = self._was_held or ticks > 0

    def stuck(self, tick: int, ticks: int) -> bool:
        """Whether it has come no nearer for more than so many ticks."""
        return tick - self._since > ticks
