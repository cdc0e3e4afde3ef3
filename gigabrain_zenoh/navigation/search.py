"""Cheapest ways over a grid of costs, eight-connected: A* to one cell, Dijkstra to all.

A step costs its length in cells times the mean cost of both cells. Corners are not cut. Where the
cost is LETHAL or more a way may lead out, to ever lower cost, but not in: whoever stands too close
to something can leave.
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
SPARE = 1024
ROOT = 8  # the way came from nowhere: it began here
NOWHERE = -1
FULL = -1  # the heap is too small

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
        self._keys: Floats = np.empty(0)
        self._heap: Ints = np.empty(0, np.int32)

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
        while True:
            self._turn += 1
            at = start[0] * cost.shape[1] + start[1]
            arrays = (self._g, self._came, self._seen, self._keys, self._heap)
            if _search(cost, at, target, reverse, 2 * self._turn, *arrays) != FULL:
                return
            self._keys = np.empty(2 * self._keys.size)
            self._heap = np.empty(2 * self._heap.size, np.int32)

    def _make_room(self, shape: tuple[int, ...]) -> None:
        """Memory for a grid. What no search comes to is never touched, and costs nothing."""
        size = shape[0] * shape[1]
        self._shape, self._turn = (shape[0], shape[1]), 0
        self._g = np.empty(size)
        self._came = np.empty(size, np.int8)
        self._seen = np.zeros(size, np.int32)
        self._keys = np.empty(2 * size + SPARE)
        self._heap = np.empty(2 * size + SPARE, np.int32)


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
    keys: Floats,
    heap: Ints,
) -> int:
    """Fill `g` and `came` until `target` is settled, or all is. The number settled, or FULL."""
    height, width = cost.shape
    flat = cost.ravel()
    g[start], came[start], seen[start] = 0.0, ROOT, turn
    size, settled = _push(keys, heap, 0, 0.0, start), 0
    while size:
        cell = heap[0]
        size = _pop(keys, heap, size)
        if seen[cell] == turn + 1:
            continue  # a duplicate: it was reached at less meanwhile
        seen[cell] = turn + 1
        settled += 1
        if cell == target:
            break
        if size + 8 > keys.size:
            return FULL
        row, column = cell // width, cell % width
        for way in range(8):
            down, right = row + DOWN[way], column + RIGHT[way]
            if not (0 <= down < height and 0 <= right < width):
                continue
            other = down * width + right
            if seen[other] == turn + 1:
                continue
            source, into = (flat[other], flat[cell]) if reverse else (flat[cell], flat[other])
            if not _may(source, into):
                continue
            aside, above = flat[row * width + right], flat[down * width + column]
            if way >= 4 and not (_may(source, aside) and _may(source, above)):
                continue  # it would cut a corner
            found = g[cell] + LENGTH[way] * (0.5 * source + 0.5 * into)
            if seen[other] != turn or found < g[other]:
                g[other], came[other], seen[other] = found, way, turn
                key = found + _least(down, right, target, width)
                size = _push(keys, heap, size, key, other)
    return settled


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
def _push(keys: Floats, heap: Ints, size: int, key: float, cell: int) -> int:
    """Put a cell on the heap, in which each has four below; its size then."""
    at = size
    while at:
        above = (at - 1) >> 2
        if keys[above] <= key:
            break
        keys[at], heap[at] = keys[above], heap[above]
        at = above
    keys[at], heap[at] = key, cell
    return size + 1


@kernel
def _pop(keys: Floats, heap: Ints, size: int) -> int:
    """Take the first off the heap; its size then."""
    size -= 1
    key, cell, at = keys[size], heap[size], 0
    while True:
        first = 4 * at + 1
        if first >= size:
            break
        best = first
        for other in range(first + 1, min(first + 4, size)):
            if keys[other] < keys[best]:
                best = other
        if keys[best] >= key:
            break
        keys[at], heap[at] = keys[best], heap[best]
        at = best
    keys[at], heap[at] = key, cell
    return size


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
