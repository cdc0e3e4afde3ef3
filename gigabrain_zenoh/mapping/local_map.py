"""Local map for matching scans: points in buckets, and a likelihood image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel
from gigabrain_zenoh.mapping.keyframes import Points, Scan

BUCKET_M = 0.15
REACH_M = 30.0  # points farther from the centre, along x or y, are left out
MARGIN_CELLS = 24  # for blobs at the rim of a map
BLOCK = 4  # [cells], side of the blocks whose maximum bounds a search
HASH_FACTOR = 0x9E3779B1  # of D. Knuth's multiplicative hash, 32 bits

Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]


class Buckets(NamedTuple):
    """Points with normals, sorted into square buckets."""

    points: Points  # (n, 2), sorted by bucket, row by row
    normals: Points  # (n, 2)
    starts: Ints  # (height * width + 1,): index of each bucket's first point
    width: int  # [buckets]
    origin: Floats  # (2,), the corner of bucket (0, 0) [m]


class LikelihoodImage(NamedTuple):
    """Likelihood of a hit by cell."""

    cells: Bytes  # (height, width), 0 to 255 (certain)
    coarse: Bytes  # (height, width), maximum of the block of cells that begins here
    origin: Floats  # (2,), the corner of cell (0, 0) [m]
    cell: float  # [m]


@dataclass(frozen=True, slots=True)
class LocalMap:
    """A map as an image to search, and as points to match."""

    image: LikelihoodImage
    buckets: Buckets


EMPTY = Buckets(
    np.empty((0, 2), np.float32),
    np.empty((0, 2), np.float32),
    np.zeros(2, np.int32),
    1,
    np.zeros(2),
)


def image_buffer(cell: float) -> Bytes:
    """Return memory for the images of successive maps: allocating takes longer than drawing."""
    side = int(2 * REACH_M / cell) + MARGIN_CELLS
    return np.empty(2 * side * side, np.uint8)


def build(
    scans: Sequence[Scan],
    poses: Floats,
    centre: Floats,
    cell: float,
    sigma: float,
    buffer: Bytes | None = None,
) -> LocalMap:
    """Build the map of `scans` at `poses` (m, 3) within reach of `centre`.

    The likelihood of a hit is exp(-d²/2s²): d is the distance to the nearest point, s is `sigma`.
    Scans are matched to the mean of the points in a cell. Choosing one point by beam order would
    be biased: later beams are nearer on one wall and farther on the opposite one, so a robot
    between two walls would turn a little with each scan. `buffer` is memory from image_buffer.
    """
    points, normals, low, high = _transformed(
        np.concatenate([scan.points for scan in scans]),
        np.concatenate([scan.normals for scan in scans]),
        np.array([len(scan.points) for scan in scans]),
        poses,
        np.array(centre),  # numba compiles again for read-only arrays
    )
    if not len(points):
        blank_cell = np.zeros((1, 1), np.uint8)
        return LocalMap(LikelihoodImage(blank_cell, blank_cell, np.zeros(2), cell), EMPTY)
    blob, coarse_blob = _blobs(cell, sigma)
    origin = low.astype(np.float64) - len(blob) * cell
    width, height = ((high - origin) / cell).astype(int) + len(blob)
    cells, coarse = _zeroed(height, width, buffer)
    image = LikelihoodImage(cells, coarse, origin, cell)
    _stamp(image, points, blob, coarse_blob)
    return LocalMap(image, _buckets(*_mean_by_cell(points, normals, origin, cell, width)))


def _zeroed(height: int, width: int, buffer: Bytes | None) -> Bytes:
    if buffer is None or buffer.size < 2 * height * width:
        return np.zeros((2, height, width), np.uint8)
    zeroed = buffer[: 2 * height * width].reshape(2, height, width)
    zeroed.fill(0)
    return zeroed


@kernel
def _transformed(
    points: Points, normals: Points, counts: NDArray[np.int64], poses: Floats, centre: Floats
) -> tuple[Points, Points, Points, Points]:
    """Transform points and normals of scans by their poses; return also the extent.

    `counts` are the numbers of points per scan. Points out of reach of `centre` are left out.
    """
    moved, turned = np.empty_like(points), np.empty_like(normals)
    low, high = np.full(2, np.inf, np.float32), np.full(2, -np.inf, np.float32)
    first = n = 0
    for s in range(len(counts)):
        cos, sin = np.cos(poses[s, 2]), np.sin(poses[s, 2])
        for k in range(first, first + counts[s]):
            x = np.float32(poses[s, 0] + cos * points[k, 0] - sin * points[k, 1])
            y = np.float32(poses[s, 1] + sin * points[k, 0] + cos * points[k, 1])
            if not (abs(x - centre[0]) < REACH_M and abs(y - centre[1]) < REACH_M):
                continue
            moved[n, 0], moved[n, 1] = x, y
            turned[n, 0] = cos * normals[k, 0] - sin * normals[k, 1]
            turned[n, 1] = sin * normals[k, 0] + cos * normals[k, 1]
            low[0], low[1] = min(low[0], x), min(low[1], y)
            high[0], high[1] = max(high[0], x), max(high[1], y)
            n += 1
        first += counts[s]
    return moved[:n], turned[:n], low, high


def _buckets(points: Points, normals: Points, low: Points, high: Points) -> Buckets:
    if not len(points):
        return EMPTY
    origin = low.astype(np.float64)
    width, height = ((high - origin) / BUCKET_M).astype(int) + 1
    starts, order = _sort_by_bucket(points, origin, BUCKET_M, width, height)
    return Buckets(points[order], normals[order], starts, int(width), origin)


@kernel
def _mean_by_cell(
    points: Points, normals: Points, origin: Floats, cell: float, width: int
) -> tuple[Points, Points, Points, Points]:
    """Return the mean point and normal of each cell, and the extent; skip points without normal."""
    bits = 1
    while 1 << bits < 2 * len(points):
        bits += 1
    last = (1 << bits) - 1
    slots = np.full((last + 1, 2), -1, np.int32)  # hash table: a cell, and its row in sums
    sums = np.zeros((len(points), 5))  # x, y, normal, count
    n = 0
    for k in range(len(points)):
        (x, y), (nx, ny) = points[k], normals[k]
        if nx == 0 and ny == 0:
            continue
        cell_index = int((y - origin[1]) / cell) * width + int((x - origin[0]) / cell)
        slot = (cell_index * HASH_FACTOR & 0xFFFFFFFF) >> (32 - bits)
        while slots[slot, 0] != cell_index and slots[slot, 0] >= 0:
            slot = (slot + 1) & last
        if slots[slot, 0] < 0:
            slots[slot, 0], slots[slot, 1] = cell_index, n
            n += 1
        row = slots[slot, 1]
        side = 1.0 if sums[row, 2] * nx + sums[row, 3] * ny >= 0 else -1.0  # signs are arbitrary
        sums[row, 0] += x
        sums[row, 1] += y
        sums[row, 2] += side * nx
        sums[row, 3] += side * ny
        sums[row, 4] += 1.0
    means, along = np.empty((n, 2), np.float32), np.empty((n, 2), np.float32)
    low, high = np.full(2, np.inf, np.float32), np.full(2, -np.inf, np.float32)
    for i in range(n):
        length = np.sqrt(sums[i, 2] ** 2 + sums[i, 3] ** 2)
        for axis in range(2):
            means[i, axis] = sums[i, axis] / sums[i, 4]
            along[i, axis] = sums[i, 2 + axis] / length
            low[axis], high[axis] = min(low[axis], means[i, axis]), max(high[axis], means[i, axis])
    return means, along, low, high


@kernel
def _sort_by_bucket(
    points: Points, origin: Floats, size: float, width: int, height: int
) -> tuple[Ints, Ints]:
    """Return each bucket's first index, and the order of the points, by counting sort."""
    count = len(points)
    cell = np.empty(count, np.int32)
    starts = np.zeros(width * height + 1, np.int32)
    starts[-1] = count
    for k in range(count):
        column = min(int((points[k, 0] - origin[0]) / size), width - 1)
        row = min(int((points[k, 1] - origin[1]) / size), height - 1)
        cell[k] = row * width + column
        starts[cell[k]] += 1
    for b in range(1, width * height):
        starts[b] += starts[b - 1]
    order = np.empty(count, np.int32)
    for k in range(count - 1, -1, -1):  # each bucket is filled from its end
        starts[cell[k]] -= 1
        order[starts[cell[k]]] = k
    return starts, order


