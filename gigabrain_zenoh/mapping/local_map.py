"""The map round the robot that scans are matched to: points in buckets, and a likelihood image."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.mapping.points import Points, Scan
from gigabrain_zenoh.mapping.se2 import Floats

BUCKET = 0.15  # [m]
REACH = 30.0  # [m], points farther from the centre are left out

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
    origin: Floats  # (2,), the corner of cell (0, 0) [m]
    cell: float  # [m]


@dataclass(frozen=True, slots=True)
class LocalMap:
    """What scans are searched in, and laid onto."""

    image: Image
    buckets: Buckets


def build(
    scans: Sequence[Scan], poses: Floats, centre: Floats, cell: float, sigma: float
) -> LocalMap:
    """The map of `scans` at `poses` (m, 3) within reach of `centre`.

    The likelihood of a hit is exp(-d²/2s²): d to the nearest point, s `sigma`. Where several points
    share a cell, the last is laid onto.
    """
    points, normals = _placed(
        np.concatenate([scan.points for scan in scans]),
        np.concatenate([scan.normals for scan in scans]),
        np.array([len(scan.points) for scan in scans]),
        poses,
    )
    near = (np.abs(points - centre[:2]) < REACH).all(axis=1)
    points, normals = points[near], normals[near]
    if not len(points):
        empty = Image(np.zeros((1, 1), np.uint8), np.zeros(2), cell)
        return LocalMap(empty, _buckets(points, normals))
    blob = _blob(cell, sigma)
    origin = points.min(axis=0).astype(np.float64) - len(blob) * cell
    width, height = ((points.max(axis=0) - origin) / cell).astype(int) + len(blob)
    cells = np.zeros((height, width), np.uint8)
    last = _stamp(cells, points, origin, cell, blob)
    kept = last & normals.any(axis=1)
    return LocalMap(Image(cells, origin, cell), _buckets(points[kept], normals[kept]))


@kernel
def _placed(
    points: Points, normals: Points, counts: NDArray[np.int64], poses: Floats
) -> tuple[Points, Points]:
    """Points and normals of scans, so many of each, at their poses."""
    moved, turned = np.empty_like(points), np.empty_like(normals)
    k = 0
    for s in range(len(counts)):
        cos, sin = np.cos(poses[s, 2]), np.sin(poses[s, 2])
        for _ in range(counts[s]):
            moved[k, 0] = poses[s, 0] + cos * points[k, 0] - sin * points[k, 1]
            moved[k, 1] = poses[s, 1] + sin * points[k, 0] + cos * points[k, 1]
            turned[k, 0] = cos * normals[k, 0] - sin * normals[k, 1]
            turned[k, 1] = sin * normals[k, 0] + cos * normals[k, 1]
            k += 1
    return moved, turned


def _buckets(points: Points, normals: Points) -> Buckets:
    if not len(points):
        return Buckets(points, normals, np.zeros(2, np.int32), 1, np.zeros(2))
    origin = points.min(axis=0).astype(np.float64)
    width, height = ((points.max(axis=0) - origin) / BUCKET).astype(int) + 1
    starts, order = _sorted(points, origin, BUCKET, width, height)
    return Buckets(points[order], normals[order], starts, int(width), origin)


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
def _stamp(
    cells: Bytes,
    points: Points,
    origin: Floats,
    cell: float,
    blob: Bytes,
) -> NDArray[np.bool_]:
    """Put the blob on every cell that holds a point, the likelier counts; who is last in a cell."""
    side = len(blob)
    last = np.zeros(len(points), np.bool_)
    for k in range(len(points) - 1, -1, -1):
        column = int((points[k, 0] - origin[0]) / cell)
        row = int((points[k, 1] - origin[1]) / cell)
        if cells[row, column] == 255:  # stamped before
            continue
        last[k] = True
        left, top = column - side // 2, row - side // 2
        for i in range(side):
            for j in range(side):
                cells[top + i, left + j] = max(cells[top + i, left + j], blob[i, j])
    return last
