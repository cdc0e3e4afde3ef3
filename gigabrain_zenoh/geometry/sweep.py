"""Free distance of a footprint until it touches a point: straight, turning or along an arc.

Points (n, 2) [m] are in the body's frame. The footprint's convex hull is used.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats

Corners = tuple[tuple[float, float], ...]

STEP = 0.02  # [m], maximum motion of any part of the body between two checks
MAX_STEPS = 1000  # checks along one path; longer paths use longer steps
BATCH_SIZE = 1_000_000  # distances from points to edges per batch, to bound memory
MAX_APPROACH = 0.005  # [m], by which a point already within the margin may come closer


class Edges(NamedTuple):
    """Edges of a hull: outward normals (e, 2), and their distances from the origin (e,) [m]."""

    normals: Floats
    offsets: Floats


class Box(NamedTuple):
    """Extent of a footprint along the body's axes [m]."""

    front: float
    rear: float
    left: float
    right: float


@lru_cache(maxsize=8)
def box(footprint: Corners) -> Box:
    """Return the extent of `footprint`."""
    xs, ys = [x for x, _ in footprint], [y for _, y in footprint]
    return Box(max(xs), min(xs), max(ys), min(ys))


@lru_cache(maxsize=8)
def radius(footprint: Corners) -> float:
    """Return the radius that the footprint sweeps when it turns on the spot [m]."""
    return max(math.hypot(x, y) for x, y in footprint)


@lru_cache(maxsize=8)
def edges(footprint: Corners) -> Edges:
    """Return the edges of the convex hull, by Andrew's monotone chain."""
    corners = sorted(set(footprint))
    hull = _chain(corners)[:-1] + _chain(corners[::-1])[:-1]
    here = np.array(hull)
    along = np.roll(here, -1, axis=0) - here
    normals = np.stack([along[:, 1], -along[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Edges(normals, np.einsum("ij,ij->i", normals, here))


def _chain(corners: list[tuple[float, float]]) -> list[tuple[float, float]]:
    chain: list[tuple[float, float]] = []
    for corner in corners:
        while len(chain) > 1 and _right_turn(chain[-2], chain[-1], corner):
            chain.pop()
        chain.append(corner)
    return chain


def _right_turn(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])


def depth(hull: Edges, points: Floats) -> Floats:
    """Return a lower bound of the distance of `points` (..., 2) to the hull [m]; < 0 inside."""
    found: Floats = (points @ hull.normals.T - hull.offsets).max(axis=-1)
    return found


def straight(footprint: Corners, points: Floats, margin: float) -> tuple[float | None, ...]:
    """Return the free distances forwards, backwards, left and right [m]; None without a point.

    A `margin` [m] is kept free on both sides of the body. Points next to the body, within that
    margin, are no obstacle.
    """
    front, rear, left, right = box(footprint)
    x, y = points[:, 0], points[:, 1]
    return (
        *_both_ways(x, y, (rear, front), (right, left), margin),
        *_both_ways(y, x, (right, left), (rear, front), margin),
    )


def _both_ways(
    along: Floats,
    across: Floats,
    length: tuple[float, float],
    width: tuple[float, float],
    margin: float,
) -> tuple[float | None, float | None]:
    """Return the distances from a body to the nearest points in its strip, ahead and behind.

    The body covers `length` along the strip and `width` across. A point inside the footprint counts
    as ahead or behind, by the half that it is in.
    """
    (rear, front), (low, high) = length, width
    strip = (across >= low - margin) & (across <= high + margin)
    along, across = along[strip], across[strip]
    inside = (along >= rear) & (along <= front) & (across >= low) & (across <= high)
    ahead = along[(along > front) | (inside & (along > 0))] - front
    behind = rear - along[(along < rear) | (inside & (along < 0))]
    return _shortest(ahead), _shortest(behind)


def _shortest(ways: Floats) -> float | None:
    return max(0.0, float(ways.min())) if ways.size else None


def turning(
    footprint: Corners, points: Floats, margin: float, reach: float
) -> tuple[float | None, float | None]:
    """Return the free angles to the left and right [rad] within `reach` [rad]; None if all free."""
    outer = radius(footprint)
    near = points[np.hypot(points[:, 0], points[:, 1]) <= outer + margin]
    if not len(near):
        return None, None
    angles = _steps(min(reach, math.tau), STEP / outer)
    zeros = np.zeros_like(angles)
    return (
        _free_way(footprint, near, margin, angles, (zeros, zeros, angles)),
        _free_way(footprint, near, margin, angles, (zeros, zeros, -angles)),
    )


def arc(
    footprint: Corners,
    points: Floats,
    margin: float,
    reach: float,
    twist: tuple[float, float, float],
) -> float | None:
    """Return the free distance [m] within `reach` [m] along the arc of a twist (vx, vy, w).

    The twist must not be a turn on the spot. None if the body touches nothing.
    """
    vx, vy, w = twist
    speed = math.hypot(vx, vy)
    outer = radius(footprint)
    near = points[np.hypot(points[:, 0], points[:, 1]) <= outer + margin + reach]
    if not len(near):
        return None
    max_corner_speed = speed + abs(w) * outer  # upper bound of the speed of any corner
    ways = _steps(reach, STEP * speed / max_corner_speed)
    yaw = ways * (w / speed)
    if abs(w) < 1e-6:
        sine, cosine = ways / speed, np.zeros_like(ways)
    else:
        sine, cosine = np.sin(yaw) / w, (1.0 - np.cos(yaw)) / w
    x, y = vx * sine - vy * cosine, vx * cosine + vy * sine
    return _free_way(footprint, near, margin, ways, (x, y, yaw))


def _steps(reach: float, step: float) -> Floats:
    step = max(step, reach / MAX_STEPS)
    return np.arange(0.0, reach + step, step)


def _free_way(
    footprint: Corners,
    points: Floats,
    margin: float,
    ways: Floats,
    poses: tuple[Floats, Floats, Floats],
) -> float | None:
    """Return the last of `ways` (k,) before the footprint touches a point; None if it never does.

    The footprint's `poses` there are x, y and yaw, (k,) each.

    A point that is within the margin from the start is touched when the body comes closer to it.
    Points inside the footprint are ignored, so that the body can turn away from them. `straight`
    takes them into account.
    """
    hull, (x, y, yaw) = edges(footprint), poses
    begin = depth(hull, points)
    points, begin = points[begin > MAX_APPROACH], begin[begin > MAX_APPROACH]
    if not len(points):
        return None
    allowed = np.minimum(margin, begin - MAX_APPROACH)
    batch = max(1, BATCH_SIZE // (len(points) * len(hull.offsets)))
    for first in range(0, len(ways), batch):
        part = slice(first, first + batch)
        dx, dy = points[:, 0] - x[part, None], points[:, 1] - y[part, None]
        cosine, sine = np.cos(yaw[part])[:, None], np.sin(yaw[part])[:, None]
        seen = np.stack([cosine * dx + sine * dy, cosine * dy - sine * dx], axis=-1)
        touched = np.flatnonzero((depth(hull, seen) < allowed).any(axis=1))
        if touched.size:
            return float(ways[max(0, first + touched[0] - 1)])
    return None
