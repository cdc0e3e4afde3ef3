"""Distance of a body's whole outline to the nearest obstacle."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.sweep import Corners, box
from gigabrain_zenoh.kernels.jit import lean_kernel

SPACING = 0.05  # [m], between points on the outline at most,
MAX_POINTS = 500  # unless there were more than so many: those of a long outline are farther apart
GROUP = 3  # neighbouring points that are left out together: two and one in the middle
STRETCH = 1.02  # a distance in the grid differs by no more than so many times the way,
UNSURE = 0.87  # and so many cells, between one that is looked up in the nearest cell and any other
MAX_CLEARANCE_M = 0.4  # [m], more than that round the body makes no difference
FAR = 3.0  # [m], what is farther away, or beyond the window, does not matter


Singles = NDArray[np.float32]


class Outline(NamedTuple):
    """A footprint as compiled functions take it, in the body's frame."""

    groups: Singles  # (n, 7) [m]: x and y of neighbours, and how far the outer two
    # are from the middle one at most; once round, the last repeated to fill its group
    center_x: float  # [m], of the box around it
    center_y: float
    inner: float  # [m], radius of the largest circle round the center that is inside the box
    outer: float  # [m], how far it reaches from the center
    front: float  # [m], the box
    rear: float
    left: float
    right: float
    far: float  # [m], how far it reaches from the body's origin


class Placement(NamedTuple):
    """Pose of a body, its heading as cosine and sine."""

    x: float  # [m]
    y: float
    cosine: float
    sine: float


class DistanceGrid(NamedTuple):
    """Distances to the nearest obstacle, bilinear between the centers of cells."""

    distance: Singles  # (rows, columns) [m]
    cell: float  # [m]
    x: float  # [m], of the corner of cell (0, 0)
    y: float


