"""`gigabrain bench plan`: times costmaps, plans and replans, and checks that paths are optimal."""

import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path as File
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.navigation.block_bounds import Ints
from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap, Costs, Inflation, costmap
from gigabrain_zenoh.navigation.global_planner import GlobalPlanner, Path, Point, warm_up
from gigabrain_zenoh.navigation.grid_search import GridSearch
from gigabrain_zenoh.qa.bench.slam_logs import draw_side_by_side

if TYPE_CHECKING:
    from matplotlib.axes import Axes

RULES = Inflation(fits=0.2, turns=0.3)
ROUNDS = 7  # of each operation on the same map
GOALS = 4  # per start; they share its Dijkstra field
COST_SHARE, SPREAD = 0.75, 0.1  # cost of a path as a share of the map's side, and its tolerance


RESOLUTION = 0.05  # [m]
DENSITY = 0.2  # of the random map
PITCH, ROOM, WALL, DOOR = 240, 96, 2, 20  # [cells]; four rooms and two corridors per PITCH
FURNITURE = 3  # pieces per room
OBJECT_CELLS = 10  # per side
POINTS_PER_M = 10  # on a path
Cells = NDArray[np.int8]


class Timing(Struct, frozen=True, kw_only=True):
    """Times of one operation."""

    what: str
    n: int
    p50_ms: float
    p95_ms: float
    cpu_p50_ms: float


class SizeFigures(Struct, frozen=True, kw_only=True):
    """Figures of one size of map."""

    size: int  # cells per side
    path_m: float  # mean length of the paths
    timings: tuple[Timing, ...]
    ratio: float  # worst ratio of A*'s cost to Dijkstra's; 1 is optimal


class PlanResult(Struct, frozen=True, kw_only=True):
    """Figures of all sizes."""

    seed: int
    sizes: tuple[SizeFigures, ...]

    @property
    def ok(self) -> bool:
        """True if every path is optimal."""
        return all(abs(one.ratio - 1) < 1e-6 for one in self.sizes)


class Query(NamedTuple):
    """A start and a goal, and the cost of Dijkstra's path."""

    begin: tuple[int, int]  # row, column
    end: tuple[int, int]
    start: Point
    goal: Point
    cheapest: float


class OperationTimer:
    """Measures each run of a `with` block."""

    def __init__(self) -> None:
        self.wall_ms: list[float] = []
        self.cpu_ms: list[float] = []

    def __enter__(self) -> None:
        self._wall, self._cpu = time.perf_counter(), time.thread_time()

    def __exit__(self, *_: object) -> None:
        self.wall_ms.append((time.perf_counter() - self._wall) * 1e3)
        self.cpu_ms.append((time.thread_time() - self._cpu) * 1e3)

    def timing(self, what: str) -> Timing:
        """Return the figures so far."""
        wall, cpu = sorted(self.wall_ms), sorted(self.cpu_ms)
        return Timing(
            what=what,
            n=len(wall),
            p50_ms=round(percentile(wall, 0.5) or 0.0, 2),
            p95_ms=round(percentile(wall, 0.95) or 0.0, 2),
            cpu_p50_ms=round(percentile(cpu, 0.5) or 0.0, 2),
        )


def measure_plan(
    sizes: tuple[int, ...],
    queries: int,
    seed: int,
    png: File | None,
    show: Callable[[str], None],
) -> PlanResult:
    """Measure maps of these sizes [cells]; draw the last one into `png`. Raises ConfigError."""
    warm_up()
    figures = []
    for size in sizes:
        show(f"{size} x {size} cells")
        one, map_costs, paths = _measure(size, queries, np.random.default_rng(seed))
        figures.append(one)
    if png is not None:
        draw_side_by_side([(map_costs, paths)], 1, _draw, png)
    return PlanResult(seed=seed, sizes=tuple(figures))


