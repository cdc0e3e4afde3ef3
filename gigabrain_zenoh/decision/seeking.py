"""Places to drive to: in front of an object or tag, viewpoints of a search, or random ones."""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.behaviours import Target
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap
from gigabrain_zenoh.navigation.grid_search import GridSearch

GAP_M = 0.25  # between the body's front and its target
EXTRA_GAPS_M = (0.0, 0.1, 0.2, 0.35, 0.5, 0.8)  # for targets in corners
OBJECT_RAD = np.radians(np.arange(0, 360, 15))  # directions from which to face an object,
TAG_RAD = np.radians((0, -10, 10, -20, 20, -35, 35))  # and a tag, relative to its normal
GAP_COST, TURN_COST, CELL_COST = 4.0, 1.0, 0.05  # [m] of path, per metre, rad and cell cost
OWN_M = 0.25  # occupied cells so near to a target belong to it, or to what it stands at
OCCUPIED_PERCENT = 65

CELL_M = 0.2  # of the grid of seen cells
# maximum range of a look in the first round, and in the second one: within 2 m the network detects
# a can in nine of ten pictures, farther away in fewer than half
LOOKS_M = 1.9, 1.2
MAX_RETRIES = 2  # to reach unexplored space: people may have left
OWN_GROUND_M = 0.5  # cells so near to the body count as seen: the body would touch any object there
EDGE_RAD = math.radians(4)  # at the edge of the picture, where an object may be cut off
SAMPLE_M = 0.05  # along a line of sight
MIN_RANGE_M, RANGE_MARGIN_M = 0.5, 0.1  # of viewpoints; the margin is below the maximum range
MIN_NEIGHBOURS, NEIGHBOURS_M = 4, 0.45  # an unseen cell with more such neighbours is worth a look
SETTLED_TICKS = 75  # 1.5 s after the last new cell, as recognition takes time
VIEWPOINTS = 16  # candidates around a cell, at each range
LOOK_COST_M = 1.0  # [m] of path, for one look

MAX_VISIT_COST, MIN_VISIT_M = 2.0, 1.5  # cost of a place to visit, and length of the path [m]

Cells = NDArray[np.int64]  # (n, 2), indices of cells of CELL_M in the map's frame


def place_before(
    costs: Costmap, body: BodyDescription, here: Pose, target: Target, search: GridSearch
) -> Goal | None:
    """Return the best free place from which the body faces a target; None if there is none."""
    start = costs.cell(here.x, here.y)
    if start is None:
        return None
    way = search.field(costs.cost, start, "from", costs.against) * costs.resolution
    front = max(x for x, _ in body.footprint)
    best: tuple[float, Goal] | None = None
    angles = OBJECT_RAD if target.yaw is None else target.yaw + TAG_RAD
    for extra_gap in EXTRA_GAPS_M if target.away is None else (0.0,):
        away = target.away or front + target.radius + GAP_M + extra_gap
        for angle in angles.tolist():
            x, y = target.x + away * math.cos(angle), target.y + away * math.sin(angle)
            cell = costs.cell(x, y)
            if cell is None or costs.cost[cell] >= LETHAL or not math.isfinite(way[cell]):
                continue
            if costs.zone_problem(x, y) or not _sees(costs, (x, y), target):
                continue
            turn = 0.0 if target.yaw is None else abs(math.remainder(angle - target.yaw, math.tau))
            cost = GAP_COST * extra_gap + TURN_COST * turn
            cost += float(way[cell]) + CELL_COST * float(costs.cost[cell])
            if best is None or cost < best[0]:
                yaw = math.remainder(angle + math.pi, math.tau)
                best = cost, Goal(x=x, y=y, yaw=yaw)
    return best[1] if best else None


def random_place(costs: Costmap, here: Pose, seed: int, search: GridSearch) -> Goal:
    """Return a random reachable place away from obstacles; `here` if there is none."""
    start = costs.cell(here.x, here.y)
    if start is not None:
        way = search.field(costs.cost, start, "from") * costs.resolution
        free = (costs.cost < MAX_VISIT_COST) & (way > MIN_VISIT_M) & np.isfinite(way)
        rows, columns = np.nonzero(free)
        if len(rows):
            i = int(np.random.default_rng(seed).integers(len(rows)))
            x, y = costs.points(rows[i : i + 1], columns[i : i + 1])[0].tolist()
            return Goal(x=x, y=y)
    return Goal(x=here.x, y=here.y)


def _sees(costs: Costmap, place: tuple[float, float], target: Target) -> bool:
    """Return whether no obstacle of the map is between a place and a target."""
    ends = np.array(((target.x, target.y),))
    return bool(in_sight(costs, np.array(place), ends, short=target.radius + OWN_M)[0])


