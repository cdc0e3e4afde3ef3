"""How costly the way to the goal is from every place in the window."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.navigation.footprint import Grid

COARSER = 2  # cells of the window per cell of the field, along each axis
FARTHEST = 1e4  # [m], what cannot be reached
TIGHT, TIGHT_OVER = 12.0, 0.09  # cost of a place where the body just fits, and its decay [m]
TOUCHING, INSIDE = 60.0, 400.0  # high and not infinite: whoever stands there must find out

BEYOND = 1e6  # cost of what is beside the window
DIAGONAL = math.sqrt(2.0)

Floats = NDArray[np.float64]
Spans = NDArray[np.float32]


class CostToGo:
    """The cheapest ways over the window, 8-connected, with buffers that are used again."""

    def __init__(self, cells: int) -> None:
        side = cells // COARSER
        self._side = side
        self._field = np.empty((side, side), dtype=np.float32)
        self._padded = np.empty((side, side + 2), dtype=np.float32)
        self._cost = np.full((side, side + 2), np.float32(BEYOND), dtype=np.float32)
        self._spans = np.empty((3, side + 2), dtype=np.float32)

    def field(
        self, grid: Grid, half_width: float, goal: tuple[float, float], path: Floats | None
    ) -> Grid:
        """Cost from each place to the goal [m of free way], or to where the path leaves the window.

        Without a path, and with the goal outside, every place at the rim counts on free way beyond.
        """
        side, cell = self._side, grid.cell * COARSER
        distance = np.asarray(
            cv2.resize(grid.distance, (side, side), interpolation=cv2.INTER_AREA), dtype=np.float32
        )
        cost = _cost(distance, np.float32(half_width))
        seed = _seed(side, cell, (grid.x, grid.y), goal, path)
        self._cost[:, 1:-1], self._padded[:, 1:-1] = cost, seed
        self._padded[:, [0, -1]] = FARTHEST
        _sweep(self._cost, np.float32(cell), self._padded, self._spans)
        self._field[:] = self._padded[:, 1:-1]
        return Grid(self._field, cell, grid.x, grid.y)


def _seed(
    side: int, cell: float, corner: tuple[float, float], goal: tuple[float, float],
    path: Floats | None,
) -> NDArray[np.float32]:  # fmt: skip
    """What is known from the start: (side, side), FARTHEST elsewhere."""
    seed = np.full((side, side), FARTHEST, dtype=np.float32)
    points = np.array([goal]) if path is None else path
    cells = np.floor((points - corner) / cell).astype(np.int64)
    inside = np.asarray(((cells >= 1) & (cells < side - 1)).all(axis=1))
    if inside.any():
        last = _way_out(points, inside, np.add(corner, side * cell / 2))
        column, row = cells[last]
        seed[row, column] = 0.0
        return seed
    x, y = (np.add.outer(corner, (np.arange(side) + 0.5) * cell).T - points[-1]).T
    for end in (0, -1):
        seed[end], seed[:, end] = np.hypot(x, y[end]), np.hypot(x[end], y)
    return seed


def _way_out(points: Floats, inside: NDArray[np.bool_], robot: Floats) -> int:
    """The last of the path's points before it leaves the window, from the robot on."""
    near = np.hypot(*(points - robot).T)
    nearest = int(np.argmin(np.where(inside, near, np.inf)))
    outside = np.flatnonzero(~inside[nearest:])
    return nearest + int(outside[0]) - 1 if len(outside) else len(points) - 1


def _cost(distance: NDArray[np.float32], half_width: np.float32) -> NDArray[np.float32]:
    near = np.exp((half_width - distance) * np.float32(1.0 / TIGHT_OVER))
    cost: NDArray[np.float32] = np.float32(1.0) + np.float32(TIGHT) * near
    cost[distance < half_width] = TOUCHING
    cost[distance < 0.6 * half_width] = INSIDE
    return cost


@kernel
def _sweep(
    cost: NDArray[np.float32], cell: np.float32, field: NDArray[np.float32], spans: Spans
) -> None:
    """Lower `field` until each cell is as cheap as by any of its eight neighbours.

    The edge between two costs its length times the mean of their costs. Row by row, down and up,
    as long as a row beside has changed: what Dijkstra's algorithm finds, in a quarter of its time.
    """
    rows = cost.shape[0]
    stale, fresh = np.ones(rows, dtype=np.bool_), np.ones(rows, dtype=np.bool_)
    going, down = True, True
    while going:
        going = False
        for step in range(rows):
            i = step if down else rows - 1 - step
            if not stale[i]:
                continue
            stale[i] = False
            changed = i > 0 and _from_row(cost[i - 1], cost[i], field[i - 1], field[i], cell)
            if i < rows - 1:
                changed |= _from_row(cost[i + 1], cost[i], field[i + 1], field[i], cell)
            if changed or fresh[i]:
                changed |= _along(cost[i], field[i], cell, spans)
                fresh[i] = False
            if changed:
                going = True
                stale[max(0, i - 1)] = stale[min(rows - 1, i + 1)] = True
                stale[i] = False
        down = not down


@kernel
def _from_row(
    beside: NDArray[np.float32],
    cost: NDArray[np.float32],
    known: NDArray[np.float32],
    row: NDArray[np.float32],
    cell: np.float32,
) -> bool:
    """Lower `row` by steps from the row beside it; whether that changed it.

    Slices, not indices: they are vectorised.
    """
    n = len(row)
    half = np.float32(0.5) * cell
    slant = half * np.float32(DIAGONAL)
    changed = False
    here, mine = row[1 : n - 1], cost[1 : n - 1]
    a, b, c = known[: n - 2], known[1 : n - 1], known[2:]
    p, q, r = beside[: n - 2], beside[1 : n - 1], beside[2:]
    for j in range(n - 2):
        left = a[j] + slant * (p[j] + mine[j])
        middle = b[j] + half * (q[j] + mine[j])
        right = c[j] + slant * (r[j] + mine[j])
        best = left if left < right else right
        best = middle if middle < best else best
        changed |= best < here[j]
        here[j] = best if best < here[j] else here[j]
    return changed


@kernel
def _along(
    cost: NDArray[np.float32], row: NDArray[np.float32], cell: np.float32, spans: Spans
) -> bool:
    """Lower `row` by steps within it, to the right and to the left; whether that changed it.

    Both at the same time, for each waits for itself all the way.
    """
    n = len(row)
    half = np.float32(0.5) * cell
    first, second = cost[: n - 1], cost[1:]
    steps, right, left = spans[0, : n - 1], spans[1], spans[2]
    for j in range(n - 1):
        steps[j] = half * (first[j] + second[j])
    forth, back = row[0], row[n - 1]
    right[0], left[n - 1] = forth, back
    for j in range(n - 1):
        forth = min(forth + steps[j], row[j + 1])
        right[j + 1] = forth
        k = n - 2 - j
        back = min(back + steps[k], row[k])
        left[k] = back
    changed = False
    for j in range(n):
        best = right[j] if right[j] < left[j] else left[j]
        changed |= best < row[j]
        row[j] = best
    return changed
