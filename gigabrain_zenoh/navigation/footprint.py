"""How far the whole outline of a body is from the nearest obstacle."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import lean_kernel
from gigabrain_zenoh.sweep import Corners, box

SPACING = 0.05  # [m], between points on the outline at most
GROUP = 3  # neighbouring points that are left out together
STRETCH = 1.02  # a distance in the grid differs by no more than so many times the way,
UNSURE = 0.87  # and so many cells, between one that is looked up in the nearest cell and any other
ROOM = 0.4  # [m], more than that round the body makes no difference
FAR = 3.0  # [m], what is farther away, or beyond the window, does not matter


class Outline(NamedTuple):
    """A footprint as compiled functions take it, in the body's frame."""

    points: NDArray[np.float32]  # (2, n) [m], once round, the last repeated to fill its group
    reach: NDArray[np.float32]  # (n // GROUP,) [m], from the middle of each group to its others
    center_x: float  # [m], of the box around it
    center_y: float
    inner: float  # [m], radius of the largest circle round the center that is inside the box
    outer: float  # [m], how far it reaches from the center
    front: float  # [m], the box
    rear: float
    left: float
    right: float
    far: float  # [m], how far it reaches from the body's origin


class Grid(NamedTuple):
    """Distances to the nearest obstacle, bilinear between the centers of cells."""

    distance: NDArray[np.float32]  # (rows, columns) [m]
    cell: float  # [m]
    x: float  # [m], of the corner of cell (0, 0)
    y: float