def _measure(
    size: int, queries: int, rng: np.random.Generator
) -> tuple[SizeFigures, Costmap, list[Path]]:
    cells = office(size, rng)
    grid, planner = grid_of(cells), GlobalPlanner()
    map_costs = costmap(grid, RULES)
    whole, changed, first = OperationTimer(), OperationTimer(), OperationTimer()
    query_list = list(itertools.islice(_queries(map_costs, planner.search, rng), queries))
    for i in range(ROUNDS):
        with whole:
            costmap(grid, RULES)
        now = grid_of(with_new_furniture(cells, rng))
        with changed:
            costmap(now, RULES, None, map_costs)
        one = query_list[i % len(query_list)]
        with first:
            planner.plan(costmap(now, RULES, None, map_costs), one.start, one.goal)
    searching, planning, ratios, paths = OperationTimer(), OperationTimer(), [], []
    for one in query_list:
        with searching:
            cells_on = planner.search.path(map_costs.cost, one.begin, one.end)
        ratios.append(_path_cost(map_costs.cost, cells_on) / one.cheapest)
        with planning:
            found = planner.plan(map_costs, one.start, one.goal)
        paths += [found] if isinstance(found, Path) else []
    timings = (
        whole.timing("costs of the whole map"),
        changed.timing("costs after a change"),
        first.timing("costs after a change, and a plan"),
        searching.timing("optimal path, office"),
        planning.timing("the same, pulled tight"),
        *_time_replanning(map_costs, cells, paths, rng.spawn(1)[0]),
        *_corner_to_corner(size, rng, ratios),
    )
    length = float(np.mean([one.remaining[0] for one in paths]))
    worst = max(ratios, key=lambda ratio: abs(ratio - 1))
    return SizeFigures(size=size, path_m=length, timings=timings, ratio=worst), map_costs, paths


def _time_replanning(
    map_costs: Costmap, cells: Cells, paths: list[Path], rng: np.random.Generator
) -> tuple[Timing, Timing]:
    """Time from a new map to the path, like decision: a change is elsewhere, or on the path.

    The robot is a metre along its path. An object appears, and disappears again.
    """
    planner, elsewhere, ahead = GlobalPlanner(), OperationTimer(), OperationTimer()
    costs = replace(map_costs, cost=map_costs.cost.copy())  # it is updated in place
    for old in paths:
        here, goal = _point(old, POINTS_PER_M), _point(old, -1)
        planner.replan(costs, _point(old, 0), goal, old)
        for timer, changed in (
            (elsewhere, with_new_furniture(cells, rng)),
            (ahead, _with_obstacle_on(map_costs, cells, old, rng)),
        ):
            for cells_now, timed in ((changed, timer), (cells, elsewhere)):
                grid = grid_of(cells_now)
                with timed:
                    costs = costmap(grid, RULES, None, costs, reuse=True)
                    planner.replan(costs, here, goal, old)
    return elsewhere.timing("replanned after a change"), ahead.timing("the same, on its path")


def _point(path: Path, number: int) -> Point:
    x, y = path.points[number].tolist()
    return x, y


