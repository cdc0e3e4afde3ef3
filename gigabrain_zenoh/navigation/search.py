"""Cheapest ways over a grid of costs, eight-connected: A* to one cell, Dijkstra to all.

A step costs its length in cells times the mean cost of both cells. Corners are not cut. Where the
cost is LETHAL or more a way may lead out, to ever lower cost, but not in: whoever stands too close
to something can leave.

What is to be looked at next lies in buckets by what the whole way would cost, which takes half the
time of a heap. A bucket is not in order, so a cell may be looked at again; the result is the same.
"""

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.navigation.costmap import LETHAL, Costs

DIAGONAL = math.sqrt(2.0)
DOWN = (0, 0, 1, -1, 1, 1, -1, -1)  # by way: four straight, four diagonal
RIGHT = (1, -1, 0, 0, 1, -1, 1, -1)
LENGTH = (1.0, 1.0, 1.0, 1.0, DIAGONAL, DIAGONAL, DIAGONAL, DIAGONAL)
PER_UNIT = 4.0  # buckets for a cost of 1
BUCKETS = 4096  # in a ring: they hold more than any one step can add
SAME = 1e-10  # sums of the same numbers in another order differ by less
SPARE = 1024
ROOT = 8  # the way came from nowhere: it began here
NOWHERE = -1
FULL = -1  # no room for more entries

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
Bytes = NDArray[np.int8]
Way = Literal["from", "to"]


class Search:
    """Searches with the same memory again and again. Not for two threads at once."""

    def __init__(self) -> None:
        self._shape = (0, 0)
        self._turn = 0
        self._g: Floats = np.empty(0)
        self._came: Bytes = np.empty(0, np.int8)
        self._seen: Ints = np.empty(0, np.int32)  # twice the turn; one more when done with
        self._first: Ints = np.empty(BUCKETS, np.int32)  # by bucket, the entry on top
        self._entries: Ints = np.empty((2, 0), np.int32)  # the cell of each, and the one below

    def path(self, cost: Costs, start: tuple[int, int], goal: tuple[int, int]) -> Ints | None:
        """The cheapest way from cell to cell (row, column), (n, 2); None when there is none."""
        target = goal[0] * cost.shape[1] + goal[1]
        self._run(cost, start, target, reverse=False)
        if self._seen[target] != 2 * self._turn + 1:
            return None
        cells = _trace(self._came, cost.shape[1], target)
        return np.column_stack(np.divmod(cells, np.int32(cost.shape[1])))

    def field(self, cost: Costs, cell: tuple[int, int], way: Way) -> Floats:
        """What the cheapest way costs, "to" `cell` from each or "from" it; inf where none leads.

        (height, width), in cells: times the resolution it is metres at cost 1.
        """
        self._run(cost, cell, NOWHERE, reverse=way == "to")
        field = np.where(self._seen == 2 * self._turn + 1, self._g, np.inf)
        return field.reshape(cost.shape)

    def reach(self, cost: Costs, start: tuple[int, int]) -> None:
        """Go wherever a way leads from `start`, for `nearest` to be asked."""
        self._run(cost, start, NOWHERE, reverse=False)

    def nearest(self, cost: Costs, row: float, column: float) -> tuple[int, int] | None:
        """The cell nearest to a place of all that the last search reached, where the body fits."""
        found = _nearest(cost, self._seen, 2 * self._turn + 1, self._g, row, column)
        return None if found == NOWHERE else divmod(found, cost.shape[1])

    def _run(self, cost: Costs, start: tuple[int, int], target: int, *, reverse: bool) -> None:
        if cost.shape != self._shape:
            self._make_room(cost.shape)
        cost = np.ascontiguousarray(cost)
        at = start[0] * cost.shape[1] + start[1]
        while True:
            self._turn += 1
            mine = (self._g, self._came, self._seen, self._first, self._entries)
            if _search(cost, at, target, reverse, 2 * self._turn, *mine) != FULL:
                return
            self._entries = np.empty((2, 2 * self._entries.shape[1]), np.int32)

    def _make_room(self, shape: tuple[int, ...]) -> None:
        """Memory for a grid. What no search comes to is never touched, and costs nothing."""
        size = shape[0] * shape[1]
        self._shape, self._turn = (shape[0], shape[1]), 0
        self._g = np.empty(size)
        self._came = np.empty(size, np.int8)
        self._seen = np.zeros(size, np.int32)
        self._entries = np.empty((2, size + SPARE), np.int32)


