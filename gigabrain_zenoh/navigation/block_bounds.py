"""Lower bounds of the cost to a goal, from a search over blocks of cells. They guide A*.

The corners of blocks of 4 x 4 cells are the vertices of a coarse grid. The price of a block is the
cost of the cheapest of its 5 x 5 cells, including those on its edges. A step along an edge costs
its length times the lower price of the two blocks beside it. A diagonal step costs its length times
the price of its block. The cheapest paths over that grid give the bounds at the vertices.

Between vertices, the middle of an edge gets the mean of its ends. The middle of a block gets the
least value that differs from its eight neighbours by at most the cost of a step in this block. Such
a value exists because of the differences of the four corners. The four blocks of half the size are
bounded in the same way, down to cells. No step between cells costs less than the decrease of the
bound (A* calls this consistent). So no path costs less than the bound.
"""

import math
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.images import Bytes
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel
from gigabrain_zenoh.navigation.costmap import LETHAL, Costs

DIAGONAL = math.sqrt(2.0)
ROW_STEPS = (0, -1, -1, -1, 0, 1, 1, 1)  # of the eight ways; odd ones are diagonal
COLUMN_STEPS = (1, 1, 0, -1, -1, -1, 0, 1)
BLOCK = 4  # cells per side
SHIFT, WITHIN = 2, BLOCK - 1  # cell >> SHIFT is its block, cell & WITHIN its index in the block
BUCKETS = 4096  # in a ring that is longer than the most expensive step
BUCKETS_PER_COST = 6.0
ENTRIES_PER_VERTEX = 4
BEYOND_RATIO, BEYOND = 1.06, 4.0  # factor and cost by which the search passes the start
ROUNDED_DOWN = 1 - 2.0**-22  # keeps bounds in single precision below those in double
UNSEEN, PRICED, BOUNDED = 0, 1, 2  # state of a block: nothing, its price, or its bounds are known
NOWHERE = -1
Ints = np.ndarray[tuple[int, ...], np.dtype[np.int32]]
Cell = tuple[int, int]  # row, column


class BlockBounds(NamedTuple):
    """Bounds of the cost to a goal, and the buffers to find them."""

    vertex: Floats  # by vertex (row, column), its bound; inf if unknown
    settled: Bytes  # by vertex, 1 if the bound is final
    price: Costs  # by block (row, column)
    known: Bytes  # by block, see UNSEEN
    bounds: Costs  # (block, cell in the block)
    corners: Floats  # (5, 5), buffer for one block
    first: Ints  # by bucket, the entry on top
    entries: Ints  # (3, n): row, column, and the entry below
    goal: Cell = (NOWHERE, NOWHERE)
    limit: float = 0.0  # bound of vertices that are not settled: this minus their distance to start
    start: Cell = (0, 0)


