"""Cheapest paths over a cost grid, eight-connected (A*, Dijkstra), and their smoothing.

A step costs its length in cells times the mean cost of both cells. Corners are not cut. From cells
of cost LETHAL or more a path may only lead to lower cost, so that a body too close to an obstacle
can leave. One-way lanes forbid some of the eight ways in their cells. The bounds of `block_bounds`
guide A*. Open cells are in buckets by total cost, which takes half the time of a heap. Smoothing
uses straight lines that cost no more than the cells.
"""

import math
from typing import Literal, NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import NONE, kernel, lean_kernel
from gigabrain_zenoh.navigation.block_bounds import (
    COLUMN_STEPS,
    DIAGONAL,
    NOWHERE,
    ROW_STEPS,
    BlockBounds,
    Cell,
    Ints,
    block_bounds,
    bound_after_changes,
    bound_at,
    towards,
)
from gigabrain_zenoh.navigation.costmap import LETHAL, NO_LANES, Costs, WayBits

HALF_LENGTHS = (0.5, DIAGONAL / 2) * 4  # of a step, by way
MAX_BEND = 2  # ways to either side of the last step; sharper bends are never cheaper
BUCKETS_PER_COST = 24.0  # buckets for a cost of 1
BUCKETS = 8192  # in a ring that is longer than the most expensive step
SUM_TOLERANCE = 1e-10  # above the rounding errors of sums in another order
SPARE_ENTRIES = 1024
ROOT_MARK = 8  # mark of the start; other cells have the way of their last step, 0 to 7
SETTLED_MARK = 16  # added for settled cells
RUN_STRIDE = 32  # times the number of the search, added for all cells of that search
LAST_RUN = np.iinfo(np.int32).max // RUN_STRIDE - 1  # largest number of a search in a mark
OUT_OF_ENTRIES = -1  # result of a search that needs more entries
NO_TARGET = (NOWHERE, NOWHERE)
Direction = Literal["from", "to"]

CORNER = 1e-6  # [cells], a line with less than this inside a cell only touches its corner
SAME_WAY = 1e-6  # tolerance of a direction, in steps of 45 degrees
STRAIGHT_TOLERANCE = 1 + 1e-9  # so that straight lines win at equal cost


class SearchMemory(NamedTuple):
    """Buffers of a search."""

    g: Floats  # by cell, the cost from the start
    mark: Ints  # by cell, see ROOT_MARK
    first: Ints  # by bucket, the entry on top
    entries: Ints  # (3, n): row, column, and the entry below