@kernel
def _search(
    cost: Costs,
    start: int,
    target: int,
    reverse: bool,
    turn: int,
    g: Floats,
    came: Bytes,
    seen: Ints,
    first: Ints,
    entries: Ints,
) -> int:
    """Fill `g` and `came` until nothing makes the way to `target` cheaper. How many, or FULL."""
    (height, width), flat = cost.shape, cost.ravel()
    first[:] = NOWHERE
    g[start], came[start], seen[start] = 0.0, ROOT, turn
    now = int(_least(start // width, start % width, target, width) * PER_UNIT)
    _put(first, entries, 0, now, start)
    free, used, count, settled = NOWHERE, 1, 1, 0
    while count:
        top = first[now % BUCKETS]
        if top == NOWHERE:
            now += 1
            continue
        cell, first[now % BUCKETS] = entries[0, top], entries[1, top]
        entries[1, top], free, count = free, top, count - 1
        row, column = cell // width, cell % width
        if seen[cell] == turn + 1:
            continue  # a duplicate: it was reached at less meanwhile
        base, half = g[cell], 0.5 * flat[cell]
        if target >= 0 and seen[target] >= turn and cell != target:
            least = base + _least(row, column, target, width)
            if least >= g[target] - SAME:
                continue
        seen[cell] = turn + 1
        settled += 1
        for way in range(8):
            down, right = row + DOWN[way], column + RIGHT[way]
            if not (0 <= down < height and 0 <= right < width):
                continue
            other = down * width + right
            found = base + LENGTH[way] * (half + 0.5 * flat[other])
            if seen[other] >= turn and found >= g[other] - SAME:
                continue
            if not _leads(flat, cell, other, row * width + right, down * width + column, reverse):
                continue
            g[other], came[other], seen[other] = found, way, turn
            key = int((found + _least(down, right, target, width)) * PER_UNIT)
            if free != NOWHERE:
                entry, free = free, entries[1, free]
            elif used < entries.shape[1]:
                entry, used = used, used + 1
            else:
                return FULL
            _put(first, entries, entry, max(now, key), other)
            count += 1
    return settled


@kernel
def _put(first: Ints, entries: Ints, entry: int, bucket: int, cell: int) -> None:
    """Lay `entry`, for a cell, on top of a bucket."""
    entries[0, entry], entries[1, entry] = cell, first[bucket % BUCKETS]
    first[bucket % BUCKETS] = entry


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
def _least(row: int, column: int, target: int, width: int) -> float:
    """What the way to `target` costs at least: nowhere costs less than 1."""
    if target == NOWHERE:
        return 0.0
    down, right = abs(row - target // width), abs(column - target % width)
    return down + (DIAGONAL - 1) * right if down > right else right + (DIAGONAL - 1) * down


@kernel
def _trace(came: Bytes, width: int, target: int) -> Ints:
    """The cells from the start to `target`, (n,)."""
    count, cell = 1, target
    while came[cell] != ROOT:
        cell -= DOWN[came[cell]] * width + RIGHT[came[cell]]
        count += 1
    cells = np.empty(count, np.int32)
    cell = target
    for i in range(count - 1, 0, -1):
        cells[i] = cell
        cell -= DOWN[came[cell]] * width + RIGHT[came[cell]]
    cells[0] = cell
    return cells


@kernel
def _nearest(cost: Costs, seen: Ints, done: int, g: Floats, row: float, column: float) -> int:
    """The cell that was settled and is nearest; of equals the one that is cheaper to reach."""
    best, least, flat = NOWHERE, np.inf, cost.ravel()
    width = cost.shape[1]
    for cell in range(flat.size):
        if seen[cell] == done and flat[cell] < LETHAL:
            away = (cell // width - row) ** 2 + (cell % width - column) ** 2
            if away < least or (away == least and g[cell] < g[best]):
                best, least = cell, away
    return best