def in_sight(costs: Costmap, eye: Floats, points: Floats, short: float) -> NDArray[np.bool_]:
    """Return which points (n, 2) `eye` (2,) sees; obstacles within `short` [m] of them are ignored.

    The result is a mask (n,).
    """
    off = points - eye
    far = np.hypot(*off.T)
    steps = np.arange(SAMPLE_M, float(far.max(initial=0.0)), SAMPLE_M)
    if not len(steps):
        return np.ones(len(points), np.bool_)
    lines = eye + steps[None, :, None] * (off / np.maximum(far, 1e-6)[:, None])[:, None, :]
    columns = np.floor((lines[..., 0] - costs.origin_x) / costs.resolution).astype(np.intp)
    rows = np.floor((lines[..., 1] - costs.origin_y) / costs.resolution).astype(np.intp)
    height, width = costs.cells.shape
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    walls = costs.cells[np.where(inside, rows, 0), np.where(inside, columns, 0)]
    blocked = inside & (walls >= OCCUPIED_PERCENT) & (steps[None, :] < (far - short)[:, None])
    return np.asarray(~blocked.any(axis=1))


class LookAround:
    """Cells seen by cameras in one search, and the next one to look at. Not thread-safe."""

    def __init__(self, seek: int = 0, tick: int = 0) -> None:
        self.seek = seek  # number of the search
        self._round = self._retries = 0
        self._seen: set[tuple[int, int]] = set()
        self.ended_tick: int | None = None  # since then nothing is left to look at
        self._aim: tuple[int, int] | None = None  # the next cell to look at
        self.goal: Goal | None = None  # place to look from
        self._changed_tick = tick  # of the last new cell

    def look(self, costs: Costmap, body: BodyDescription, here: Pose, tick: int) -> None:
        """Record what the body's cameras see from `here`."""
        count = len(self._seen)
        for camera in body.fixed_cameras:
            self._seen.update(map(tuple, _in_view(costs, camera, here, self._reach).tolist()))
        if len(self._seen) != count:
            self._changed_tick = tick
        if self._aim in self._seen:
            self.drop()

    def give_up(self) -> None:
        """Count the aim and its neighbours as seen: there is no better view of them."""
        if self._aim:
            i, j = self._aim
            reach = range(-1, 2)
            self._seen |= {(i + di, j + dj) for di in reach for dj in reach}
        self.drop()

    def look_closer(self) -> bool:
        """Start another round from nearer by; return False after the last one."""
        if self._round + 1 == len(LOOKS_M):
            return False
        self._round += 1
        self._seen.clear()
        return True

    def try_again(self) -> bool:
        """Count a retry to reach unexplored space; return False if none is left."""
        if self._retries == MAX_RETRIES:
            return False
        self._retries, self.ended_tick = self._retries + 1, None
        return True

    @property
    def _reach(self) -> float:
        return LOOKS_M[self._round]

    def drop(self) -> None:
        """Drop the aim, so that `next_goal` chooses another one."""
        self._aim = self.goal = None

    def settled(self, tick: int) -> bool:
        """Return whether no new cell was seen for SETTLED_TICKS."""
        return tick - self._changed_tick >= SETTLED_TICKS

    def next_goal(
        self, costs: Costmap, body: BodyDescription, here: Pose, search: GridSearch
    ) -> Goal | None:
        """Return the next place to look from; None if everything reachable was seen."""
        if self.goal:
            return self.goal
        start = costs.cell(here.x, here.y)
        if start is None:
            return None
        way = search.field(costs.cost, start, "from", costs.against) * costs.resolution
        unseen, paths_m = self._unseen(costs, way)
        if not len(unseen):
            return None
        spots = ((unseen + 0.5) * CELL_M).astype(np.float64)
        bearing = np.arctan2(spots[:, 1] - here.y, spots[:, 0] - here.x)
        turn = np.abs(np.remainder(bearing - here.yaw + np.pi, 2 * np.pi) - np.pi)
        best = int(np.argmin(paths_m + 0.3 * turn))
        self._aim = tuple(unseen[best].tolist())
        self.goal = _viewpoint(costs, body, here, spots[best], spots, way, self._reach)
        return self.goal

    def _unseen(self, costs: Costmap, way: Floats) -> tuple[Cells, Floats]:
        """Return the reachable cells worth a look (n, 2), and their path lengths (n,) [m]."""
        rows, columns = np.nonzero(np.isfinite(way) & (costs.cost < LETHAL) & (costs.cells >= 0))
        points = costs.points(rows, columns)
        cells, first = np.unique(
            np.floor(points / CELL_M).astype(np.int64), axis=0, return_index=True
        )
        new = np.array([tuple(cell) not in self._seen for cell in cells.tolist()], np.bool_)
        cells, paths_m = cells[new], way[rows[first[new]], columns[first[new]]]
        if not len(cells):
            return cells, paths_m
        crowded = _crowded(cells)
        return cells[crowded], paths_m[crowded]


