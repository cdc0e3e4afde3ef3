"""Giving way at an occupied goal, to somebody who waits for the robot to leave."""

import math

import numpy as np

from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap
from gigabrain_zenoh.navigation.grid_search import GridSearch

OCCUPIED_NEAR_M = 2.0  # from the goal; a robot farther away blocks no one
GIVE_WAY_TICKS = 750  # 15 s; an obstacle that is still there does not wait for the robot
MAX_GIVE_WAYS = 2  # per goal
MAX_WAITING_COST = 2.0  # of a place to wait at
MAX_WAITING_PATH_M = 6.0
MIN_OFFSET_M = 1.0  # from the line that leads from the goal through the robot

Point = tuple[float, float]


class GiveWay:
    """Decides when to leave an occupied goal, for an obstacle that waits for the robot to go."""

    def __init__(self) -> None:
        self._count = self._since_tick = 0
        self.place: Goal | None = None  # where the robot waits now

    def update(
        self, goal: Goal, here: Point, tick: int, stuck: bool, costs: Costmap, search: GridSearch
    ) -> bool:
        """Begin, continue or stop giving way; return whether that has changed."""
        before, cell = self.place, costs.cell(goal.x, goal.y)
        occupied = cell is not None and costs.cost[cell] > LETHAL
        near = math.dist(here, (goal.x, goal.y)) < OCCUPIED_NEAR_M
        if before:
            waiting = tick - self._since_tick < GIVE_WAY_TICKS
            self.place = before if occupied and waiting else None
        elif occupied and stuck and self._count < MAX_GIVE_WAYS and near:
            self.place = waiting_place(costs, search, here, goal, far=self._count > 0)
            self._count, self._since_tick = self._count + 1, tick
        return self.place is not before


def waiting_place(
    costs: Costmap, search: GridSearch, here: Point, goal: Goal, *, far: bool
) -> Goal | None:
    """Return the nearest place away from the line goal-`here`, or the one farthest from the goal.

    An obstacle at the goal probably moves on along that line. The farthest place is for one that
    went another way, and for a robot without room to the side. None if no place is reachable.
    """
    start = costs.cell(*here)
    if start is None:
        return None
    way = search.field(costs.cost, start, "from") * costs.resolution
    rows, columns = np.nonzero((costs.cost < MAX_WAITING_COST) & (way < MAX_WAITING_PATH_M))
    if not len(rows):
        return None
    off = costs.points(rows, columns) - (goal.x, goal.y)
    ahead = math.atan2(here[1] - goal.y, here[0] - goal.x)
    offset = np.abs(off[:, 1] * math.cos(ahead) - off[:, 0] * math.sin(ahead))
    score = np.where(offset >= MIN_OFFSET_M, -way[rows, columns], -math.inf)
    if far or not np.isfinite(score).any():
        score = np.hypot(*off.T)
    x, y = (off[int(score.argmax())] + (goal.x, goal.y)).tolist()
    return Goal(x=x, y=y)
