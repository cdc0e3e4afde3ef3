"""The map round the robot that scans are matched to: points in buckets, and a likelihood image."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.mapping.points import Points, Scan
from gigabrain_zenoh.mapping.se2 import Floats, transform

BUCKET = 0.15  # [m]
REACH = 30.0  # [m], points farther from the centre are left out

Ints = NDArray[np.int32]


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

    cells: NDArray[np.float32]  # (height, width), 0 to 1
    origin: Floats  # (2,), the corner of cell (0, 0) [m]
    cell: float  # [m]


def gather(scans: Sequence[Scan], poses: Floats, centre: Floats) -> tuple[Points, Points]:
    """The points of `scans` at `poses` (m, 3) within reach of `centre`, and their normals."""
    placed = zip(scans, poses, strict=True)
    points = np.concatenate([transform(pose, scan.points) for scan, pose in placed])
    placed = zip(scans, poses, strict=True)
    turned = [transform(pose * (0, 0, 1), scan.normals) for scan, pose in placed]
    near = (np.abs(points - centre[:2]) < REACH).all(axis=1)
    return points[near].astype(np.float32), np.concatenate(turned)[near].astype(np.float32)


def buckets(points: Points, normals: Points) -> Buckets:
    """Those of the points that have a normal, in buckets."""
    useful = normals.any(axis=1)
    points, normals = points[useful], normals[useful]
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


def image(points: Points, cell: float, sigma: float, margin: float) -> Image:
    """The likelihood exp(-d²/2s²) of a hit: d to the nearest of `points`, s `sigma`.

    Ends `margin` [m] beyond the points.
    """
    if not len(points):
        return Image(np.zeros((1, 1), np.float32), np.zeros(2), cell)
    origin = points.min(axis=0).astype(np.float64) - margin
    width, height = ((points.max(axis=0) + margin - origin) / cell).astype(int) + 1
    cells = np.zeros((height, width), np.float32)
    _stamp(cells, points, origin, cell, _blob(cell, sigma))
    return Image(cells, origin, cell)


def _blob(cell: float, sigma: float) -> NDArray[np.float32]:
    reach = int(np.ceil(2.5 * sigma / cell))
    along = np.arange(-reach, reach + 1) * cell
    return np.exp(-(along[:, None] ** 2 + along**2) / (2 * sigma**2)).astype(np.float32)


@kernel
def _stamp(
    cells: NDArray[np.float32],
    points: Points,
    origin: Floats,
    cell: float,
    blob: NDArray[np.float32],
) -> None:
    """Put the blob on every cell that holds a point; where blobs meet, the likelier counts."""
    height, width = cells.shape
    reach = len(blob) // 2
    for k in range(len(points)):
        column = int((points[k, 0] - origin[0]) / cell)
        row = int((points[k, 1] - origin[1]) / cell)
        inside = reach <= column < width - reach and reach <= row < height - reach
        if not inside or cells[row, column] >= 1.0:  # outside, or stamped before
            continue
        for i in range(2 * reach + 1):
            for j in range(2 * reach + 1):
                y, x = row - reach + i, column - reach + j
                cells[y, x] = max(cells[y, x], blob[i, j])