def outline_of(footprint: Corners) -> Outline:
    """The outline of any polygon."""
    corners = np.array(footprint, dtype=np.float64)
    pieces = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.hypot(*(end - start)))
        count = max(1, math.ceil(length / SPACING))
        pieces.append(start + (end - start) * (np.arange(count) / count)[:, None])
    front, rear, left, right = box(footprint)
    x, y = (front + rear) / 2, (left + right) / 2
    points = np.concatenate(pieces)
    outer = float(np.hypot(corners[:, 0] - x, corners[:, 1] - y).max())
    # a polygon's own inside, so that what has got under a thin or hollow one counts as well
    inner = float(np.hypot(points[:, 0] - x, points[:, 1] - y).min())
    far = float(np.hypot(*corners.T).max())
    points = np.pad(points, ((0, -len(points) % GROUP), (0, 0)), mode="edge")
    groups = points.reshape(-1, GROUP, 2)
    away = groups - groups[:, GROUP // 2, None]
    reach = np.hypot(away[..., 0], away[..., 1]).max(axis=1).astype(np.float32)
    points = np.ascontiguousarray(points.T, dtype=np.float32)
    return Outline(points, reach, x, y, inner, outer, front, rear, left, right, far)


@lean_kernel
def distance_at(grid: Grid, x: float, y: float) -> float:
    """The distance [m] from (x, y) to the nearest obstacle."""
    rows, columns = grid.distance.shape
    per_cell = 1.0 / grid.cell
    u, v = (x - grid.x) * per_cell - 0.5, (y - grid.y) * per_cell - 0.5
    if u < 0.0 or v < 0.0 or u >= columns - 1 or v >= rows - 1:
        return FAR
    i, j, one = np.uint32(v), np.uint32(u), np.uint32(1)
    a, b = v - i, u - j
    d = grid.distance
    low = d[i, j] + b * (d[i, j + one] - d[i, j])
    high = d[i + one, j] + b * (d[i + one, j + one] - d[i + one, j])
    found: float = low + a * (high - low)
    return found


@lean_kernel
def clearance(
    grid: Grid, outline: Outline, x: float, y: float, cosine: float, sine: float
) -> float:
    """How far the outline at a pose is from the nearest obstacle [m]; below 0 with one inside.

    More than ROOM counts as ROOM.
    """
    return clearance_of(grid, outline, x, y, cosine, sine, 0)[0]


@lean_kernel
def clearance_of(
    grid: Grid, outline: Outline, x: float, y: float, cosine: float, sine: float, first: int
) -> tuple[float, int]:
    """The clearance, and the group of points that has it: looked at `first`, it spares others."""
    middle = _middle(grid, outline, x, y, cosine, sine)
    if middle >= outline.outer + ROOM:
        return ROOM, first
    nearest = min(ROOM, middle - outline.inner) if middle < outline.inner else ROOM
    found, group = _nearest(grid, outline, x, y, cosine, sine, np.float32(nearest), first)
    return min(nearest, found), group


@lean_kernel
def depth_of(grid: Grid, outline: Outline, x: float, y: float, cosine: float, sine: float) -> float:
    """What the clearance is no more than where an obstacle is well inside [m]; 0 elsewhere."""
    return min(0.0, _middle(grid, outline, x, y, cosine, sine) - outline.inner)


@lean_kernel
def _middle(grid: Grid, outline: Outline, x: float, y: float, cosine: float, sine: float) -> float:
    center_x = x + cosine * outline.center_x - sine * outline.center_y
    center_y = y + sine * outline.center_x + cosine * outline.center_y
    return distance_at(grid, center_x, center_y)


@lean_kernel
def _nearest(
    grid: Grid, outline: Outline, x: float, y: float, cosine: float, sine: float,
    nearest: np.float32, first: int,
) -> tuple[float, int]:  # fmt: skip
    """The least distance [m] of all points, if below `nearest`, and whose group it is.

    A group is left out when what its middle says leaves no room for anything nearer. A point
    beyond the window counts as if it were on its rim.
    """
    points, reach = outline.points, outline.reach
    rows, columns = grid.distance.shape
    cells, per_cell = grid.distance, 1.0 / grid.cell
    u0, v0 = np.float32((x - grid.x) * per_cell - 0.5), np.float32((y - grid.y) * per_cell - 0.5)
    c, s = np.float32(cosine * per_cell), np.float32(sine * per_cell)
    zero, last_u, last_v = np.float32(0), np.float32(columns - 2), np.float32(rows - 2)
    half, stretch = np.float32(0.5), np.float32(STRETCH)
    unsure = np.float32(UNSURE * grid.cell)
    one = np.uint32(1)  # unsigned: numba need not look for indices from the end
    best = first
    for at in range(-1, len(reach)):
        group = first if at < 0 else at
        if at == first:
            continue
        if at >= 0:
            px, py = points[0, GROUP * group + 1], points[1, GROUP * group + 1]
            u = min(max(u0 + c * px - s * py, zero), last_u)
            v = min(max(v0 + s * px + c * py, zero), last_v)
            there = cells[np.uint32(v + half), np.uint32(u + half)]
            if there - stretch * reach[group] - unsure >= nearest:
                continue
        for n in range(GROUP * group, GROUP * group + GROUP):
            px, py = points[0, n], points[1, n]
            u = min(max(u0 + c * px - s * py, zero), last_u)
            v = min(max(v0 + s * px + c * py, zero), last_v)
            i, j = np.uint32(v), np.uint32(u)
            a, b = v - np.float32(i), u - np.float32(j)
            low = cells[i, j] + b * (cells[i, j + one] - cells[i, j])
            high = cells[i + one, j] + b * (cells[i + one, j + one] - cells[i + one, j])
            d = low + a * (high - low)
            if d < nearest:
                nearest, best = d, group
    return float(nearest), best


@lean_kernel
def free_ahead(
    grid: Grid,
    outline: Outline,
    x: float,
    y: float,
    cosine: float,
    sine: float,
    sign: float,
    side_margin: float,
    reach: float,
) -> float:
    """How far the body can go straight on, or back for a `sign` of -1, within `reach` [m].

    As wide as the body and `side_margin` [m], followed by discs from the front edge on.
    """
    half = (outline.left - outline.right) / 2
    edge = outline.front if sign > 0 else -outline.rear
    begin = edge - half
    gone = 0.0
    while gone < reach:
        along = sign * (begin + gone)
        px = x + cosine * along - sine * outline.center_y
        py = y + sine * along + cosine * outline.center_y
        room = distance_at(grid, px, py) - half - side_margin
        if room <= 0.0:
            return gone
        gone += max(room, 0.05)
    return reach