def _with_obstacle_on(
    map_costs: Costmap, cells: Cells, path: Path, rng: np.random.Generator
) -> Cells:
    """Return the map with an object of 0.5 m in the middle half of a path."""
    count = len(path.points)
    at = map_costs.cell(*_point(path, int(rng.integers(count // 4, 3 * count // 4))))
    assert at
    return _with_object(cells, max(at[0] - OBJECT_CELLS // 2, 0), max(at[1] - OBJECT_CELLS // 2, 0))


def _queries(map_costs: Costmap, search: GridSearch, rng: np.random.Generator) -> Iterator[Query]:
    """Yield starts and goals with a path of about the wanted cost, by Dijkstra."""
    wanted = COST_SHARE * len(map_costs.cost)
    open_ = np.argwhere(map_costs.cost < 2)
    while True:
        begin = _cell(open_[rng.integers(len(open_))])
        field = search.field(map_costs.cost, begin, "from")
        far = np.argwhere((np.abs(field / wanted - 1) < SPREAD) & (map_costs.cost < 2))
        for _ in range(GOALS if len(far) else 0):
            end = _cell(far[rng.integers(len(far))])
            start, goal = _cell_middle(map_costs, begin), _cell_middle(map_costs, end)
            yield Query(begin, end, start, goal, float(field[end]))


def _cell(at: NDArray[np.intp]) -> tuple[int, int]:
    return int(at[0]), int(at[1])


def _cell_middle(map_costs: Costmap, cell: tuple[int, int]) -> Point:
    x, y = map_costs.points(np.array(cell[:1]), np.array(cell[1:]))[0].tolist()
    return x, y


def _corner_to_corner(
    size: int, rng: np.random.Generator, ratios: list[float]
) -> tuple[Timing, Timing]:
    """Time A* and Dijkstra on a random map; append the ratio of their costs to `ratios`."""
    cost, search, one, all_ = scattered(size, rng), GridSearch(), OperationTimer(), OperationTimer()
    goal = (size - 1, size - 1)
    for _ in range(ROUNDS):
        with one:
            cells = search.path(cost, (0, 0), goal)
        with all_:
            field = search.field(cost, (0, 0), "from")
    ratios.append(_path_cost(cost, cells) / float(field[goal]))
    return one.timing("optimal path, random map, corner to corner"), all_.timing(
        "Dijkstra of it all"
    )


def _path_cost(cost: Costs, cells: Ints | None) -> float:
    """Return the cost of a path along cells (n, 2); inf without a path."""
    if cells is None:
        return float("inf")
    on = cost[cells[:, 0], cells[:, 1]].astype(np.float64)
    return float((np.hypot(*np.diff(cells, axis=0).T) * (on[1:] + on[:-1]) / 2).sum())


def _draw(axes: "Axes", drawn: tuple[Costmap, list[Path]]) -> None:
    """Draw costs, dark where high, and paths in colours."""
    map_costs, paths = drawn
    grey = 255 - 12 * map_costs.cost.clip(1, 14)
    grey[map_costs.cells > 0] = 0
    height, width = (side * map_costs.resolution for side in grey.shape)
    axes.imshow(grey, "gray", origin="lower", extent=(0.0, width, 0.0, height))
    for number, path in enumerate(paths, 1):
        axes.plot(*path.points.T, label=f"path {number}")


def office(size: int, rng: np.random.Generator) -> Cells:
    """Return rooms of 4.8 m with a door of 1 m each, furniture, and corridors of 2.4 m."""
    cells = np.zeros((size, size), np.int8)
    for top in range(0, size, PITCH):
        for left in range(0, size, PITCH):
            for down, right in ((0, 0), (0, ROOM), (ROOM, 0), (ROOM, ROOM)):
                _add_room(
                    cells[top + down : top + down + ROOM, left + right : left + right + ROOM], rng
                )
    cells[:WALL] = cells[-WALL:] = cells[:, :WALL] = cells[:, -WALL:] = 100
    return cells


def _add_room(room: Cells, rng: np.random.Generator) -> None:
    """Add walls, doors and furniture to a part of a map."""
    room[:WALL] = room[-WALL:] = room[:, :WALL] = room[:, -WALL:] = 100
    for side in (room[:WALL], room[-WALL:], room[:, :WALL].T, room[:, -WALL:].T):
        door = rng.integers(WALL, ROOM - DOOR - WALL)
        if rng.random() < 0.7:
            side[:, door : door + DOOR] = 0
    for _ in range(FURNITURE):
        row, column = rng.integers(20, ROOM - 36, 2)
        height, width = rng.integers(6, 16, 2)
        room[row : row + height, column : column + width] = 100


def scattered(size: int, rng: np.random.Generator) -> Costs:
    """Return a random map of free and lethal cells, with free corners."""
    taken = rng.random((size, size)) < DENSITY
    taken[:3, :3] = taken[-3:, -3:] = False
    return np.where(taken, np.float32(2 * LETHAL), np.float32(1))


def with_new_furniture(cells: Cells, rng: np.random.Generator) -> Cells:
    """Return the map with one more piece of furniture."""
    row, column = rng.integers(0, len(cells) - OBJECT_CELLS, 2)
    return _with_object(cells, int(row), int(column))


def _with_object(cells: Cells, row: int, column: int) -> Cells:
    now = cells.copy()
    now[row : row + OBJECT_CELLS, column : column + OBJECT_CELLS] = 100
    return now


def grid_of(cells: Cells) -> OccupancyGrid:
    """Return the map as a message."""
    height, width = cells.shape
    return OccupancyGrid(
        resolution=RESOLUTION,
        width=width,
        height=height,
        origin_x=0.0,
        origin_y=0.0,
        cells=cells.tobytes(),
    )
