"""Cheapest ways over a grid of costs, eight-connected: A* to one cell, Dijkstra to all.

A step costs its length in cells times the mean cost of both cells. Corners are not cut. Where the
cost is LETHAL or more a way may lead out, to ever lower cost, but not in: whoever stands too close
to something can leave.

What is to be looked at next lies in buckets by what the whole way would cost, which takes half the
time of a heap. A bucket is not in order, so a cell may be looked at again; the result is the same.
"""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import NONE, kernel
from gigabrain_zenoh.navigation.costmap import LETHAL, Costs

DIAGONAL = math.sqrt(2.0)
DOWN = (0, -1, -1, -1, 0, 1, 1, 1)  # by way: round the compass, the odd ones are diagonal
RIGHT = (1, 1, 0, -1, -1, -1, 0, 1)
HALF = (0.5, DIAGONAL / 2, 0.5, DIAGONAL / 2, 0.5, DIAGONAL / 2, 0.5, DIAGONAL / 2)  # its length
ONWARD = 2  # ways to either side of that by which a cell was reached: behind, nothing is cheaper
PER_UNIT = 12.0  # buckets for a cost of 1
BUCKETS = 4096  # in a ring: they hold more than any one step can add
SAME = 1e-10  # sums of the same numbers in another order differ by less
SPARE = 1024
ROOT = 8  # the way came from nowhere: it began here
DONE = 16  # and more: the cell was settled
TURN = 32  # and more: of this search
LAST_TURN = np.iinfo(np.int32).max // TURN - 1  # the marks hold no greater one
NOWHERE = -1
FULL = -1  # no room for more entries
ANYWHERE = (NOWHERE, NOWHERE)

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Cell = tuple[int, int]  # row, column
Way = Literal["from", "to"]


class Memory(NamedTuple):
    """What a search fills."""

    g: Floats  # by cell, what the way to it costs
    mark: Ints  # by cell, by what way it was reached, and in what turn
    first: Ints  # by bucket, the entry on top
    entries: Ints  # row, column, and the entry below


class Search:
    """Searches with the same memory again and again. Not for two threads at once."""

    def __init__(self) -> None:
        self._shape = (0, 0)
        self._turn = 0
        none, first = np.empty(0, np.int32), np.empty(BUCKETS, np.int32)
        self._memory = Memory(np.empty(0), none, first, np.empty((3, 0), np.int32))

    def path(self, cost: Costs, start: Cell, goal: Cell) -> Ints | None:
        """The cheapest way from cell to cell (row, column), (n, 2); None when there is none."""
        target = goal[0] * cost.shape[1] + goal[1]
        self._run(cost, start, goal, reverse=False)
        if self._memory.mark[target] < TURN * self._turn + DONE:
            return None
        cells = _trace(self._memory.mark, cost.shape[1], target)
        return np.column_stack(np.divmod(cells, np.int32(cost.shape[1])))

    def field(self, cost: Costs, cell: Cell, way: Way) -> Floats:
        """What the cheapest way costs, "to" `cell` from each or "from" it; inf where none leads.

        (height, width), in cells: times the resolution it is metres at cost 1.
        """
        self._run(cost, cell, ANYWHERE, reverse=way == "to")
        field = np.where(self._memory.mark >= TURN * self._turn + DONE, self._memory.g, np.inf)
        return field.reshape(cost.shape)

    def reach(self, cost: Costs, start: Cell) -> None:
        """Go wherever a way leads from `start`, for `nearest` to be asked."""
        self._run(cost, start, ANYWHERE, reverse=False)

    def nearest(self, cost: Costs, row: float, column: float) -> Cell | None:
        """The cell nearest to a place of all that the last search reached, where the body fits."""
        found = _nearest(
            cost, self._memory.mark, TURN * self._turn + DONE, self._memory.g, row, column
        )
        return None if found == NOWHERE else divmod(found, cost.shape[1])

    def _run(self, cost: Costs, start: Cell, target: Cell, *, reverse: bool) -> None:
        if cost.shape != self._shape:
            self._make_room(cost.shape)
        cost = np.ascontiguousarray(cost)
        while True:
            if self._turn >= LAST_TURN:
                self._memory.mark[:] = self._turn = 0
            self._turn += 1
            if _search(cost, start, target, reverse, TURN * self._turn, self._memory) != FULL:
                return
            more = np.empty((3, 2 * self._memory.entries.shape[1]), np.int32)
            self._memory = self._memory._replace(entries=more)

    def _make_room(self, shape: tuple[int, ...]) -> None:
        """Memory for a grid. What no search comes to is never touched, and costs nothing."""
        size = shape[0] * shape[1]
        self._shape, self._turn = (shape[0], shape[1]), 0
        entries = np.empty((3, size + SPARE), np.int32)
        self._memory = Memory(np.empty(size), np.zeros(size, np.int32), self._memory.first, entries)


