"""Operations on grids of cells: distances, dilation and connected parts.

The capped distance transform is exact: cv2.distanceTransform gave equal cells, in 0.28 ms where
this took 0.08 ms (200 x 200 cells, cap 16). OpenCV is not used, as it takes 160 MB.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.jit import kernel

OCCUPIED_PERCENT = 50  # from this on, a cell counts as occupied
Cells = NDArray[np.int8]
Singles = NDArray[np.float32]
Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


def squared_distance(cells: Cells, cap: int) -> Singles:
    """Return squared distances (h, w) [cells²] to the nearest occupied cell, between centres.

    They are at most `cap` squared.
    """
    out = np.empty(cells.shape, np.float32)
    _along_columns(cells, np.float32(cap), out)
    _along_rows(out, cap)
    return out


@kernel
def _along_columns(cells: Cells, cap: np.float32, out: Singles) -> None:
    """Fill `out` with the distance to the nearest obstacle in the same column."""
    one, zero = np.float32(1), np.float32(0)
    above = np.full(cells.shape[1], cap, np.float32)
    for row in range(cells.shape[0]):
        for column in range(cells.shape[1]):
            away = above[column] + one
            away = cap if away > cap else away
            away = zero if cells[row, column] >= OCCUPIED_PERCENT else away
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
    """Square distances, and combine those up to `cap` cells to both sides.

    It uses slices, as those are vectorised; indices are not.
    """
    width = out.shape[1]
    largest = np.float32(cap * cap)
    padded = np.full(width + 2 * cap, largest, np.float32)
    for row in range(out.shape[0]):
        here = out[row]
        near = False
        for column in range(width):
            square = here[column] * here[column]
            near |= square < largest
            here[column] = square
        if not near:
            continue
        middle = padded[cap : cap + width]
        for column in range(width):  # numba needs seconds to compile the assignment of a slice
            middle[column] = here[column]
        for aside in range(1, cap):
            left = padded[cap - aside : cap - aside + width]
            right = padded[cap + aside : cap + aside + width]
            more = np.float32(aside * aside)
            for column in range(width):
                a, b, best = left[column], right[column], here[column]
                found = (a if a < b else b) + more
                here[column] = found if found < best else best


def dilated(image: Bytes, before: int, after: int) -> Bytes:
    """Return the largest value (h, w) from `before` cells before to `after` cells after each cell.

    This holds for rows and columns. Outside the image are zeros.
    """
    for axis in (0, 1):
        pads = [(0, 0), (0, 0)]
        pads[axis] = before, after
        padded, length = np.pad(image, pads), image.shape[axis]
        shifted = (padded.take(range(k, k + length), axis) for k in range(before + after + 1))
        image = np.maximum.reduce(list(shifted))
    return image


@kernel
def connected_parts(mask: NDArray[np.bool_]) -> tuple[Ints, Ints]:
    """Return the set cells (n,) of `mask` as flat indices, part by part, and the parts' begins.

    Cells that touch, also at a corner, belong to one part. The second array (k + 1,) has the begin
    of each part, and n at its end. Parts are in the order of their first cells.
    """
    height, width = mask.shape
    left = mask.copy()
    count = left.sum()
    cells = np.empty(count, np.int64)
    begins = np.empty(count + 1, np.int64)
    parts = end = 0
    for first_row in range(height):
        for first_column in range(width):
            if not left[first_row, first_column]:
                continue
            begins[parts] = here = end
            parts += 1
            left[first_row, first_column] = False
            cells[end] = first_row * width + first_column
            end += 1
            while here < end:
                y, x = cells[here] // width, cells[here] % width
                for row in range(max(y - 1, 0), min(y + 2, height)):
                    for column in range(max(x - 1, 0), min(x + 2, width)):
                        if left[row, column]:
                            left[row, column] = False
                            cells[end] = row * width + column
                            end += 1
                here += 1
    begins[parts] = end
    return cells, begins[: parts + 1]