def outline_of(footprint: Corners) -> Outline:
    """Return the outline of any polygon."""
    corners = np.array(footprint, dtype=np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    spacing = max(SPACING, float(np.hypot(*sides.T).sum()) / MAX_POINTS)
    pieces = []
    for start, side in zip(corners, sides, strict=True):
        count = max(1, math.ceil(float(np.hypot(*side)) / spacing))
        pieces.append(start + side * (np.arange(count) / count)[:, None])
    front, rear, left, right = box(footprint)
    x, y = (front + rear) / 2, (left + right) / 2
    points = np.concatenate(pieces)
    outer = float(np.hypot(corners[:, 0] - x, corners[:, 1] - y).max())
    # a polygon's own inside, so that what has got under a thin or hollow one counts as well
    inner = float(np.hypot(points[:, 0] - x, points[:, 1] - y).min())
    far = float(np.hypot(*corners.T).max())
    points = np.pad(points, ((0, -len(points) % GROUP), (0, 0)), mode="edge")
    threes = points.reshape(-1, GROUP, 2)
    away = threes - threes[:, 1, None]
    reach = np.hypot(away[..., 0], away[..., 1]).max(axis=1)
    groups = np.column_stack([threes[..., 0], threes[..., 1], reach]).astype(np.float32)
    return Outline(groups, x, y, inner, outer, front, rear, left, right, far)


@lean_kernel
def distance_at(grid: DistanceGrid, x: float, y: float) -> float:
    """Return the distance [m] from (x, y) to the nearest obstacle."""
    per_cell = 1.0 / grid.cell
    return between(grid.distance, (x - grid.x) * per_cell - 0.5, (y - grid.y) * per_cell - 0.5)


@lean_kernel
def between(distance: Singles, u: float, v: float) -> float:
    """Interpolate `distance` (rows, columns) between cell centers, (0, 0) at the first."""
    rows, columns = distance.shape
    if u < 0.0 or v < 0.0 or u >= columns - 1 or v >= rows - 1:
        return FAR
    i, j, one = np.uint32(v), np.uint32(u), np.uint32(1)
    a, b = v - i, u - j
    low = distance[i, j] + b * (distance[i, j + one] - distance[i, j])
    high = distance[i + one, j] + b * (distance[i + one, j + one] - distance[i + one, j])
    found: float = low + a * (high - low)
    return found


@lean_kernel
def clearance_of(
    grid: DistanceGrid, outline: Outline, at: Placement, middle: float, first: int
) -> tuple[float, int]:
    """Return the clearance [m], and the group of points that has it.

    The clearance is the distance of the outline to the nearest obstacle, below 0 with one inside,
    and MAX_CLEARANCE_M at most. Groups are compared from `first` on, so that a good guess spares
    others. `middle` is the result of `middle_of`.
    """
    if middle >= outline.outer + MAX_CLEARANCE_M:
        return MAX_CLEARANCE_M, first
    nearest = MAX_CLEARANCE_M
    if middle < outline.inner:
        nearest = min(nearest, middle - outline.inner)
    found, group = _nearest(grid, outline, at, np.float32(nearest), first)
    return min(nearest, found), group


@lean_kernel
def middle_of(grid: DistanceGrid, outline: Outline, at: Placement) -> float:
    """Return the distance of the middle of the body's box to the nearest obstacle [m]."""
    x, y, cosine, sine = at
    center_x = x + cosine * outline.center_x - sine * outline.center_y
    center_y = y + sine * outline.center_x + cosine * outline.center_y
    return distance_at(grid, center_x, center_y)


CellPlacement = tuple[np.float32, np.float32, np.float32, np.float32]  # column, row, cosine, sine


@lean_kernel
def _nearest(
    grid: DistanceGrid, outline: Outline, at: Placement, nearest: np.float32, first: int
) -> tuple[float, int]:
    """Return the least distance [m] of all points, if below `nearest`, and its group.

    A group is left out when the distance of its middle leaves no room for anything nearer.
    """
    x, y, cosine, sine = at
    groups, cells, per_cell = outline.groups, grid.distance, 1.0 / grid.cell
    u, v = np.float32((x - grid.x) * per_cell - 0.5), np.float32((y - grid.y) * per_cell - 0.5)
    placed = (u, v, np.float32(cosine * per_cell), np.float32(sine * per_cell))
    half, unsure = np.float32(0.5), np.float32(UNSURE * grid.cell)
    best = first
    nearest = _least_of_group(cells, groups[first], placed, nearest)
    for n in range(len(groups)):
        if n == first:
            continue
        group = groups[n]
        column, row = _inside(cells, group[1], group[4], placed)
        there = cells[np.uint32(row + half), np.uint32(column + half)]
        if there - np.float32(STRETCH) * group[6] - unsure < nearest:
            found = _least_of_group(cells, group, placed, nearest)
            best = n if found < nearest else best
            nearest = found
    return float(nearest), best


@lean_kernel
def _least_of_group(
    cells: Singles, group: Singles, placed: CellPlacement, nearest: np.float32
) -> np.float32:
    """Return the least of `nearest` and the distances [m] of the points of a group.

    A point beyond the window counts as if it were on its rim.
    """
    one = np.uint32(1)  # unsigned: numba need not look for indices from the end
    for n in range(GROUP):
        column, row = _inside(cells, group[n], group[n + GROUP], placed)
        i, j = np.uint32(row), np.uint32(column)
        a, b = row - np.float32(i), column - np.float32(j)
        low = cells[i, j] + b * (cells[i, j + one] - cells[i, j])
        high = cells[i + one, j] + b * (cells[i + one, j + one] - cells[i + one, j])
        d = low + a * (high - low)
        nearest = d if d < nearest else nearest
    return nearest


@lean_kernel
def _inside(
    cells: Singles, x: np.float32, y: np.float32, placed: CellPlacement
) -> tuple[np.float32, np.float32]:
    """Return column and row of the point (x, y) of a body; on the rim for one beyond it."""
    (u, v, c, s), zero = placed, np.float32(0)
    last_u, last_v = np.float32(cells.shape[1] - 2), np.float32(cells.shape[0] - 2)
    return min(max(u + c * x - s * y, zero), last_u), min(max(v + s * x + c * y, zero), last_v)


@lean_kernel
def free_ahead(
    grid: DistanceGrid, outline: Outline, at: Placement, sign: float, side_margin: float,
    reach: float,
) -> float:  # fmt: skip
    """Return the free way straight on, or back for a `sign` of -1, within `reach` [m].

    The strip is as wide as the body and `side_margin` [m], and is covered by discs from the front
    edge on. The search ends at the rim of the grid, however far `reach` is.
    """
    x, y, cosine, sine = at
    half = (outline.left - outline.right) / 2
    edge = outline.front if sign > 0 else -outline.rear
    begin = edge - half
    gone, rows, columns = 0.0, grid.distance.shape[0], grid.distance.shape[1]
    end = min(reach, (rows + columns) * grid.cell + 2.0 * outline.far)
    while gone < end:
        along = sign * (begin + gone)
        px = x + cosine * along - sine * outline.center_y
        py = y + sine * along + cosine * outline.center_y
        room = distance_at(grid, px, py) - half - side_margin
        if room <= 0.0:
            return gone
        gone += max(room, 0.05)
    return reach


@lean_kernel
def free_along(
    grid: DistanceGrid, outline: Outline, at: Placement, way: tuple[float, float],
    side_margin: float, reach: float,
) -> float:  # fmt: skip
    """Return the free way in any direction of the body's frame, as `free_ahead` does ahead.

    `way` is that direction, of length 1.
    """
    x, y, cosine, sine = at
    long, wide = (outline.front - outline.rear) / 2, (outline.left - outline.right) / 2
    half = abs(way[0]) * wide + abs(way[1]) * long
    edge = min(long / max(abs(way[0]), 1e-6), wide / max(abs(way[1]), 1e-6))
    along_x = cosine * way[0] - sine * way[1]
    along_y = sine * way[0] + cosine * way[1]
    x += cosine * outline.center_x - sine * outline.center_y
    y += sine * outline.center_x + cosine * outline.center_y
    begin = edge - half
    gone, rows, columns = 0.0, grid.distance.shape[0], grid.distance.shape[1]
    end = min(reach, (rows + columns) * grid.cell + 2.0 * outline.far)
    while gone < end:
        px, py = x + along_x * (begin + gone), y + along_y * (begin + gone)
        room = distance_at(grid, px, py) - half - side_margin
        if room <= 0.0:
            return gone
        gone += max(room, 0.05)
    return reach
