"""Global planner: paths to goals over the whole map, and frontiers to explore."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.kernels.images import OCCUPIED_PERCENT, Ints, connected_parts
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap, Inflation
from gigabrain_zenoh.navigation.costmap import costmap as make_costmap
from gigabrain_zenoh.navigation.grid_search import (
    GridSearch,
    costs_to_go,
    is_free,
    smooth_path,
)

MAX_POINT_SPACING_M = 0.1  # between points of a path
MAX_STRAY_M = 0.5  # distance from its path beyond which the robot gets a new one
SWITCH_COST_RATIO = 0.85  # of the present path's cost, which a new path must be below
LONG_PATH_M = 20.0  # from this length on, a blocked path gets a detour instead of a new search
DETOUR_M = 3.0  # margin of the searched part of the map around the blocked part of a path
MAX_DETOUR_M = 15.0  # length of a path that a detour replaces
MAX_CELL_PATH_RATIO = math.sqrt(4 - 2 * math.sqrt(2))  # of steps between cells to a straight line
Point = tuple[float, float]  # [m], in the map's frame
NO_WAY = "no path leads to the goal"

BLACKLIST_RADIUS_M = 0.5  # frontiers nearer to a blacklisted point are ignored
SIZE_GAIN = 1.0  # metres of path that a metre of frontier is worth
MAX_SIZE_M = 4.0  # a larger frontier counts as this size


@dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """A path to a goal, in the map's frame."""

    points: Floats  # (n, 2) [m], from the robot to the goal
    remaining: Floats  # (n,) [m], distance from each point to the goal
    cost: Floats  # (n,) [m in the open], cost from each point to the goal
    headings: Floats | None = None
    # (n, 2), of a car: its heading [rad], and 1 if it arrives forwards, -1 in reverse


@dataclass(frozen=True, kw_only=True)
class Unreachable:
    """The reason why a goal is unreachable, and the nearest reachable place."""

    fault: str  # text for people, without the nearest place
    nearest: Point | None = None
    distance: float = math.inf  # [m], from the nearest place to the goal

    @property
    def reason(self) -> str:
        """The fault and the nearest reachable place, as text."""
        if self.nearest is None:
            return self.fault
        where = f"{self.distance:.2f} m away at ({self.nearest[0]:.2f}, {self.nearest[1]:.2f})"
        return f"{self.fault}; nearest reachable point is {where}"


class GlobalPlanner:
    """Plans with the same buffers each time. It is not thread-safe."""

    def __init__(self) -> None:
        self.search = GridSearch()
        self._nearby = GridSearch()  # for parts of the map

    def plan(self, costmap: Costmap, start: Point, goal: Point) -> Path | Unreachable:
        """Return the cheapest path from `start` to `goal`, or why none exists."""
        if not all(math.isfinite(value) for value in (*start, *goal)):
            return Unreachable(fault="the goal and the robot's place must be finite numbers")
        begin, end = costmap.cell(*start), costmap.cell(*goal)
        if begin is None:
            return Unreachable(fault="the robot is outside the map")
        fault = goal_problem(costmap, goal)
        if fault or end is None:
            self.search.reach(costmap.cost, begin, costmap.against)
            return self._nearest(costmap, goal, fault)
        cells = self.search.path(costmap.cost, begin, end, costmap.against)
        if cells is None:
            return self._nearest(costmap, goal, NO_WAY)
        return _path(costmap, _smoothed(costmap, cells, np.array((start, goal))))

    def replan(self, costmap: Costmap, start: Point, goal: Point, path: Path) -> Path | Unreachable:
        """Return the rest of `path` if it is free and no path is much cheaper, else a new path.

        A long path that is blocked gets a detour, if no path is much cheaper.
        """
        rest = remaining_path(path, costmap, start)
        if rest is None or tuple(path.points[-1]) != goal:
            return self.plan(costmap, start, goal)
        free = is_valid(rest, costmap)
        kept = rest if free else self._detour(costmap, rest)
        if kept is None:
            return self.plan(costmap, start, goal)
        switch_cost = SWITCH_COST_RATIO * kept.cost[0]
        if self._costs_at_least(switch_cost, costmap, start, goal):
            return kept
        found = self.plan(costmap, start, goal)
        better = isinstance(found, Path) and found.cost[0] < switch_cost
        return found if better or not free else kept

    def field(self, costmap: Costmap, goal: Point) -> Floats | None:
        """Return the cost from each cell to `goal`, (height, width) [m in the open].

        It is None for a goal outside the map, and inf where no path leads to it.
        """
        cell = costmap.cell(*goal)
        if cell is None:
            return None
        return self.search.field(costmap.cost, cell, "to", costmap.against) * costmap.resolution

    def _detour(self, costmap: Costmap, path: Path) -> Path | None:
        """Return a long path with a detour round its blocked part; None if none is found nearby."""
        stretch = _blocked_stretch(costmap, path)
        if stretch is None:
            return None
        begin, end = stretch
        margin = math.ceil(DETOUR_M / costmap.resolution)
        along = _cells_of(costmap, path.points[begin : end + 1])
        low, high = (along.min(axis=0) - margin).clip(0), along.max(axis=0) + margin
        part = slice(low[0], high[0]), slice(low[1], high[1])
        against = np.ascontiguousarray(costmap.against[part])
        (row, column), (to_row, to_column) = (along[[0, -1]] - low).tolist()
        cells = self._nearby.path(costmap.cost[part], (row, column), (to_row, to_column), against)
        if cells is None:
            return None
        corners = _smoothed(costmap, cells + low, path.points[[begin, end]])
        points = np.vstack((path.points[:begin], corners, path.points[end + 1 :]))
        detour = _path(costmap, points)
        return detour if is_valid(detour, costmap) else None

    def _costs_at_least(self, least: float, costmap: Costmap, start: Point, goal: Point) -> bool:
        """Return whether bounds show that no path costs less than `least` [m in the open]."""
        begin, end = costmap.cell(*start), costmap.cell(*goal)
        if begin is None or end is None:
            return False
        ends = float(costmap.cost[begin] + costmap.cost[end])  # from start and goal to cell centres
        cells = least / costmap.resolution * MAX_CELL_PATH_RATIO + ends
        return self.search.costs_at_least(cells, costmap.cost, begin, end)

    def _nearest(self, costmap: Costmap, goal: Point, why: str) -> Unreachable:
        """Return the cell of the last search that is nearest to `goal`, with the reason `why`."""
        column, row = _in_cells(costmap, np.array((goal,)))[0] - 0.5
        cell = self.search.nearest(costmap.cost, row, column)
        if cell is None:
            return Unreachable(fault=f"{why}; the robot has no room to move from its place")
        x, y = costmap.points(np.array(cell[:1]), np.array(cell[1:]))[0]
        away = math.hypot(x - goal[0], y - goal[1])
        return Unreachable(fault=why, nearest=(float(x), float(y)), distance=away)