@kernel
def _search(cost: Costs, start: Cell, target: Cell, reverse: bool, turn: int, held: Memory) -> int:
    """Fill the memory until nothing makes the way to `target` cheaper. How many, or FULL."""
    (height, width), flat, (g, mark, first, entries) = cost.shape, cost.ravel(), held
    first[:] = NOWHERE
    at, best = start[0] * width + start[1], np.inf  # what the way to `target` costs, so far
    g[at], mark[at] = 0.0, turn + ROOT
    now = int(_least(start[0], start[1], target) * PER_UNIT)
    _put(first, entries, int(NONE), now, start[0], start[1])
    free, used, count, settled = NOWHERE, 1, 1, 0
    while count:
        top = first[now % BUCKETS]
        if top == NOWHERE:
            now += 1
            continue
        row, column, first[now % BUCKETS] = entries[0, top], entries[1, top], entries[2, top]
        entries[2, top], free, count = free, top, count - 1
        cell = row * width + column
        base, here, way = g[cell], flat[cell], mark[cell] - turn
        if way >= DONE:
            continue  # a duplicate: it was reached at less meanwhile
        if base + _least(row, column, target) >= best - SAME and (row, column) != target:
            continue
        mark[cell] += DONE
        settled += 1
        begin, end = (0, 8) if way == ROOT else (way - ONWARD, way + ONWARD + 1)
        for onward in range(begin, end):
            to = onward & 7
            down, right = row + DOWN[to], column + RIGHT[to]
            if not (0 <= down < height and 0 <= right < width):
                continue
            other = down * width + right
            found = base + HALF[to] * here + HALF[to] * flat[other]
            if mark[other] >= turn and found >= g[other] - SAME:
                continue
            if not _leads(flat, cell, other, row * width + right, down * width + column, reverse):
                continue
            g[other], mark[other] = found, turn + to
            if (down, right) == target:
                best = found
            if free != NOWHERE:
                entry, free = free, entries[2, free]
            elif used < entries.shape[1]:
                entry, used = used, used + 1
            else:
                return FULL
            key = int((found + _least(down, right, target)) * PER_UNIT)
            _put(first, entries, entry, max(now, key), down, right)
            count += 1
    return settled


@kernel
def _put(first: Ints, entries: Ints, entry: int, bucket: int, row: int, column: int) -> None:
    """Lay `entry`, for a cell, on top of a bucket."""
    entries[0, entry], entries[1, entry] = row, column
    entries[2, entry], first[bucket % BUCKETS] = first[bucket % BUCKETS], entry


@kernel
def _leads(flat: Costs, cell: int, other: int, aside: int, above: int, reverse: bool) -> bool:
    """Whether a step may be taken. Of a diagonal one both cells beside it must be free as well."""
    source, into = (flat[other], flat[cell]) if reverse else (flat[cell], flat[other])
    return _may(source, into) and _may(source, flat[aside]) and _may(source, flat[above])


@kernel
def _may(source: float, into: float) -> bool:
    """Whether a body may come from a cell of that cost into one of the other."""
    return into < LETHAL or into <= source


@kernel
def _least(row: int, column: int, target: Cell) -> float:
    """What the way to `target` costs at least: nowhere costs less than 1."""
    if target[0] == NOWHERE:
        return 0.0
    down, right = abs(row - target[0]), abs(column - target[1])
    return down + (DIAGONAL - 1) * right if down > right else right + (DIAGONAL - 1) * down


@kernel
def _trace(mark: Ints, width: int, target: int) -> Ints:
    """The cells from the start to `target`, (n,)."""
    count, cell = 1, target
    while mark[cell] % DONE != ROOT:
        cell -= DOWN[mark[cell] % DONE] * width + RIGHT[mark[cell] % DONE]
        count += 1
    cells = np.empty(count, np.int32)
    cell = target
    for i in range(count - 1, 0, -1):
        cells[i] = cell
        cell -= DOWN[mark[cell] % DONE] * width + RIGHT[mark[cell] % DONE]
    cells[0] = cell
    return cells


@kernel
def _nearest(cost: Costs, mark: Ints, done: int, g: Floats, row: float, column: float) -> int:
    """The cell that was settled and is nearest; of equals the one that is cheaper to reach."""
    best, least, flat = NOWHERE, np.inf, cost.ravel()
    width = cost.shape[1]
    for cell in range(flat.size):
        if mark[cell] >= done and flat[cell] < LETHAL:
            away = (cell // width - row) ** 2 + (cell % width - column) ** 2
            if away < least or (away == least and g[cell] < g[best]):
                best, least = cell, away
    return best
