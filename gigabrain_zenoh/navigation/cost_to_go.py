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

Floats = NDArray[np.float64]


class CostToGo:
    """Dijkstra's algorithm over the window, 8-connected, with buffers that are used again."""

    def __init__(self, cells: int) -> None:
        side = cells // COARSER
        self._side = side
        self._field = np.empty((side, side), dtype=np.float32)
        self._keys = np.empty(8 * side * side + 1024, dtype=np.float32)
        self._heap = np.empty(8 * side * side + 1024, dtype=np.int32)

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
        _dijkstra(cost, np.float32(cell), seed, self._keys, self._heap, self._field)
        return Grid(self._field, cell, grid.x, grid.y)


def _seed(
    side: int, cell: float, corner: tuple[float, float], goal: tuple[float, float],
    path: Floats | None,
) -> NDArray[np.float32]:  # fmt: skip
    """What is known from the start: (side, side), inf elsewhere."""
    seed = np.full((side, side), np.inf, dtype=np.float32)
    points = np.array([goal]) if path is None else path
    cells = np.floor((points - corner) / cell).astype(np.int64)
    inside = np.asarray(((cells >= 1) & (cells < side - 1)).all(axis=1))
    if inside.any():
        last = _way_out(points, inside, np.add(corner, side * cell / 2))
        column, row = cells[last]
        seed[row, column] = 0.0
        return seed
    rim = np.ones((side, side), dtype=bool)
    rim[1:-1, 1:-1] = False
    rows, columns = np.nonzero(rim)
    x, y = corner[0] + (columns + 0.5) * cell, corner[1] + (rows + 0.5) * cell
    seed[rows, columns] = np.hypot(x - points[-1, 0], y - points[-1, 1])
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
def _dijkstra(
    cost: NDArray[np.float32],
    cell: np.float32,
    seed: NDArray[np.float32],
    keys: NDArray[np.float32],
    heap: NDArray[np.int32],
    field: NDArray[np.float32],
) -> None:
    """Fill `field`: the edge between two cells costs its length times the mean of their costs."""
    rows, columns = cost.shape
    size = 0
    for i in range(rows):
        for j in range(columns):
            field[i, j] = min(seed[i, j], np.float32(FARTHEST))
            if seed[i, j] < FARTHEST:
                size = _push(keys, heap, size, seed[i, j], i * columns + j)
    half, diagonal = np.float32(0.5) * cell, np.float32(0.5 * math.sqrt(2.0)) * cell
    while size > 0:
        key, at = keys[0], heap[0]
        size = _pop(keys, heap, size)
        i, j = at // columns, at % columns
        if key > field[i, j]:
            continue
        for di in range(-1, 2):
            for dj in range(-1, 2):
                ni, nj = i + di, j + dj
                if (di == 0 and dj == 0) or ni < 0 or nj < 0 or ni >= rows or nj >= columns:
                    continue
                step = half if di == 0 or dj == 0 else diagonal
                new = key + step * (cost[i, j] + cost[ni, nj])
                if new < field[ni, nj]:
                    field[ni, nj] = new
                    size = _push(keys, heap, size, new, ni * columns + nj)


@kernel
def _push(
    keys: NDArray[np.float32], heap: NDArray[np.int32], size: int, key: np.float32, item: int
) -> int:
    at = size
    while at > 0:
        up = (at - 1) // 2
        if keys[up] <= key:
            break
        keys[at], heap[at] = keys[up], heap[up]
        at = up
    keys[at], heap[at] = key, item
    return size + 1


@kernel
def _pop(keys: NDArray[np.float32], heap: NDArray[np.int32], size: int) -> int:
    size -= 1
    key, item = keys[size], heap[size]
    at = 0
    while True:
        child = 2 * at + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[at], heap[at] = keys[child], heap[child]
        at = child
    keys[at], heap[at] = key, item
    return size