def block_bounds(shape: tuple[int, ...]) -> BlockBounds:
    """Return buffers for a grid. Pages that no search reaches take no memory."""
    rows, columns = ((max(side, 1) - 1) // BLOCK + 1 for side in shape)
    vertices = rows + 1, columns + 1
    entries = ENTRIES_PER_VERTEX * vertices[0] * vertices[1]
    return BlockBounds(
        vertex=np.empty(vertices),
        settled=np.empty(vertices, np.uint8),
        price=np.empty((rows, columns), np.float32),
        known=np.empty((rows, columns), np.uint8),
        bounds=np.empty((rows * columns, BLOCK * BLOCK), np.float32),
        corners=np.empty((BLOCK + 1, BLOCK + 1)),
        first=np.empty(BUCKETS, np.int32),
        entries=np.empty((3, entries), np.int32),
    )


def towards(goal: Cell, start: Cell, cost: Costs, memory: BlockBounds) -> BlockBounds:
    """Return bounds of the cost to `goal`, tight ones for paths from `start`."""
    limit = _settle(cost, start, goal, memory)
    return memory._replace(goal=goal, limit=limit, start=start)


@kernel
def bound_after_changes(bound: BlockBounds, cost: Costs, start: Cell) -> float:
    """Return the bound at `start` when the costs have changed since the bounds were computed.

    A path through cheaper blocks costs at least its length to the last of them, plus the bound
    where it leaves that block. For all other paths the bounds still hold.
    """
    least, known, price = bound_at(bound, cost, *start), bound.known, bound.price
    for row in range(known.shape[0]):
        for column in range(known.shape[1]):
            if known[row, column] == UNSEEN or _cheapest(cost, row, column) >= price[row, column]:
                continue
            down = max(row * BLOCK - start[0], start[0] - (row + 1) * BLOCK, 0)
            right = max(column * BLOCK - start[1], start[1] - (column + 1) * BLOCK, 0)
            beyond = min(
                min(_at_vertex(bound, row, column), _at_vertex(bound, row, column + 1)),
                min(_at_vertex(bound, row + 1, column), _at_vertex(bound, row + 1, column + 1)),
            )
            least = min(least, octile(down, right) + beyond)
    return least


@lean_kernel
def bound_at(bound: BlockBounds, cost: Costs, row: int, column: int) -> float:
    """Return the bound of the cost from a cell."""
    down, right = row >> SHIFT, column >> SHIFT
    block = down * bound.known.shape[1] + right
    if bound.known[down, right] != BOUNDED:
        _bound_cells(bound, cost, down, right, block)
    return float(bound.bounds[block, (row & WITHIN) * BLOCK + (column & WITHIN)])


@lean_kernel
def octile(down: float, right: float) -> float:
    """Return the length of the shortest path over cells."""
    down, right = abs(down), abs(right)
    return down + (DIAGONAL - 1) * right if down > right else right + (DIAGONAL - 1) * down


@lean_kernel
def _price(cost: Costs, bound: BlockBounds, row: int, column: int) -> float:
    """Return the price of a block; inf outside the grid."""
    price, known = bound.price, bound.known
    if not (0 <= row < price.shape[0] and 0 <= column < price.shape[1]):
        return np.inf
    if known[row, column] == UNSEEN:
        price[row, column], known[row, column] = _cheapest(cost, row, column), PRICED
    return float(price[row, column])


@lean_kernel
def _cheapest(cost: Costs, row: int, column: int) -> np.float32:
    """Return the cost of the cheapest cell of a block and its edges, LETHAL at most."""
    least, top, left = np.float32(LETHAL), row * BLOCK, column * BLOCK
    for y in range(top, min(top + BLOCK + 1, cost.shape[0])):
        for x in range(left, min(left + BLOCK + 1, cost.shape[1])):
            least = min(least, cost[y, x])
    return least


@kernel
def _settle(cost: Costs, start: Cell, goal: Cell, bound: BlockBounds) -> float:
    """Settle vertices from `goal` to slightly beyond `start`; return the `limit` of the bounds."""
    vertex, settled, first, entries = bound.vertex, bound.settled, bound.first, bound.entries
    vertex[:], settled[:], bound.known[:], first[:] = np.inf, 0, UNSEEN, NOWHERE
    y, x = start[0] / BLOCK, start[1] / BLOCK
    free, used, count, limit = NOWHERE, 4, 4, np.inf
    now = int(max(octile(start[0] - goal[0], start[1] - goal[1]) - 4 * BLOCK, 0) * BUCKETS_PER_COST)
    for entry in range(4):
        row, column = (goal[0] >> SHIFT) + entry // 2, (goal[1] >> SHIFT) + entry % 2
        vertex[row, column] = 0.0
        key = int(BLOCK * octile(row - y, column - x) * BUCKETS_PER_COST)
        _push(first, entries, entry, max(now, key), row, column)
    while count and now < limit:
        top = first[now % BUCKETS]
        if top == NOWHERE:
            now += 1
            continue
        row, column, first[now % BUCKETS] = entries[0, top], entries[1, top], entries[2, top]
        entries[2, top], free, count = free, top, count - 1
        if settled[row, column]:
            continue
        settled[row, column], base = 1, vertex[row, column]
        if limit == np.inf and _corners_settled(settled, start):
            limit = now * BEYOND_RATIO + BEYOND * BUCKETS_PER_COST
        steps = _steps(cost, bound, row, column)
        for way in range(8):
            down, right = row + ROW_STEPS[way], column + COLUMN_STEPS[way]
            found = base + steps[way]
            if found == np.inf or found >= vertex[down, right]:
                continue
            vertex[down, right], settled[down, right] = found, 0
            if free != NOWHERE:
                entry, free = free, entries[2, free]
            elif used < entries.shape[1]:
                entry, used = used, used + 1
            else:
                return now / BUCKETS_PER_COST
            key = int((found + BLOCK * octile(down - y, right - x)) * BUCKETS_PER_COST)
            _push(first, entries, entry, max(now, key), down, right)
            count += 1
    return now / BUCKETS_PER_COST if count else np.inf


@lean_kernel
def _push(first: Ints, entries: Ints, entry: int, bucket: int, row: int, column: int) -> None:
    """Put `entry`, for vertex (row, column), on top of a bucket."""
    entries[0, entry], entries[1, entry] = row, column
    entries[2, entry], first[bucket % BUCKETS] = first[bucket % BUCKETS], entry


@lean_kernel
def _corners_settled(settled: Bytes, cell: Cell) -> bool:
    """Return whether all corners of the block of a cell are settled."""
    row, column = cell[0] >> SHIFT, cell[1] >> SHIFT
    return bool(
        settled[row, column]
        & settled[row, column + 1]
        & settled[row + 1, column]
        & settled[row + 1, column + 1]
    )


@lean_kernel
def _steps(
    cost: Costs, bound: BlockBounds, row: int, column: int
) -> tuple[float, float, float, float, float, float, float, float]:
    """Return the costs of the eight steps from a vertex; inf outside the grid."""
    straight, diagonal = float(BLOCK), BLOCK * DIAGONAL
    lower_left, lower_right = (
        _price(cost, bound, row - 1, column - 1),
        _price(cost, bound, row - 1, column),
    )
    upper_left, upper_right = _price(cost, bound, row, column - 1), _price(cost, bound, row, column)
    return (
        straight * min(lower_right, upper_right),
        diagonal * lower_right,
        straight * min(lower_left, lower_right),
        diagonal * lower_left,
        straight * min(lower_left, upper_left),
        diagonal * upper_left,
        straight * min(upper_left, upper_right),
        diagonal * upper_right,
    )


@lean_kernel
def _bound_cells(bound: BlockBounds, cost: Costs, row: int, column: int, block: int) -> None:
    """Compute the bounds of the cells of a block from those of its corners."""
    at, price = bound.corners, _price(cost, bound, row, column)
    for i in range(2):
        for j in range(2):
            at[i * BLOCK, j * BLOCK] = _at_vertex(bound, row + i, column + j)
    side = BLOCK
    while side > 1:
        half = side // 2
        for i in range(0, BLOCK, side):
            for j in range(0, BLOCK, side):
                _fill_middles(at, i, j, half, price)
        side = half
    for i in range(BLOCK):
        for j in range(BLOCK):
            value = np.float32(max(at[i, j], 0.0) * ROUNDED_DOWN)
            bound.bounds[block, i * BLOCK + j] = value
    bound.known[row, column] = BOUNDED


@lean_kernel
def _at_vertex(bound: BlockBounds, row: int, column: int) -> float:
    """Return the bound at a vertex; if it is not settled, by its distance from the start."""
    away = octile(row * BLOCK - bound.start[0], column * BLOCK - bound.start[1])
    found = min(bound.vertex[row, column], bound.limit - away)
    top, left = bound.goal[0] >> SHIFT, bound.goal[1] >> SHIFT
    down = max(top - row, row - top - 1, 0)  # blocks between the vertex and the goal's
    right = max(left - column, column - left - 1, 0)
    return float(max(found, BLOCK * octile(down, right)))


@lean_kernel
def _fill_middles(at: Floats, top: int, left: int, half: int, price: float) -> None:
    """Fill the middles of the edges of a block, and its middle, from its corners."""
    y, x, bottom, right = top + half, left + half, top + 2 * half, left + 2 * half
    a, b, c, d = at[top, left], at[top, right], at[bottom, left], at[bottom, right]
    at[top, x], at[bottom, x] = (a + b) / 2, (c + d) / 2
    at[y, left], at[y, right] = (a + c) / 2, (b + d) / 2
    straight = max(max(a + b, c + d), max(a + c, b + d)) / 2 - half * price
    at[y, x] = max(straight, max(max(a, b), max(c, d)) - half * DIAGONAL * price)
