"""Local map that scans are matched to: points in buckets, and a likelihood image."""

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

BUCKET = 0.15  # [m]
REACH = 30.0  # [m], points farther from the centre are left out
MARGIN = 24  # cells, for what is stamped on a map's rim
BLOCK = 4  # cells a side, of which only the likeliest counts at first
HASH = 0x9E3779B1  # D. Knuth's multiplicative hash, of 32 bits

Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]


class Buckets(NamedTuple):
    """Points with normals in square buckets, those of a bucket side by side."""

    points: Points  # (n, 2), sorted by bucket, row by row
    normals: Points  # (n, 2)
    starts: Ints  # (height * width + 1,): where a bucket's points begin
    width: int  # buckets
    origin: Floats  # (2,), the corner of bucket (0, 0) [m]


class LikelihoodImage(NamedTuple):
    """Likelihood of a hit by cell."""

    cells: Bytes  # (height, width), 0 to 255 for certain
    coarse: Bytes  # (height, width), the most of the block of cells that begins here
    origin: Floats  # (2,), the corner of cell (0, 0) [m]
    cell: float  # [m]


@dataclass(frozen=True, slots=True)
class LocalMap:
    """A map in both forms: an image to search, and points to match."""

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
    """Memory for the images of one map after the other: new memory takes longer than drawing."""
    side = int(2 * REACH / cell) + MARGIN
    return np.empty(2 * side * side, np.uint8)


def build(
    scans: Sequence[Scan],
    poses: Floats,
    centre: Floats,
    cell: float,
    sigma: float,
    room: Bytes | None = None,
) -> LocalMap:
    """Build the map of `scans` at `poses` (m, 3) within reach of `centre`.

    The likelihood of a hit is exp(-d²/2s²), with d the distance to the nearest point and s `sigma`.
    Scans are matched to the mean of the points in a cell. Choosing one point by beam order would be
    biased: along a wall the later beams are nearer on one side and farther on the other, so a robot
    between two walls would turn a little with each scan. The images use the memory `room`, see
    image_buffer.
    """
    points, normals, low, high = _placed(
        np.concatenate([scan.points for scan in scans]),
        np.concatenate([scan.normals for scan in scans]),
        np.array([len(scan.points) for scan in scans]),
        poses,
        np.array(centre),  # numba compiles again for read-only arrays
    )
    if not len(points):
        nothing = np.zeros((1, 1), np.uint8)
        return LocalMap(LikelihoodImage(nothing, nothing, np.zeros(2), cell), EMPTY)
    blob, wide = _blobs(cell, sigma)
    origin = low.astype(np.float64) - len(blob) * cell
    width, height = ((high - origin) / cell).astype(int) + len(blob)
    cells, coarse = _blank(height, width, room)
    image = LikelihoodImage(cells, coarse, origin, cell)
    _stamp(image, points, blob, wide)
    return LocalMap(image, _buckets(*_merged(points, normals, origin, cell, width)))


def _blank(height: int, width: int, room: Bytes | None) -> Bytes:
    if room is None or room.size < 2 * height * width:
        return np.zeros((2, height, width), np.uint8)
    blank = room[: 2 * height * width].reshape(2, height, width)
    blank.fill(0)
    return blank


@kernel
def _placed(
    points: Points, normals: Points, counts: NDArray[np.int64], poses: Floats, centre: Floats
) -> tuple[Points, Points, Points, Points]:
    """Transform points and normals of scans to their poses; return also the extent.

    `counts` is the number of each scan's points. Points out of reach of `centre` are left out.
    """
    moved, turned = np.empty_like(points), np.empty_like(normals)
    low, high = np.full(2, np.inf, np.float32), np.full(2, -np.inf, np.float32)
    first = n = 0
    for s in range(len(counts)):
        cos, sin = np.cos(poses[s, 2]), np.sin(poses[s, 2])
        for k in range(first, first + counts[s]):
            x = np.float32(poses[s, 0] + cos * points[k, 0] - sin * points[k, 1])
            y = np.float32(poses[s, 1] + sin * points[k, 0] + cos * points[k, 1])
            if not (abs(x - centre[0]) < REACH and abs(y - centre[1]) < REACH):
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
    width, height = ((high - origin) / BUCKET).astype(int) + 1
    starts, order = _sorted(points, origin, BUCKET, width, height)
    return Buckets(points[order], normals[order], starts, int(width), origin)


@kernel
def _merged(
    points: Points, normals: Points, origin: Floats, cell: float, width: int
) -> tuple[Points, Points, Points, Points]:
    """Return mean and normal of the points with a normal in each cell, and the extent."""
    bits = 1
    while 1 << bits < 2 * len(points):
        bits += 1
    last = (1 << bits) - 1
    held = np.full((last + 1, 2), -1, np.int32)  # a cell, and which of the sums; cells by hash
    sums = np.zeros((len(points), 5))  # x, y, normal, how many
    n = 0
    for k in range(len(points)):
        (x, y), (nx, ny) = points[k], normals[k]
        if nx == 0 and ny == 0:
            continue
        at_cell = int((y - origin[1]) / cell) * width + int((x - origin[0]) / cell)
        slot = (at_cell * HASH & 0xFFFFFFFF) >> (32 - bits)
        while held[slot, 0] != at_cell and held[slot, 0] >= 0:
            slot = (slot + 1) & last
        if held[slot, 0] < 0:
            held[slot, 0], held[slot, 1] = at_cell, n
            n += 1
        at = held[slot, 1]
        side = 1.0 if sums[at, 2] * nx + sums[at, 3] * ny >= 0 else -1.0  # signs say nothing
        sums[at, 0] += x
        sums[at, 1] += y
        sums[at, 2] += side * nx
        sums[at, 3] += side * ny
        sums[at, 4] += 1.0
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
def _sorted(
    points: Points, origin: Floats, size: float, width: int, height: int
) -> tuple[Ints, Ints]:
    """Counting sort: where each bucket begins, and the points in that order."""
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
    for k in range(count - 1, -1, -1):  # from where a bucket ends to where it begins
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
def _stamp(image: LikelihoodImage, points: Points, blob: Bytes, wide: Bytes) -> None:
    """Put the blobs on every cell that holds a point; the likelier counts."""
    half, rim, (cells, coarse, origin, cell) = len(blob) // 2, BLOCK - 1, image
    for k in range(len(points)):
        column = int((points[k, 0] - origin[0]) / cell)
        row = int((points[k, 1] - origin[1]) / cell)
        if cells[row, column] == 255:  # stamped before
            continue
        left, top = column - half, row - half
        _put(cells, blob, top, left)
        _put(coarse, wide, top - rim, left - rim)


@lean_kernel
def _put(cells: Bytes, blob: Bytes, top: int, left: int) -> None:
    for i in range(len(blob)):
        row, n = np.uint32(top + i), np.uint32(i)  # unsigned: numba need not look from the end
        for j in range(len(blob)):
            column = np.uint32(left + j)
            cells[row, column] = max(cells[row, column], blob[n, np.uint32(j)])
