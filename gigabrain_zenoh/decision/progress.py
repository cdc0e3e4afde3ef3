"""Progress along the remaining path, to notice when there is none."""

import math

PROGRESS_M = 0.3  # a smaller gain is no progress
DETOUR_M = 1.0  # a path that is longer than the last plan by this is another way
AT_GOAL_M = 0.05  # of path left where the robot only has to turn and stop
MAX_TIMER_RESTARTS = 3  # for detours and arrivals, until the robot is nearer than ever


class ProgressMonitor:
    """Measures for how long the remaining path has not become shorter.

    The timer restarts for a detour that has become necessary, and when the goal is reached, also
    after giving way there.
    """

    def __init__(self, tick: int) -> None:
        self._since_tick = tick  # of the last progress
        self._best_m = self._nearest_m = self._remaining_m = math.inf  # ever, on this way, and now
        self._restarts = 0
        self._was_held = False

    def measure(self, remaining_m: float, tick: int) -> None:
        """Record the length of the remaining path [m]."""
        if self._was_held and remaining_m > self._remaining_m:  # an operator has driven it away
            self._nearest_m += remaining_m - self._remaining_m
            self._best_m += remaining_m - self._remaining_m
        self._was_held = False
        if remaining_m < self._best_m - PROGRESS_M:
            self._best_m, self._restarts = remaining_m, 0
        detour = remaining_m > self._remaining_m + DETOUR_M
        arrival = remaining_m <= AT_GOAL_M < self._remaining_m
        restart = (detour or arrival) and self._restarts < MAX_TIMER_RESTARTS
        self._restarts += restart
        self._remaining_m = remaining_m
        if restart or remaining_m < self._nearest_m - PROGRESS_M:
            self._nearest_m, self._since_tick = remaining_m, tick

    def hold(self, ticks: int) -> None:
        """Leave out `ticks` in which the robot could not follow the route."""
        self._since_tick += ticks
        self._was_held = self._was_held or ticks > 0

    def stuck(self, tick: int, ticks: int) -> bool:
        """Return whether there has been no progress for more than `ticks`."""
        return tick - self._since_tick > ticks
