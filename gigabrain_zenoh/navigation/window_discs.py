"""Moving things in the near surroundings: which of them move, and what they have left behind.

A disc is x, y [m], vx, vy [m/s] and a radius [m] first of all.
"""

import math

from gigabrain_schemas.base import TICK_NS
from gigabrain_zenoh.kernels.kernel import kernel
from gigabrain_zenoh.navigation.window_cells import CELL_M, Cells, Floats

ROUND_DISC = 0.1  # [m], hits so near a moving thing are its own
LATE_TICKS = 10  # so much longer than it seems a disc may have been over a cell


@kernel
def stays(cells: Cells, disc: Floats, tick: int, long_ago: int) -> float:
    """The share of the cells of `disc` hit at `tick` that were hit `long_ago` already."""
    x, y, radius = disc[0], disc[1], disc[4] + ROUND_DISC
    top, bottom, left, end = _box(cells, x, y, radius)
    hit = old = 0
    for i in range(top, bottom):
        down = cells.y + (i + 0.5) * CELL_M - y
        for j in range(left, end):
            near = math.hypot(cells.x + (j + 0.5) * CELL_M - x, down) <= radius
            if near and cells.level[i, j] > 0 and cells.seen[i, j] == tick:
                hit += 1
                old += cells.since[i, j] <= long_ago
    return old / hit if hit else 0.0


@kernel
def take_back(cells: Cells, disc: Floats, tick: int) -> None:
    """Free the cells that were first hit after `disc` had come to be over them."""
    x, y, vx, vy, radius = disc[0], disc[1], disc[2], disc[3], disc[4] + ROUND_DISC
    square, (top, bottom, left, end) = max(vx * vx + vy * vy, 1e-6), _box(cells, x, y, radius)
    for i in range(top, bottom):
        down = cells.y + (i + 0.5) * CELL_M - y
        for j in range(left, end):
            right = cells.x + (j + 0.5) * CELL_M - x
            inside, along = radius**2 - right**2 - down**2, right * vx + down * vy
            if inside >= 0.0 and cells.level[i, j] > 0:
                ago = (math.sqrt(along**2 + square * inside) - along) / square * 1e9 / TICK_NS
                if cells.since[i, j] >= tick - ago - LATE_TICKS:
                    cells.level[i, j] = 0


@kernel
def _box(cells: Cells, x: float, y: float, radius: float) -> tuple[int, int, int, int]:
    """The rows and columns that a disc may touch: the first, and that after the last, of each."""
    rows, columns = cells.level.shape
    top, bottom = (y - radius - cells.y) / CELL_M, (y + radius - cells.y) / CELL_M
    left, end = (x - radius - cells.x) / CELL_M, (x + radius - cells.x) / CELL_M
    return (
        max(0, int(top)),
        min(rows, int(bottom) + 1),
        max(0, int(left)),
        min(columns, int(end) + 1),
    )