@lru_cache(maxsize=4)
def _blobs(cell: float, sigma: float) -> tuple[Bytes, Bytes]:
    """Return the likelihood of hits around a point (n, n), and the maximum of each block."""
    reach = int(np.ceil(2.5 * sigma / cell))
    along = np.arange(-reach, reach + 1) * cell
    likely = np.exp(-(along[:, None] ** 2 + along**2) / (2 * sigma**2))
    blob = np.asarray(np.rint(255 * likely), dtype=np.uint8)
    blocks = sliding_window_view(np.pad(blob, BLOCK - 1), (BLOCK, BLOCK))
    return blob, np.ascontiguousarray(blocks.max(axis=(2, 3)))


@kernel
def _stamp(image: LikelihoodImage, points: Points, blob: Bytes, coarse_blob: Bytes) -> None:
    """Draw the blobs at every cell that holds a point, by maximum."""
    half, rim, (cells, coarse, origin, cell) = len(blob) // 2, BLOCK - 1, image
    for k in range(len(points)):
        column = int((points[k, 0] - origin[0]) / cell)
        row = int((points[k, 1] - origin[1]) / cell)
        if cells[row, column] == 255:  # stamped before
            continue
        left, top = column - half, row - half
        _put(cells, blob, top, left)
        _put(coarse, coarse_blob, top - rim, left - rim)


@lean_kernel
def _put(cells: Bytes, blob: Bytes, top: int, left: int) -> None:
    for i in range(len(blob)):
        row, n = np.uint32(top + i), np.uint32(i)  # unsigned: no negative indices for numba
        for j in range(len(blob)):
            column = np.uint32(left + j)
            cells[row, column] = max(cells[row, column], blob[n, np.uint32(j)])
