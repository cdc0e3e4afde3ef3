"""The map round the robot that scans are matched to: points in buckets, and a likelihood image."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.mapping.points import Points, Scan
from gigabrain_zenoh.mapping.se2 import Floats

BUCKET = 0.15  # [m]
REACH = 30.0  # [m], points farther from the centre are left out
BLOCK = 4  # cells a side, of which only the likeliest counts at first

Ints = NDArray[np.int32]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Buckets:
    """Points with normals in square buckets, those of a bucket side by side."""

    points: Points  # (n, 2), sorted by bucket, row by row
    normals: Points  # (n, 2)
    starts: Ints  # (height * width + 1,): where a bucket's points begin
    width: int  # buckets
    origin: Floats  # (2,), the corner of bucket (0, 0) [m]


@dataclass(frozen=True, slots=True)
class Image:
    """How likely a hit is, by cell."""

    cells: Bytes  # (height, width), 0 to 255 for certain
    coarse: Bytes  # (height, width), the most of the block of cells that begins here
    origin: Floats  # (2,), the corner of cell (0, 0) [m]
    cell: float  # [m]


@dataclass(frozen=True, slots=True)
class LocalMap:
    """What scans are searched in, and laid onto."""

    image: Image
    buckets: Buckets


EMPTY = Buckets(
    np.empty((0, 2), np.float32),
    np.empty((0, 2), np.float32),
    np.zeros(2, np.int32),
    1,
    np.zeros(2),
)


def build(
    scans: Sequence[Scan], poses: Floats, centre: Floats, cell: float, sigma: float
) -> LocalMap:
    """The map of `scans` at `poses` (m, 3) within reach of `centre`.

    The likelihood of a hit is exp(-d²/2s²): d to the nearest point, s `sigma`. Scans are laid onto
    the means of what shares a cell. To choose one of it by the order of the beams would be wrong:
    of those along a wall the later are the nearer on one side and the farther on the other, and a
    robot between two walls would be turned a little by each scan.
    """
    points, normals, low, high = _placed(
        np.concatenate([scan.points for scan in scans]),
        np.concatenate([scan.normals for scan in scans]),
        np.array([len(scan.points) for scan in scans]),
        poses,
        np.array(centre),  # numba compiles anew for one that may not be written
    )
    if not len(points):
        nothing = np.zeros((1, 1), np.uint8)
        return LocalMap(Image(nothing, nothing, np.zeros(2), cell), EMPTY)
    blob = _blob(cell, sigma)
    origin = low.astype(np.float64) - len(blob) * cell
    width, height = ((high - origin) / cell).astype(int) + len(blob)
    cells = np.zeros((height, width), np.uint8)
    _stamp(cells, points, origin, cell, blob)
    coarse = cv2.dilate(cells, np.ones((BLOCK, BLOCK), np.uint8), anchor=(0, 0))
    image = Image(cells, np.asarray(coarse, np.uint8), origin, cell)
    return LocalMap(image, _buckets(*_merged(points, normals, origin, cell, height, width)))


@kernel
def _placed(
    points: Points, normals: Points, counts: NDArray[np.int64], poses: Floats, centre: Floats
) -> tuple[Points, Points, Points, Points]:
    """Points and normals of scans, so many of each, at their poses, and where they lie between.

    What is out of reach of `centre` is left out.
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
    points: Points, normals: Points, origin: Floats, cell: float, height: int, width: int
) -> tuple[Points, Points, Points, Points]:
    """The mean of the points with a normal in each cell, its normal, and where they lie between."""
    held = np.zeros((height, width), np.int32)  # which of the sums, counted from 1
    sums = np.zeros((len(points), 5))  # x, y, normal, how many
    n = 0
    for k in range(len(points)):
        (x, y), (nx, ny) = points[k], normals[k]
        if nx == 0 and ny == 0:
            continue
        row, column = int((y - origin[1]) / cell), int((x - origin[0]) / cell)
        if not held[row, column]:
            n += 1
            held[row, column] = n
        at = held[row, column] - 1
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
    for k in range(count):
        column = min(int((points[k, 0] - origin[0]) / size), width - 1)
        row = min(int((points[k, 1] - origin[1]) / size), height - 1)
        cell[k] = row * width + column
        starts[cell[k] + 1] += 1
    for b in range(width * height):
        starts[b + 1] += starts[b]
    filled = starts[:-1].copy()
    order = np.empty(count, np.int32)
    for k in range(count):
        order[filled[cell[k]]] = k
        filled[cell[k]] += 1
    return starts, order


def _blob(cell: float, sigma: float) -> Bytes:
    reach = int(np.ceil(2.5 * sigma / cell))
    along = np.arange(-reach, reach + 1) * cell
    likely = np.exp(-(along[:, None] ** 2 + along**2) / (2 * sigma**2))
    return np.asarray(np.rint(255 * likely), dtype=np.uint8)


@kernel
def _stamp(cells: Bytes, points: Points, origin: Floats, cell: float, blob: Bytes) -> None:
    """Put the blob on every cell that holds a point; the likelier counts."""
    side = len(blob)
    for k in range(len(points)):
        column = int((points[k, 0] - origin[0]) / cell)
        row = int((points[k, 1] - origin[1]) / cell)
        if cells[row, column] == 255:  # stamped before
            continue
        left, top = column - side // 2, row - side // 2
        for i in range(side):
            for j in range(side):
                cells[top + i, left + j] = max(cells[top + i, left + j], blob[i, j])
