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

NEAR_M = 2.0  # a nearer robot is in the way of the person
GIVE_WAY_TICKS = 750  # 15 s; an obstacle that is still there does not wait for the robot
MAX_IN_VAIN = 2  # times per goal that the person stayed
MAX_GIVE_WAYS = 10  # per goal
MAX_WAITING_COST = 2.0  # of a place to wait at
MAX_WAITING_PATH_M = 6.0
MIN_OFFSET_M = 1.0  # from the line on which the person walks
WALKED_TICKS = 3000  # 60 s, how long a walking person is remembered
STANDS_M = 0.4  # a scan's hit so near to a person's last place shows that the person stands there
BODY_M = 0.5  # a contour centred so near to a person's last place is the person
SAME_M = 1.0  # between two places of the same person
MAX_WAYS = 64  # number of remembered people
WALKED_M = 0.5  # from an obstacle's first place; false motion while turning is shorter

Point = tuple[float, float]
Way = tuple[float, float, float]  # x, y [m] of a person, and their direction [rad]


class Walkers:
    """Remembers the last places and directions of people who walked."""

    def __init__(self) -> None:
        self.ways: Floats = np.empty((0, 3))  # (n, 3) x, y [m] in the map, direction [rad]
        self._ticks = np.empty(0, np.int64)  # of their last motion
        self._ids = np.empty(0, np.int64)
        self._first: dict[int, Point] = {}  # first place of each obstacle, by id
        self._walked: set[int] = set()  # ids of obstacles that moved by WALKED_M or more

    def update(self, tick: int, obstacles: tuple[Obstacle, ...], map_from_odom: Pose) -> None:
        """Add the obstacles of a scan, in the odometry frame."""
        first = {one.id: self._first.get(one.id, (one.x, one.y)) for one in obstacles}
        self._walked &= first.keys()
        for one in obstacles:
            if math.dist(first[one.id], (one.x, one.y)) >= WALKED_M:
                self._walked.add(one.id)  # stays, also if the person comes back
        self._first = first
        walked = [one for one in obstacles if one.id in self._walked]
        if not walked and not len(self.ways):
            return
        frame = from_pose(map_from_odom)
        for one in walked:  # also those that seem to stand, as they may move slowly
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
    """Return the person of `ways` (n, 3) nearest to `place`, within `reach` [m]."""
    away = np.hypot(*(ways[:, :2] - place).T)
    if away.min(initial=math.inf) > reach:
        return None
    x, y, turn = ways[int(away.argmin())].tolist()
    return x, y, turn


def standing(ways: Floats, seen: Floats) -> Floats:
    """Return the people of `ways` (n, 3) that the hits `seen` (m, 2) confirm to stand there."""
    away = np.hypot(*(ways[:, None, :2] - seen).transpose(2, 0, 1))
    found: Floats = ways[(away <= STANDS_M).any(axis=1)]
    return found


def things(polygons: tuple[Floats, ...], ways: Floats) -> tuple[Floats, ...]:
    """Return the `polygons` (k, 2) [m] that are not people of `ways` (n, 3)."""
    return tuple(one for one in polygons if nearest(ways, tuple(one.mean(axis=0)), BODY_M) is None)


class GiveWay:
    """Decides when to move aside for a person who waits for the robot."""

    def __init__(self) -> None:
        self._count = self._in_vain = self._since_tick = 0
        self.place: Goal | None = None  # where the robot waits now
        self.left: Point | None = None  # place of the person for whom it left

    def update(
        self, other: Way | None, here: Point, tick: int, stuck: bool, costs: Costmap,
        search: GridSearch,
    ) -> bool:  # fmt: skip
        """Begin, continue or stop giving way to `other`; return whether that changed."""
        old_place = self.place
        if old_place:
            late = tick - self._since_tick >= GIVE_WAY_TICKS
            self._in_vain += late and other is not None
            self.place = None if late or other is None else old_place
        elif other and stuck and self._allowed and math.dist(here, other[:2]) < NEAR_M:
            self.place = waiting_place(costs, search, here, other, far=self._in_vain > 0)
            self._count += self.place is not None
            self._since_tick, self.left = tick, other[:2]
        return self.place is not old_place

    @property
    def _allowed(self) -> bool:
        return self._in_vain < MAX_IN_VAIN and self._count < MAX_GIVE_WAYS


def waiting_place(
    costs: Costmap, search: GridSearch, here: Point, other: Way, *, far: bool
) -> Goal | None:
    """Return the nearest reachable place beside the line on which `other` walks.

    Return the place farthest from `other` if `far`, or if there is no room beside the line; None if
    no place is reachable.
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