class GridSearch:
    """Searches with the same buffers each time. It is not thread-safe."""

    def __init__(self) -> None:
        self._shape = (0, 0)
        self._run_number = 0
        none, first = np.empty(0, np.int32), np.empty(BUCKETS, np.int32)
        self._memory = SearchMemory(np.empty(0), none, first, np.empty((3, 0), np.int32))
        self._bound = block_bounds(self._shape)

    def path(
        self, cost: Costs, start: Cell, goal: Cell, against: WayBits = NO_LANES
    ) -> Ints | None:
        """Return the cheapest path from cell to cell (row, column), (n, 2); None without one.

        Here and below, `against` holds the ways that lanes forbid.
        """
        target = goal[0] * cost.shape[1] + goal[1]
        self._run(cost, start, goal, against, reverse=False)
        if self._memory.mark[target] < RUN_STRIDE * self._run_number + SETTLED_MARK:
            return None
        cells = _trace(self._memory.mark, cost.shape[1], target)
        return np.column_stack(np.divmod(cells, np.int32(cost.shape[1])))

    def field(self, cost: Costs, cell: Cell, way: Direction, against: WayBits = NO_LANES) -> Floats:
        """Return the cost of the cheapest paths "to" `cell` or "from" it; inf without one.

        The shape is (height, width). Times the resolution, a cost is in metres at cost 1.
        """
        self._run(cost, cell, NO_TARGET, against, reverse=way == "to")
        field = np.where(
            self._memory.mark >= RUN_STRIDE * self._run_number + SETTLED_MARK,
            self._memory.g,
            np.inf,
        )
        return field.reshape(cost.shape)

    def costs_at_least(self, least: float, cost: Costs, start: Cell, goal: Cell) -> bool:
        """Return whether bounds show that a path costs `least` or more, without a search."""
        if cost.shape != self._shape:
            self._allocate(cost.shape)
        cost = np.ascontiguousarray(cost)
        if self._bound.goal == goal and bound_after_changes(self._bound, cost, start) >= least:
            return True
        self._bound = towards(goal, start, cost, self._bound)
        return bound_at(self._bound, cost, *start) >= least

    def reach(self, cost: Costs, start: Cell, against: WayBits = NO_LANES) -> None:
        """Search all cells that are reachable from `start`, for a following call of `nearest`."""
        self._run(cost, start, NO_TARGET, against, reverse=False)

    def nearest(self, cost: Costs, row: float, column: float) -> Cell | None:
        """Return the nearest cell that the last search reached, and in which the body fits."""
        found = _nearest(
            cost,
            self._memory.mark,
            RUN_STRIDE * self._run_number + SETTLED_MARK,
            self._memory.g,
            row,
            column,
        )
        return None if found == NOWHERE else divmod(found, cost.shape[1])

    def _run(
        self, cost: Costs, start: Cell, target: Cell, against: WayBits, *, reverse: bool
    ) -> None:
        if cost.shape != self._shape:
            self._allocate(cost.shape)
        cost = np.ascontiguousarray(cost)
        if target != NO_TARGET:
            self._bound = towards(target, start, cost, self._bound)
        while True:
            if self._run_number >= LAST_RUN:
                self._memory.mark[:] = self._run_number = 0
            self._run_number += 1
            run_mark = RUN_STRIDE * self._run_number
            found = _search(
                cost, against, start, target, reverse, run_mark, self._memory, self._bound
            )
            if found != OUT_OF_ENTRIES:
                return
            more = np.empty((3, 2 * self._memory.entries.shape[1]), np.int32)
            self._memory = self._memory._replace(entries=more)

    def _allocate(self, shape: tuple[int, ...]) -> None:
        """Allocate buffers for a grid. Pages that no search reaches take no memory."""
        size = shape[0] * shape[1]
        self._shape, self._run_number = (shape[0], shape[1]), 0
        self._bound = block_bounds(shape)
        entries = np.empty((3, size + SPARE_ENTRIES), np.int32)
        self._memory = SearchMemory(
            np.empty(size), np.zeros(size, np.int32), self._memory.first, entries
        )


@kernel
def _search(
    cost: Costs, against: WayBits, start: Cell, target: Cell, reverse: bool, run_mark: int,
    memory: SearchMemory, bound: BlockBounds,
) -> int:  # fmt: skip
    """Settle cells until no path to `target` is cheaper; return their number or OUT_OF_ENTRIES."""
    (height, width), flat, (g, mark, first, entries) = cost.shape, cost.ravel(), memory
    lanes = against.ravel()
    first[:] = NOWHERE
    at, best = start[0] * width + start[1], np.inf  # cost of the best path to `target` so far
    g[at], mark[at] = 0.0, run_mark + ROOT_MARK
    now = int(_bound(bound, cost, start[0], start[1], target) * BUCKETS_PER_COST)
    _push(first, entries, int(NONE), now, 0.0, start[0], start[1])
    free, used, count, settled = NOWHERE, 1, 1, 0
    while count:
        top = first[now % BUCKETS]
        if top == NOWHERE:
            now += 1
            continue
        row, column, first[now % BUCKETS] = entries[0, top], entries[1, top], entries[2, top]
        entries[2, top], free, count, cell = free, top, count - 1, row * width + column
        base, here, way = g[cell], flat[cell], mark[cell] - run_mark
        if way >= SETTLED_MARK:
            continue  # a duplicate: a cheaper entry came first
        least = base + _bound(bound, cost, row, column, target)
        if least >= best - SUM_TOLERANCE and (row, column) != target:
            continue
        mark[cell], settled = mark[cell] + SETTLED_MARK, settled + 1
        begin, end = (0, 8) if way == ROOT_MARK else (way - MAX_BEND, way + MAX_BEND + 1)
        for onward in range(begin, end):
            to = onward & 7
            down, right = row + ROW_STEPS[to], column + COLUMN_STEPS[to]
            if not (0 <= down < height and 0 <= right < width):
                continue
            other = down * width + right
            found = base + HALF_LENGTHS[to] * here + HALF_LENGTHS[to] * flat[other]
            if mark[other] >= run_mark and found >= g[other] - SUM_TOLERANCE:
                continue
            aside, above = row * width + right, down * width + column
            if not _may_step(flat, lanes, cell, other, aside, above, to, reverse):
                continue
            g[other], mark[other] = found, run_mark + to
            least = found + _bound(bound, cost, down, right, target)
            if (down, right) == target:
                best = found
            elif least >= best - SUM_TOLERANCE:
                continue
            if free != NOWHERE:
                entry, free = free, entries[2, free]
            elif used < entries.shape[1]:
                entry, used = used, used + 1
            else:
                return OUT_OF_ENTRIES
            _push(first, entries, entry, now, least, down, right)
            count += 1
    return settled


