"""Gives way to a person at the goal or on the route who waits for the robot to leave."""

import math

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.geometry.se2 import from_pose, rotation, transform
from gigabrain_zenoh.navigation.costmap import Costmap
from gigabrain_zenoh.navigation.dynamic_obstacles import discs_of
from gigabrain_zenoh.navigation.grid_search import GridSearch

NEAR_M = 2.0  # from the goal or the person, within which the robot is in the way
GIVE_WAY_TICKS = 750  # 15 s; an obstacle that is still there does not wait for the robot
MAX_IN_VAIN = 2  # per goal, after which the other was still there,
MAX_GIVE_WAYS = 10  # and in all
MAX_WAITING_COST = 2.0  # of a place to wait at
MAX_WAITING_PATH_M = 6.0
MIN_OFFSET_M = 1.0  # from the line on which the other is likely to go on
WALKED_TICKS = 3000  # 60 s, how long a walking person is remembered
STANDS_M = 0.4  # from a person's last place to a hit of the scan: still there
BODY_M = 0.5  # from a person's last place to the middle of a contour: their own
SAME_M = 1.0  # between two places of the same person
MAX_WAYS = 64  # that are remembered
WALKED_M = 0.5  # from where it was first seen: the shadows of a robot that turns do not get so far

Point = tuple[float, float]
Way = tuple[float, float, float]  # x, y [m] of a person, and their direction [rad]


class Walkers:
    """Remembers people who have walked: where they were last seen, and where they were going."""

    def __init__(self) -> None:
        self.ways: Floats = np.empty((0, 3))  # (n, 3) x, y [m] in the map, direction [rad]
        self._ticks = np.empty(0, np.int64)  # of their last step
        self._ids = np.empty(0, np.int64)
        self._first: dict[int, Point] = {}  # place of each obstacle when it was first seen
        self._walked: set[int] = set()  # those that have been far from there

    def update(self, tick: int, obstacles: tuple[Obstacle, ...], map_from_odom: Pose) -> None:
        """Take in the obstacles of a scan, in the frame of the odometry."""
        first = {one.id: self._first.get(one.id, (one.x, one.y)) for one in obstacles}
        self._walked &= first.keys()
        for one in obstacles:
            if math.dist(first[one.id], (one.x, one.y)) >= WALKED_M:
                self._walked.add(one.id)  # also when they come back
        self._first = first
        walked = [one for one in obstacles if one.id in self._walked]
        if not walked and not len(self.ways):
            return
        frame = from_pose(map_from_odom)
        for one in walked:  # they may go on too slowly to be seen moving
            self.ways[self._ids == one.id, :2] = transform(frame, np.array([[one.x, one.y]]))
        stepped = [one for one in walked if len(discs_of((one,)))]
        moving = discs_of(tuple(stepped))
        places = transform(frame, moving[:, :2])
        turns = np.arctan2(moving[:, 3], moving[:, 2]) + map_from_odom.yaw
        away = np.hypot(*(self.ways[:, None, :2] - places).transpose(2, 0, 1))
        kept = (away > SAME_M).all(axis=1) & (np.abs(tick - self._ticks) <= WALKED_TICKS)
        ways = np.concatenate((self.ways[kept], np.column_stack((places, turns))))
        ticks = np.concatenate((self._ticks[kept], np.full(len(moving), tick)))
        ids = np.concatenate((self._ids[kept], np.array([one.id for one in stepped], np.int64)))
        self.ways, self._ticks, self._ids = ways[-MAX_WAYS:], ticks[-MAX_WAYS:], ids[-MAX_WAYS:]


def nearest(ways: Floats, place: Point, reach: float) -> Way | None:
    """Return the one of `ways` (n, 3) that is nearest to `place`, within `reach` [m]."""
    away = np.hypot(*(ways[:, :2] - place).T)
    if away.min(initial=math.inf) > reach:
        return None
    x, y, turn = ways[int(away.argmin())].tolist()
    return x, y, turn


def standing(ways: Floats, seen: Floats) -> Floats:
    """Return those of `ways` (n, 3) who are still where they were, by the hits `seen` (m, 2)."""
    away = np.hypot(*(ways[:, None, :2] - seen).transpose(2, 0, 1))
    found: Floats = ways[(away <= STANDS_M).any(axis=1)]
    return found


def things(polygons: tuple[Floats, ...], ways: Floats) -> tuple[Floats, ...]:
    """Return the `polygons` (k, 2) [m] that are none of the people of `ways` (n, 3)."""
    return tuple(one for one in polygons if nearest(ways, tuple(one.mean(axis=0)), BODY_M) is None)


class GiveWay:
    """Decides when to move aside for a person who waits for the robot."""

    def __init__(self) -> None:
        self._count = self._in_vain = self._since_tick = 0
        self.place: Goal | None = None  # where the robot waits now,
        self.left: Point | None = None  # and for whom

    def update(
        self, other: Way | None, here: Point, tick: int, stuck: bool, costs: Costmap,
        search: GridSearch,
    ) -> bool:  # fmt: skip
        """Begin, continue or stop giving way to `other`; return whether that has changed."""
        before = self.place
        if before:
            late = tick - self._since_tick >= GIVE_WAY_TICKS
            self._in_vain += late and other is not None
            self.place = None if late or other is None else before
        elif other and stuck and self._may_again and math.dist(here, other[:2]) < NEAR_M:
            self.place = waiting_place(costs, search, here, other, far=self._in_vain > 0)
            self._count += self.place is not None
            self._since_tick, self.left = tick, other[:2]
        return self.place is not before

    @property
    def _may_again(self) -> bool:
        return self._in_vain < MAX_IN_VAIN and self._count < MAX_GIVE_WAYS


def waiting_place(
    costs: Costmap, search: GridSearch, here: Point, other: Way, *, far: bool
) -> Goal | None:
    """Return the nearest place beside the line on which `other` goes, or the farthest from there.

    Take the farthest place for a person who went another way, or where there is no room to the
    side. Return None if no place is reachable.
    """
    start = costs.cell(*here)
    if start is None:
        return None
    way = search.field(costs.cost, start, "from") * costs.resolution
    free = (costs.cost < MAX_WAITING_COST) & (costs.cells >= 0)
    rows, columns = np.nonzero(free & (way < MAX_WAITING_PATH_M))
    if not len(rows):
        return None
    x, y, ahead = other
    off = costs.points(rows, columns) - (x, y)
    offset = np.abs((off @ rotation(ahead)[:2, :2])[:, 1])
    score = np.where(offset >= MIN_OFFSET_M, -way[rows, columns], -math.inf)
    if far or not np.isfinite(score).any():
        score = np.hypot(*off.T)
    dx, dy = off[int(score.argmax())].tolist()
    return Goal(x=x + dx, y=y + dy)
