"""Standing aside: who is at the goal, and does not go, may wait for the robot to leave."""

import math

import numpy as np

from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap
from gigabrain_zenoh.navigation.search import Search

NEAR_M = 2.0  # from the goal, or the robot is in nobody's way
AWAY_TICKS = 750  # 15 s: who has not gone by then does not wait for the robot
TIMES = 2  # at most, on the way to a goal
OPEN = 2.0  # cost of a place that is worth standing at
FARTHEST_M = 6.0  # of way
BESIDE_M = 1.0  # off the line that leads from the goal through the robot and on

Place = tuple[float, float]


class Courtesy:
    """Whether to stand aside on the way to one goal, and where."""

    def __init__(self) -> None:
        self._times = self._since = 0  # the latter a tick
        self.place: Goal | None = None  # where it stands aside now

    def look(
        self, goal: Goal, here: Place, tick: int, stuck: bool, chart: Costmap, search: Search
    ) -> bool:
        """Begin, go on or end to stand aside; whether that has changed. `stuck`: no nearer."""
        before, cell = self.place, chart.cell(goal.x, goal.y)
        taken = cell is not None and chart.cost[cell] > LETHAL
        if before:
            self.place = before if taken and tick - self._since < AWAY_TICKS else None
        elif taken and stuck and self._times < TIMES and math.dist(here, (goal.x, goal.y)) < NEAR_M:
            self.place = aside(chart, search, here, goal, far=self._times > 0)
            self._times, self._since = self._times + 1, tick
        return self.place is not before


def aside(chart: Costmap, search: Search, here: Place, goal: Goal, *, far: bool) -> Goal | None:
    """The nearest place beside the line from the goal through `here`, or the farthest from it.

    Whoever stands at the goal and waits is likely to go on along that line. The farthest place is
    for one who turned out to go another way, and for a robot that has no room beside.
    None where no way leads anywhere.
    """
    start = chart.cell(*here)
    if start is None:
        return None
    way = search.field(chart.cost, start, "from") * chart.resolution
    rows, columns = np.nonzero((chart.cost < OPEN) & (way < FARTHEST_M))
    if not len(rows):
        return None
    off = chart.points(rows, columns) - (goal.x, goal.y)
    ahead = math.atan2(here[1] - goal.y, here[0] - goal.x)
    beside = np.abs(off[:, 1] * math.cos(ahead) - off[:, 0] * math.sin(ahead))
    worth = np.where(beside >= BESIDE_M, -way[rows, columns], -math.inf)
    if far or not np.isfinite(worth).any():
        worth = np.hypot(*off.T)
    x, y = (off[int(worth.argmax())] + (goal.x, goal.y)).tolist()
    return Goal(x=x, y=y)