@lean_kernel
def _push(
    first: Ints, entries: Ints, entry: int, now: int, least: float, row: int, column: int
) -> None:
    """Put `entry`, for a cell, on top of the bucket of its `least` cost, or bucket `now`."""
    bucket = max(now, min(int(least * BUCKETS_PER_COST), now + BUCKETS - 1))
    entries[0, entry], entries[1, entry] = row, column
    entries[2, entry], first[bucket % BUCKETS] = first[bucket % BUCKETS], entry


@lean_kernel
def _may_step(
    flat: Costs, lanes: WayBits, cell: int, other: int, aside: int, above: int, to: int,
    reverse: bool,
) -> bool:  # fmt: skip
    """Return whether a step is allowed; a diagonal one needs both cells beside it free."""
    ahead = to + 4 & 7 if reverse else to
    if lanes.size and (lanes[cell] | lanes[other]) >> ahead & 1:
        return False
    source, into = (flat[other], flat[cell]) if reverse else (flat[cell], flat[other])
    return (
        _may_enter(source, into)
        and _may_enter(source, flat[aside])
        and _may_enter(source, flat[above])
    )


@lean_kernel
def _may_enter(source: float, into: float) -> bool:
    """Return whether a body may go from a cell of cost `source` into one of cost `into`."""
    return into < LETHAL or into <= source


@lean_kernel
def _bound(bound: BlockBounds, cost: Costs, row: int, column: int, target: Cell) -> float:
    """Return a lower bound of the cost to `target`."""
    return 0.0 if target[0] == NOWHERE else bound_at(bound, cost, row, column)


@kernel
def _trace(mark: Ints, width: int, target: int) -> Ints:
    """Return the cells from the start to `target`, (n,)."""
    count, cell = 1, target
    while mark[cell] % SETTLED_MARK != ROOT_MARK:
        cell -= (
            ROW_STEPS[mark[cell] % SETTLED_MARK] * width + COLUMN_STEPS[mark[cell] % SETTLED_MARK]
        )
        count += 1
    cells = np.empty(count, np.int32)
    cell = target
    for i in range(count - 1, 0, -1):
        cells[i] = cell
        cell -= (
            ROW_STEPS[mark[cell] % SETTLED_MARK] * width + COLUMN_STEPS[mark[cell] % SETTLED_MARK]
        )
    cells[0] = cell
    return cells