def _blocked_stretch(costmap: Costmap, path: Path) -> tuple[int, int] | None:
    """Return the first and last point of the stretch that a detour replaces; None without one."""
    if path.remaining[0] < LONG_PATH_M:
        return None
    rows, columns = _cells_of(costmap, path.points).T
    blocked = path.remaining[costmap.cost[rows, columns] >= LETHAL]
    if not len(blocked):  # it is blocked between two points
        return None
    before = int(np.count_nonzero(path.remaining >= blocked[0] + DETOUR_M))
    until = int(np.count_nonzero(path.remaining > blocked[-1] - DETOUR_M))
    begin, end = max(before - 1, 0), min(until, len(rows) - 1)
    far = path.remaining[begin] - path.remaining[end] > MAX_DETOUR_M
    return None if far else (begin, end)


def _cells_of(costmap: Costmap, points: Floats) -> NDArray[np.intp]:
    """Return rows and columns (n, 2) of points (n, 2) [m], limited to the map."""
    inside = np.array(costmap.cost.shape) - 1
    return _in_cells(costmap, points)[:, ::-1].astype(np.intp).clip(0, inside)


def _smoothed(costmap: Costmap, cells: NDArray[np.integer], ends: Floats) -> Floats:
    """Return the corners (n, 2) [m] of a path over `cells` (m, 2), from `ends[0]` to `ends[1]`."""
    places = np.column_stack((cells[:, 1] + 0.5, cells[:, 0] + 0.5))
    places = np.vstack((places[:1], places)) if len(places) == 1 else places
    places[[0, -1]] = _in_cells(costmap, ends)
    corners = _in_metres(costmap, smooth_path(costmap.cost, places, costmap.against))
    corners[[0, -1]] = ends  # without rounding errors
    return corners


def is_valid(path: Path, costmap: Costmap) -> bool:
    """Return whether all of `path` is still free."""
    return is_free(costmap.cost, _in_cells(costmap, path.points), costmap.against)


def remaining_path(path: Path, costmap: Costmap, start: Point) -> Path | None:
    """Return the rest of `path` from the robot on; None if the robot is too far from it."""
    begin, end = path.points[:-1], path.points[1:]
    along = end - begin
    lengths = (along**2).sum(axis=1)
    share = ((start - begin) * along).sum(axis=1) / np.where(lengths > 0, lengths, 1.0)
    beside = begin + share.clip(0, 1)[:, np.newaxis] * along
    away = np.hypot(*(beside - start).T)
    at = int(away.argmin())
    if away[at] > MAX_STRAY_M:
        return None
    return _path(costmap, np.vstack((start, path.points[at + 1 :])))


def warm_up() -> None:
    """Compile all kernels of planning. It takes seconds, unless they are cached."""
    cells = np.zeros((40, 40), np.int8)
    rules = Inflation(fits=0.1, turns=0.2)
    planner = GlobalPlanner()
    grid = OccupancyGrid(
        resolution=0.1, width=40, height=40, origin_x=0.0, origin_y=0.0, cells=cells.tobytes()
    )
    before = make_costmap(grid, rules)
    now = make_costmap(grid, rules, np.array([[3.9, 3.9]]), before)
    path = planner.plan(now, (0.1, 0.1), (1.0, 0.1))
    if isinstance(path, Path):
        planner.replan(now, (0.1, 0.1), (1.0, 0.1), path)
    planner.plan(now, (0.1, 0.1), (3.9, 3.9))
    planner.field(now, (0.1, 0.1))
    frontiers(now, (0.1, 0.1), (), GridSearch())


