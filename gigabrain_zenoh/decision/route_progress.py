"""Progress along a route: when a robot is stuck, and when it gives way to someone at its goal."""

import math

import numpy as np

from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap
from gigabrain_zenoh.navigation.grid_search import GridSearch

PROGRESS_M = 0.3  # a smaller gain is no progress
DETOUR_M = 1.0  # a path that is longer than the last plan by this is another way
AT_GOAL_M = 0.05  # of path left where the robot only has to turn and stop
MAX_TIMER_RESTARTS = 3  # for detours and arrivals, until the robot is nearer than ever

OCCUPIED_NEAR_M = 2.0  # from the goal; farther away the robot is in nobody's way
GIVE_WAY_TICKS = 750  # 15 s; an obstacle that is still there does not wait for the robot
MAX_GIVE_WAYS = 2  # per goal
MAX_WAITING_COST = 2.0  # of a place to wait at
MAX_WAITING_PATH_M = 6.0
MIN_OFFSET_M = 1.0  # from the line that leads from the goal through the robot

Point = tuple[float, float]


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


class GiveWay:
    """Decides when to leave an occupied goal, for an obstacle that waits for the robot to go."""

    def __init__(self) -> None:
        self._count = self._since_tick = 0
        self.place: Goal | None = None  # where the robot waits now

    def update(
        self, goal: Goal, here: Point, tick: int, stuck: bool, chart: Costmap, search: GridSearch
    ) -> bool:
        """Begin, continue or stop giving way; return whether that has changed."""
        before, cell = self.place, chart.cell(goal.x, goal.y)
        occupied = cell is not None and chart.cost[cell] > LETHAL
        near = math.dist(here, (goal.x, goal.y)) < OCCUPIED_NEAR_M
        if before:
            waiting = tick - self._since_tick < GIVE_WAY_TICKS
            self.place = before if occupied and waiting else None
        elif occupied and stuck and self._count < MAX_GIVE_WAYS and near:
            self.place = waiting_place(chart, search, here, goal, far=self._count > 0)
            self._count, self._since_tick = self._count + 1, tick
        return self.place is not before


def waiting_place(
    chart: Costmap, search: GridSearch, here: Point, goal: Goal, *, far: bool
) -> Goal | None:
    """Return the nearest place away from the line goal-`here`, or the one farthest from the goal.

    An obstacle at the goal probably moves on along that line. The farthest place is for one that
    went another way, and for a robot without room to the side. None if no place is reachable.
    """
    start = chart.cell(*here)
    if start is None:
        return None
    way = search.field(chart.cost, start, "from") * chart.resolution
    rows, columns = np.nonzero((chart.cost < MAX_WAITING_COST) & (way < MAX_WAITING_PATH_M))
    if not len(rows):
        return None
    off = chart.points(rows, columns) - (goal.x, goal.y)
    ahead = math.atan2(here[1] - goal.y, here[0] - goal.x)
    offset = np.abs(off[:, 1] * math.cos(ahead) - off[:, 0] * math.sin(ahead))
    score = np.where(offset >= MIN_OFFSET_M, -way[rows, columns], -math.inf)
    if far or not np.isfinite(score).any():
        score = np.hypot(*off.T)
    x, y = (off[int(score.argmax())] + (goal.x, goal.y)).tolist()
    return Goal(x=x, y=y)
