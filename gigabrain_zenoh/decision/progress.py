"""Detects that the robot makes no progress along its path."""

import math

PROGRESS_M = 0.3  # a smaller gain is no progress
DETOUR_M = 1.0  # a path that became longer by more than this is a detour
AT_GOAL_M = 0.05  # with so little path left the robot only has to turn and stop
MAX_TIMER_RESTARTS = 3  # for detours and arrivals, until the remaining path is a new minimum


class ProgressMonitor:
    """Measures the time since the remaining path last became shorter.

    The timer also restarts for a new detour, and whenever the goal is reached, as after giving way
    there.
    """

    def __init__(self, tick: int) -> None:
        self._since_tick = tick  # of the last progress
        # remaining path: the minimum, the minimum since the timer started, and the newest
        self._best_m = self._nearest_m = self._remaining_m = math.inf
        self._restarts = 0
        self._was_held = False

    def measure(self, remaining_m: float, tick: int) -> None:
        """Record the length of the remaining path [m]."""
        if self._was_held and remaining_m > self._remaining_m:  # an operator drove it away
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
        """Do not count `ticks` in which the robot could not follow the route."""
        self._since_tick += ticks
        self._was_held = self._was_held or ticks > 0

    def stuck(self, tick: int, ticks: int) -> bool:
        """Return whether there was no progress for more than `ticks`."""
        return tick - self._since_tick > ticks