@kernel
def _nearest(
    cost: Costs, mark: Ints, settled_mark: int, g: Floats, row: float, column: float
) -> int:
    """Return the nearest settled cell; of several, the one cheapest to reach."""
    best, least, flat = NOWHERE, np.inf, cost.ravel()
    width = cost.shape[1]
    for cell in range(flat.size):
        if mark[cell] >= settled_mark and flat[cell] < LETHAL:
            away = (cell // width - row) ** 2 + (cell % width - column) ** 2
            if away < least or (away == least and g[cell] < g[best]):
                best, least = cell, away
    return best


@kernel
def line_cost(
    cost: Costs, x: float, y: float, to_x: float, to_y: float, against: WayBits
) -> tuple[float, float]:
    """Return the cost of a straight line and the highest cost on it.

    Both are inf outside the map. The highest cost is inf for a line against a lane.
    """
    height, width = cost.shape
    length = math.hypot(to_x - x, to_y - y)
    ways = _ways_of(to_x - x, to_y - y) if against.size else 0
    column, row = math.floor(x), math.floor(y)
    right, down = (1 if to_x > x else -1), (1 if to_y > y else -1)
    every_x = abs(length / (to_x - x)) if to_x != x else np.inf
    every_y = abs(length / (to_y - y)) if to_y != y else np.inf
    next_x = every_x * (column + 1 - x if right > 0 else x - column) if to_x != x else np.inf
    next_y = every_y * (row + 1 - y if down > 0 else y - row) if to_y != y else np.inf
    spent, worst, gone = 0.0, 0.0, 0.0
    while True:
        if not (0 <= row < height and 0 <= column < width):
            return np.inf, np.inf
        here, until = cost[row, column], min(next_x, next_y, length)
        if until - gone > CORNER and against.size and against[row, column] & ways:
            worst = np.inf
        spent += (until - gone) * here
        worst = max(worst, here)
        if until >= length:
            return spent, worst
        gone = until
        if abs(next_x - next_y) < 1e-9:  # through a corner: both cells beside it must be free
            if 0 <= column + right < width and 0 <= row + down < height:
                worst = max(worst, cost[row, column + right], cost[row + down, column])
            column, row = column + right, row + down
            next_x, next_y = next_x + every_x, next_y + every_y
        elif next_x < next_y:
            column, next_x = column + right, next_x + every_x
        else:
            row, next_y = row + down, next_y + every_y


@kernel
def _ways_of(right: float, down: float) -> int:
    """Return the bits of the one or two ways nearest to a straight line; 0 without length."""
    if right == 0.0 and down == 0.0:
        return 0
    way = math.atan2(-down, right) * (4 / math.pi) + 8.0
    low, high = math.floor(way + SAME_WAY), math.ceil(way - SAME_WAY)
    return 1 << (low & 7) | 1 << (high & 7)


@kernel
def smooth_path(cost: Costs, points: Floats, against: WayBits) -> Floats:
    """Return the `points` (n, 2) that remain when straight lines replace the others."""
    count = len(points)
    spent = np.zeros(count)
    for i in range(1, count):
        x, y, to_x, to_y = points[i - 1, 0], points[i - 1, 1], points[i, 0], points[i, 1]
        mean = 0.5 * (cost[int(y), int(x)] + cost[int(to_y), int(to_x)])
        spent[i] = spent[i - 1] + mean * math.hypot(to_x - x, to_y - y)
    kept, size, at = np.zeros(count, np.int64), 1, int(NONE)
    while at < count - 1:
        at = _farthest(cost, points, spent, at, against)
        kept[size] = at
        size += 1
    return points[kept[:size]]


@kernel
def _farthest(cost: Costs, points: Floats, spent: Floats, at: int, against: WayBits) -> int:
    """Return the farthest point found on a straight line, by doubling, then halving the hop."""
    last = len(points) - 1
    good, bad, hop = at + 1, last + 1, 2
    while good < last:
        tried = min(at + hop, last)
        if not _is_straight(cost, points, spent, at, tried, against):
            bad = tried
            break
        good, hop = tried, 2 * hop
    while bad - good > 1:
        middle = (good + bad) // 2
        if _is_straight(cost, points, spent, at, middle, against):
            good = middle
        else:
            bad = middle
    return good


@kernel
def _is_straight(
    cost: Costs, points: Floats, spent: Floats, at: int, to: int, against: WayBits
) -> bool:
    x, y, to_x, to_y = points[at, 0], points[at, 1], points[to, 0], points[to, 1]
    value, worst = line_cost(cost, x, y, to_x, to_y, against)
    return worst < LETHAL and value <= (spent[to] - spent[at]) * STRAIGHT_TOLERANCE


@kernel
def costs_to_go(cost: Costs, points: Floats, against: WayBits) -> Floats:
    """Return the costs (n,) from each of the `points` (n, 2) of a path to its end."""
    left = np.zeros(len(points))
    for i in range(len(points) - 2, -1, -1):
        x, y, to_x, to_y = points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1]
        left[i] = left[i + 1] + line_cost(cost, x, y, to_x, to_y, against)[0]
    return left


@kernel
def is_free(cost: Costs, points: Floats, against: WayBits) -> bool:
    """Return whether a path along `points` (n, 2) is free, except for leaving a tight spot."""
    x, y = points[0, 0], points[0, 1]
    if line_cost(cost, x, y, x, y, against)[1] == np.inf:
        return False
    limit = cost[int(points[0, 1]), int(points[0, 0])]
    for i in range(len(points) - 1):
        x, y, to_x, to_y = points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1]
        worst = line_cost(cost, x, y, to_x, to_y, against)[1]
        if worst == np.inf or (worst >= LETHAL and worst > limit):
            return False
        limit = min(limit, cost[int(to_y), int(to_x)])  # a line ends before the cell at its end
    return True
