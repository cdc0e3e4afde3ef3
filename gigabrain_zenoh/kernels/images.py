"""Operations on grids of cells: distances, dilation and connected parts.

The capped distance transform is exact, like that of OpenCV. For 200 x 200 cells and a cap of 16, it
takes 0.08 ms, OpenCV 0.28 ms. OpenCV would also take 160 MB of memory.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.jit import kernel

OCCUPIED_PERCENT = 50  # least value of an occupied cell
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
            distance = above[column] + one
            distance = cap if distance > cap else distance
            distance = zero if cells[row, column] >= OCCUPIED_PERCENT else distance
            above[column] = distance
            out[row, column] = distance
    above[:] = cap
    for row in range(cells.shape[0] - 1, -1, -1):
        for column in range(cells.shape[1]):
            distance, from_above = above[column] + one, out[row, column]
            distance = from_above if from_above < distance else distance
            above[column] = distance
            out[row, column] = distance


@kernel
def _along_rows(out: Singles, cap: int) -> None:
    """Turn distances within columns into squared distances in the plane.

    Each is combined with those up to `cap` cells left and right of it. Loops over slices are
    vectorised; loops over indices are not.
    """
    width = out.shape[1]
    largest = np.float32(cap * cap)
    padded = np.full(width + 2 * cap, largest, np.float32)
    for row in range(out.shape[0]):
        line = out[row]
        has_obstacle = False
        for column in range(width):
            square = line[column] * line[column]
            has_obstacle |= square < largest
            line[column] = square
        if not has_obstacle:
            continue
        centre = padded[cap : cap + width]
        for column in range(width):  # numba needs seconds to compile the assignment of a slice
            centre[column] = line[column]
        for offset in range(1, cap):
            left = padded[cap - offset : cap - offset + width]
            right = padded[cap + offset : cap + offset + width]
            offset_squared = np.float32(offset * offset)
            for column in range(width):
                a, b, best = left[column], right[column], line[column]
                candidate = (a if a < b else b) + offset_squared
                line[column] = candidate if candidate < best else best


def dilated(image: Bytes, before: int, after: int) -> Bytes:
    """Return the largest value (h, w) from `before` cells before to `after` cells after each cell.

    The window covers rows and columns. Cells outside the image count as 0.
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
    """Return the set cells (n,) of `mask` as flat indices, part by part, and each part's start.

    Cells that touch, also at a corner, belong to one part. The second array (k + 1,) has the start
    of each part, and n at its end. Parts are in the order of their first cells.
    """
    height, width = mask.shape
    unvisited = mask.copy()
    count = unvisited.sum()
    cells = np.empty(count, np.int64)
    starts = np.empty(count + 1, np.int64)
    parts = end = 0
    for first_row in range(height):
        for first_column in range(width):
            if not unvisited[first_row, first_column]:
                continue
            starts[parts] = current = end
            parts += 1
            unvisited[first_row, first_column] = False
            cells[end] = first_row * width + first_column
            end += 1
            while current < end:
                y, x = cells[current] // width, cells[current] % width
                for row in range(max(y - 1, 0), min(y + 2, height)):
                    for column in range(max(x - 1, 0), min(x + 2, width)):
                        if unvisited[row, column]:
                            unvisited[row, column] = False
                            cells[end] = row * width + column
                            end += 1
                current += 1
    starts[parts] = end
    return cells, starts[: parts + 1]