def goal_problem(costmap: Costmap, goal: Point) -> str:
    """Return why the body cannot be at the goal, or an empty text."""
    cell = costmap.cell(*goal)
    if cell is None:
        return "the goal is outside the map"
    if costmap.cells[cell] >= OCCUPIED_PERCENT:
        return "the goal is inside an obstacle"
    if costmap.cost[cell] >= LETHAL and (problem := costmap.zone_problem(*goal)):
        return f"the goal {problem}"
    if costmap.cost[cell] > LETHAL:
        fits = costmap.inflation.fits
        return f"the goal is too close to an obstacle: the body needs {fits:.2f} m"
    if costmap.cost[cell] == LETHAL:
        return "the goal is in unknown space, which is forbidden"
    return ""


def _path(costmap: Costmap, corners: Floats) -> Path:
    """Return the path of straight lines between `corners` (n, 2) [m]."""
    points = _resampled(corners)
    steps = np.hypot(*np.diff(points, axis=0).T)
    remaining = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    cost = (
        costs_to_go(costmap.cost, _in_cells(costmap, points), costmap.against) * costmap.resolution
    )
    return Path(points=points, remaining=remaining, cost=cost)


def _resampled(corners: Floats) -> Floats:
    """Return points (n, 2) along straight lines, including all corners."""
    lengths = np.hypot(*np.diff(corners, axis=0).T)
    counts = np.maximum(np.ceil(lengths / MAX_POINT_SPACING_M).astype(np.intp), 1)
    first = np.concatenate(([0], np.cumsum(counts)))
    at = np.arange(first[-1] + 1)
    return np.column_stack([np.interp(at, first, values) for values in corners.T])


def _in_cells(costmap: Costmap, points: Floats) -> Floats:
    cells: Floats = (points - (costmap.origin_x, costmap.origin_y)) / costmap.resolution
    return cells


def _in_metres(costmap: Costmap, places: Floats) -> Floats:
    points: Floats = places * costmap.resolution + (costmap.origin_x, costmap.origin_y)
    return points


@dataclass(frozen=True, kw_only=True)
class Frontier:
    """A border of known space, at least as wide as the body, reachable through known space."""

    x: float  # [m], of the cell nearest to the middle
    y: float  # [m]
    size: float  # [m]
    cost: float  # [m in the open], from the robot

    @property
    def score(self) -> float:
        """The cost minus the gain; lower is better."""
        return self.cost - SIZE_GAIN * min(self.size, MAX_SIZE_M)


def frontiers(
    costmap: Costmap, robot: Point, blacklist: Iterable[Point], search: GridSearch
) -> list[Frontier]:
    """Return all reachable frontiers that are wide enough, except those near the blacklist.

    The blacklist holds places that the robot could not reach, and visited places where unknown
    space remains.
    """
    start = costmap.cell(*robot)
    if start is None:
        return []
    known = np.where(costmap.cells < 0, np.float32(LETHAL), costmap.cost)
    way = search.field(known, start, "from", costmap.against) * costmap.resolution
    edge = _frontier_cells(costmap.cells) & (known < LETHAL) & np.isfinite(way)
    for x, y in blacklist:
        _erase_around(edge, costmap, x, y)
    cells, begins = connected_parts(edge)
    found = []
    for begin, end in pairwise(begins.tolist()):
        size = (end - begin) * costmap.resolution
        if size >= 2 * costmap.inflation.fits:
            rows, columns = np.divmod(np.sort(cells[begin:end]), edge.shape[1])
            found.append(_frontier(costmap, way, rows, columns, size))
    return found


def _frontier(
    costmap: Costmap,
    way: Floats,
    rows: Ints,
    columns: Ints,
    size: float,
) -> Frontier:
    best = int(np.hypot(columns - columns.mean(), rows - rows.mean()).argmin())
    x, y = costmap.points(rows[best : best + 1], columns[best : best + 1])[0]
    return Frontier(x=float(x), y=float(y), size=size, cost=float(way[rows[best], columns[best]]))


def _frontier_cells(cells: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Return the known cells next to an unknown one; outside the map counts as unknown."""
    unknown = np.pad(cells < 0, 1, constant_values=True)
    beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    edge: NDArray[np.bool_] = beside & (cells >= 0)
    return edge


def _erase_around(edge: NDArray[np.bool_], costmap: Costmap, x: float, y: float) -> None:
    radius = BLACKLIST_RADIUS_M / costmap.resolution
    column = (x - costmap.origin_x) / costmap.resolution - 0.5
    row = (y - costmap.origin_y) / costmap.resolution - 0.5
    top, left = max(int(row - radius), 0), max(int(column - radius), 0)
    part = edge[top : max(int(row + radius) + 2, 0), left : max(int(column + radius) + 2, 0)]
    rows, columns = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
    part &= np.hypot(rows - row, columns - column) > radius
