"""Distance of a body's whole outline to the nearest obstacle."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.sweep import Corners, box
from gigabrain_zenoh.kernels.jit import lean_kernel

MAX_SPACING_M = 0.05  # between points of an outline that needs fewer than MAX_POINTS
MAX_POINTS = 500
GROUP_SIZE = 3  # neighbouring points that are skipped together: a middle one and its neighbours
MAX_SLOPE = 1.02  # change of the distance in the grid per metre
NEAREST_CELL_ERROR = 0.87  # [cells], of the distance of the nearest cell, besides MAX_SLOPE
MAX_CLEARANCE_M = 0.4  # a larger clearance counts as this one
MAX_DISTANCE_M = 3.0  # to obstacles; also outside the window


Singles = NDArray[np.float32]


class Outline(NamedTuple):
    """Footprint for kernels, in the body's frame."""

    groups: Singles  # (n, 7) [m]: x of three neighbours, their y, and the largest distance of the
    # outer two to the middle one; the last point is repeated to fill its group
    center_x: float  # [m], center of the bounding box
    center_y: float
    inner: float  # [m], radius of the largest circle round the center inside the outline
    outer: float  # [m], largest distance of the outline to the center
    front: float  # [m], edges of the bounding box
    rear: float
    left: float
    right: float
    far: float  # [m], largest distance of the outline to the body's origin


class Placement(NamedTuple):
    """Pose of a body, with the cosine and sine of its heading."""

    x: float  # [m]
    y: float
    cosine: float
    sine: float


class DistanceGrid(NamedTuple):
    """Distances to the nearest obstacle at cell centers, interpolated bilinearly."""

    distance: Singles  # (rows, columns) [m]
    cell: float  # [m], size of a cell
    x: float  # [m], of the corner of cell (0, 0)
    y: float


def outline_of(footprint: Corners) -> Outline:
    """Return the outline of a footprint, which may be any polygon."""
    corners = np.array(footprint, dtype=np.float64)
    sides = np.roll(corners, -1, axis=0) - corners
    spacing = max(MAX_SPACING_M, float(np.hypot(*sides.T).sum()) / MAX_POINTS)
    pieces = []
    for start, side in zip(corners, sides, strict=True):
        count = max(1, math.ceil(float(np.hypot(*side)) / spacing))
        pieces.append(start + side * (np.arange(count) / count)[:, None])
    front, rear, left, right = box(footprint)
    x, y = (front + rear) / 2, (left + right) / 2
    points = np.concatenate(pieces)
    outer = float(np.hypot(corners[:, 0] - x, corners[:, 1] - y).max())
    # inside the polygon itself, so that obstacles under a thin or hollow body count as well
    inner = float(np.hypot(points[:, 0] - x, points[:, 1] - y).min())
    far = float(np.hypot(*corners.T).max())
    points = np.pad(points, ((0, -len(points) % GROUP_SIZE), (0, 0)), mode="edge")
    threes = points.reshape(-1, GROUP_SIZE, 2)
    away = threes - threes[:, 1, None]
    reach = np.hypot(away[..., 0], away[..., 1]).max(axis=1)
    groups = np.column_stack([threes[..., 0], threes[..., 1], reach]).astype(np.float32)
    return Outline(groups, x, y, inner, outer, front, rear, left, right, far)


@lean_kernel
def distance_at(grid: DistanceGrid, x: float, y: float) -> float:
    """Return the distance [m] from (x, y) to the nearest obstacle."""
    per_cell = 1.0 / grid.cell
    return interpolate(grid.distance, (x - grid.x) * per_cell - 0.5, (y - grid.y) * per_cell - 0.5)


@lean_kernel
def interpolate(distance: Singles, u: float, v: float) -> float:
    """Interpolate `distance` (rows, columns) at column `u` and row `v`, in cells.

    The center of the first cell is (0, 0). Outside the grid the result is MAX_DISTANCE_M.
    """
    rows, columns = distance.shape
    if u < 0.0 or v < 0.0 or u >= columns - 1 or v >= rows - 1:
        return MAX_DISTANCE_M
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
    """Return the clearance [m], and the index of the group of points nearest to an obstacle.

    The clearance is the distance of the outline to the nearest obstacle. It is negative with an
    obstacle inside, and MAX_CLEARANCE_M at most. Group `first` is examined first: if it is the
    nearest, most others are skipped. `middle` is the result of `middle_of`.
    """
    if middle >= outline.outer + MAX_CLEARANCE_M:
        return MAX_CLEARANCE_M, first
    nearest = MAX_CLEARANCE_M
    if middle < outline.inner:
        nearest = min(nearest, middle - outline.inner)
    found, group = _nearest_group(grid, outline, at, np.float32(nearest), first)
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
def _nearest_group(
    grid: DistanceGrid, outline: Outline, at: Placement, nearest: np.float32, first: int
) -> tuple[float, int]:
    """Return the least of `nearest` and the distances of all points [m], and its group.

    A group is skipped when the distance of its middle shows that none of its points is nearer.
    """
    x, y, cosine, sine = at
    groups, cells, per_cell = outline.groups, grid.distance, 1.0 / grid.cell
    u, v = np.float32((x - grid.x) * per_cell - 0.5), np.float32((y - grid.y) * per_cell - 0.5)
    placed = (u, v, np.float32(cosine * per_cell), np.float32(sine * per_cell))
    half, cell_error = np.float32(0.5), np.float32(NEAREST_CELL_ERROR * grid.cell)
    best = first
    nearest = _group_distance(cells, groups[first], placed, nearest)
    for n in range(len(groups)):
        if n == first:
            continue
        group = groups[n]
        column, row = _cell_inside(cells, group[1], group[4], placed)
        middle_distance = cells[np.uint32(row + half), np.uint32(column + half)]
        if middle_distance - np.float32(MAX_SLOPE) * group[6] - cell_error < nearest:
            found = _group_distance(cells, group, placed, nearest)
            best = n if found < nearest else best
            nearest = found
    return float(nearest), best