def _crowded(cells: Cells) -> NDArray[np.bool_]:
    """Return which cells (n, 2) have enough neighbours among them, as a mask (n,)."""
    low = cells.min(axis=0)
    grid = np.zeros(cells.max(axis=0) - low + 5, np.int64)
    i, j = (cells - low + 2).T
    grid[i, j] = 1
    reach = round(NEIGHBOURS_M / CELL_M)
    steps = range(-reach, reach + 1)
    counts = sum(grid[i + di, j + dj] for di in steps for dj in steps)
    return np.asarray(counts > MIN_NEIGHBOURS)


def _in_view(costs: Costmap, camera: Camera, here: Pose, reach: float) -> Cells:
    """Return the cells (n, 2) that a camera sees well, within `reach` [m] of a body at `here`."""
    cos, sin = math.cos(here.yaw), math.sin(here.yaw)
    eye = np.array(
        (here.x + cos * camera.x - sin * camera.y, here.y + sin * camera.x + cos * camera.y)
    )
    count = math.ceil(reach / CELL_M)
    middle = np.floor(eye / CELL_M).astype(np.int64)
    steps = np.arange(-count, count + 1)
    cells = (np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2) + middle).astype(np.int64)
    off = (cells + 0.5) * CELL_M - eye
    far = np.hypot(*off.T)
    fx, _, _, _ = camera.pinhole
    half = math.atan2(camera.width / 2, fx) - EDGE_RAD
    axis = here.yaw + camera.yaw
    turn = np.abs(np.remainder(np.arctan2(off[:, 1], off[:, 0]) - axis + np.pi, 2 * np.pi) - np.pi)
    cells = cells[(far <= reach) & ((turn <= half) | (far < OWN_GROUND_M))]
    found: Cells = cells[in_sight(costs, eye, (cells + 0.5) * CELL_M, CELL_M)]
    return found


def _viewpoint(
    costs: Costmap,
    body: BodyDescription,
    here: Pose,
    aim: Floats,
    spots: Floats,
    way: Floats,
    reach: float,
) -> Goal:
    """Return the place to look at `aim` (2,) from, with the lowest path cost per seen spot.

    It sees the `spots` (n, 2) within `reach` [m].
    """
    eye = np.array((here.x, here.y))
    distance = math.hypot(*(aim - eye).tolist())
    can_turn = body.turning_radius == 0.0  # on the spot
    if can_turn and MIN_RANGE_M <= distance <= reach and in_sight(costs, eye, aim[None], CELL_M)[0]:
        return Goal(x=here.x, y=here.y, yaw=_facing(body, eye, aim, spots, reach)[0])
    angles = np.linspace(0.0, math.tau, VIEWPOINTS, endpoint=False)
    ring = np.column_stack((np.cos(angles), np.sin(angles)))
    places = [
        aim,
        *(
            aim + distance * direction
            for distance in np.linspace(MIN_RANGE_M, reach - RANGE_MARGIN_M, 4)
            for direction in ring
        ),
    ]
    best, min_cost = aim, math.inf
    for k, place in enumerate(places):
        cell = costs.cell(*place.tolist())
        if cell is None or costs.cost[cell] >= LETHAL or not math.isfinite(way[cell]):
            continue
        if k and not in_sight(costs, place, aim[None], CELL_M)[0]:
            continue
        seen = _facing(body, place, aim, spots, reach)[1]
        cost = (float(way[cell]) + LOOK_COST_M) / (seen + 1)
        if cost < min_cost:
            best, min_cost = place, cost
    x, y = best.tolist()
    return Goal(x=x, y=y, yaw=_facing(body, best, aim, spots, reach)[0] if can_turn else None)


def _facing(
    body: BodyDescription, eye: Floats, aim: Floats, spots: Floats, reach: float
) -> tuple[float, int]:
    """Return the heading that shows `aim` and most of the `spots`, and the number of spots."""
    camera = body.fixed_cameras[0]
    half = math.atan2(camera.width / 2, camera.pinhole[0]) - EDGE_RAD
    off = spots - eye
    bearings = np.arctan2(off[:, 1], off[:, 0])[np.hypot(*off.T) <= reach]
    ahead = math.atan2(*(aim - eye)[::-1].tolist())
    options = ahead + half * np.array((0.0, 0.4, -0.4, 0.8, -0.8))
    turns = np.abs(np.remainder(bearings[None, :] - options[:, None] + np.pi, 2 * np.pi) - np.pi)
    counts = (turns <= half).sum(axis=1)
    best = int(np.argmax(counts))
    return math.remainder(float(options[best]) - camera.yaw, math.tau), int(counts[best])
