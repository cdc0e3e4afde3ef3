"""How far each cell of a map is from the nearest obstacle, exactly, as far as anybody asks.

In two passes: along the columns, then the least of d^2 + (what the column says d cells aside)^2.
With a cap of 16 cells that is a seventh of a whole distance transform (OpenCV's), on one core.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import kernel

OCCUPIED = 50  # a cell of at least this is taken for an obstacle: more likely than not

Cells = NDArray[np.int8]
Singles = NDArray[np.float32]


def squared_distance(cells: Cells, cap: int) -> Singles:
    """The squared distance in cells to the nearest occupied one of `cells` (h, w), by centres.

    It is `cap` squared where that is at least as far.
    """
    out = np.empty(cells.shape, np.float32)
    _along_columns(cells, np.float32(cap), out)
    _along_rows(out, cap)
    return out


@kernel
def _along_columns(cells: Cells, cap: np.float32, out: Singles) -> None:
    """The distance to the nearest obstacle in the same column."""
    one, zero = np.float32(1), np.float32(0)
    above = np.full(cells.shape[1], cap, np.float32)
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            away = above[column] + one
            away = cap if away > cap else away
            away = zero if cells[row, column] >= OCCUPIED else away
            above[column] = away
            out[row, column] = away
    above[:] = cap
    for row in range(cells.shape[0] - 1, -1, -1):
        for column in range(cells.shape[1]):
            away, known = above[column] + one, out[row, column]
            away = known if known < away else away
            above[column] = away
            out[row, column] = away


@kernel
def _along_rows(out: Singles, cap: int) -> None:
    """Square, and look `cap` cells to both sides. Slices, not indices: they are vectorised."""
    width = out.shape[1]
    most = np.float32(cap * cap)
    padded = np.full(width + 2 * cap, most, np.float32)
    for row in range(out.shape[0]):
        here = out[row]
        near = False
        for column in range(width):
            square = here[column] * here[column]
            near |= square < most
            here[column] = square
        if not near:
            continue
        middle = padded[cap : cap + width]
        for column in range(width):  # to assign the slice takes numba seconds to compile
            middle[column] = here[column]
        for aside in range(1, cap):
            left = padded[cap - aside : cap - aside + width]
            right = padded[cap + aside : cap + aside + width]
            more = np.float32(aside * aside)
            for column in range(width):
                a, b, best = left[column], right[column], here[column]
                found = (a if a < b else b) + more
                here[column] = found if found < best else best