@lean_kernel
def _group_distance(
    cells: Singles, group: Singles, placed: CellPlacement, nearest: np.float32
) -> np.float32:
    """Return the least of `nearest` and the distances of a group's points [m].

    A point outside the window counts as if it were on the rim.
    """
    one = np.uint32(1)  # unsigned, so that numba does not check for negative indices
    for n in range(GROUP_SIZE):
        column, row = _cell_inside(cells, group[n], group[n + GROUP_SIZE], placed)
        i, j = np.uint32(row), np.uint32(column)
        a, b = row - np.float32(i), column - np.float32(j)
        low = cells[i, j] + b * (cells[i, j + one] - cells[i, j])
        high = cells[i + one, j] + b * (cells[i + one, j + one] - cells[i + one, j])
        d = low + a * (high - low)
        nearest = d if d < nearest else nearest
    return nearest


@lean_kernel
def _cell_inside(
    cells: Singles, x: np.float32, y: np.float32, placed: CellPlacement
) -> tuple[np.float32, np.float32]:
    """Return column and row of point (x, y) of a body, limited to the grid."""
    (u, v, c, s), zero = placed, np.float32(0)
    last_u, last_v = np.float32(cells.shape[1] - 2), np.float32(cells.shape[0] - 2)
    return min(max(u + c * x - s * y, zero), last_u), min(max(v + s * x + c * y, zero), last_v)


@lean_kernel
def free_ahead(
    grid: DistanceGrid, outline: Outline, at: Placement, sign: float, side_margin: float,
    reach: float,
) -> float:  # fmt: skip
    """Return the free distance ahead, or behind for a `sign` of -1; `reach` [m] at most.

    The strip is as wide as the body with `side_margin` [m] on both sides. It is covered by discs,
    from the edge of the body on. The search ends at the rim of the grid.
    """
    x, y, cosine, sine = at
    half = (outline.left - outline.right) / 2
    edge = outline.front if sign > 0 else -outline.rear
    begin = edge - half
    covered, rows, columns = 0.0, grid.distance.shape[0], grid.distance.shape[1]
    end = min(reach, (rows + columns) * grid.cell + 2.0 * outline.far)
    while covered < end:
        along = sign * (begin + covered)
        px = x + cosine * along - sine * outline.center_y
        py = y + sine * along + cosine * outline.center_y
        room = distance_at(grid, px, py) - half - side_margin
        if room <= 0.0:
            return covered
        covered += max(room, 0.05)
    return reach


@lean_kernel
def free_along(
    grid: DistanceGrid, outline: Outline, at: Placement, direction: tuple[float, float],
    side_margin: float, reach: float,
) -> float:  # fmt: skip
    """Return the free distance in any direction, like `free_ahead`.

    `direction` is a unit vector in the body's frame.
    """
    x, y, cosine, sine = at
    long, wide = (outline.front - outline.rear) / 2, (outline.left - outline.right) / 2
    half = abs(direction[0]) * wide + abs(direction[1]) * long
    edge = min(long / max(abs(direction[0]), 1e-6), wide / max(abs(direction[1]), 1e-6))
    along_x = cosine * direction[0] - sine * direction[1]
    along_y = sine * direction[0] + cosine * direction[1]
    x += cosine * outline.center_x - sine * outline.center_y
    y += sine * outline.center_x + cosine * outline.center_y
    begin = edge - half
    covered, rows, columns = 0.0, grid.distance.shape[0], grid.distance.shape[1]
    end = min(reach, (rows + columns) * grid.cell + 2.0 * outline.far)
    while covered < end:
        px, py = x + along_x * (begin + covered), y + along_y * (begin + covered)
        room = distance_at(grid, px, py) - half - side_margin
        if room <= 0.0:
            return covered
        covered += max(room, 0.05)
    return reach
