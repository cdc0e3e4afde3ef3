"""Polygons in the plane: corners (n, 2) [m]; the last one is joined to the first."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats

MIN_AREA_M2 = 1e-4


def problem(corners: Floats) -> str:
    """Return why corners are not a simple polygon; an empty text if they are."""
    if edges_cross(corners):
        return "its edges cross"
    return "it has no area" if abs(area(corners)) < MIN_AREA_M2 else ""


def area(corners: Floats) -> float:
    """Return the area [m2], negative for a clockwise polygon."""
    x, y = (corners - corners[0]).T  # avoids rounding far from the origin
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2


def edges_cross(corners: Floats) -> bool:
    """Return whether any two edges cross or touch, except neighbours at their corner."""
    begin, end = corners, np.roll(corners, -1, axis=0)
    count = len(corners)
    for first in range(count - 2):
        others = np.arange(first + 2, count - (first == 0))
        if len(others) and _intersect(begin[first], end[first], begin[others], end[others]).any():
            return True
    return False


def _intersect(a: Floats, b: Floats, c: Floats, d: Floats) -> NDArray[np.bool_]:
    """Return which of the segments `c`-`d`, (n, 2) each, meet the segment `a`-`b`."""
    of_c, of_d = _side(a, b, c), _side(a, b, d)
    of_a, of_b = _side(c, d, a), _side(c, d, b)
    boxes = (np.maximum(c, d) >= np.minimum(a, b)) & (np.minimum(c, d) <= np.maximum(a, b))
    found: NDArray[np.bool_] = (of_c * of_d <= 0) & (of_a * of_b <= 0) & boxes.all(axis=1)
    return found


def _side(a: Floats, b: Floats, point: Floats) -> Floats:
    """Return 1 where `point` is left of the line from `a` to `b`, -1 right of it, 0 on it."""
    along, off = b - a, point - a
    side: Floats = np.sign(along[..., 0] * off[..., 1] - along[..., 1] * off[..., 0])
    return side


def contains(corners: Floats, points: Floats) -> NDArray[np.bool_]:
    """Return which of `points` (m, 2) are inside, by the even-odd rule."""
    inside = np.zeros(len(points), np.bool_)
    x, y = points.T
    for (ax, ay), (bx, by) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        crossing = np.flatnonzero((ay > y) != (by > y))
        share = (y[crossing] - ay) / (by - ay)
        inside[crossing] ^= x[crossing] < ax + share * (bx - ax)
    return inside


def distance(corners: Floats, points: Floats) -> Floats:
    """Return the distance of each of `points` (m, 2) to the polygon [m]; 0 inside."""
    begin, along = corners, np.roll(corners, -1, axis=0) - corners
    length = np.maximum((along**2).sum(axis=1), 1e-12)
    off = points[:, None] - begin
    share = ((off * along).sum(axis=2) / length).clip(0, 1)
    away = off - share[..., None] * along
    nearest = np.hypot(away[..., 0], away[..., 1]).min(axis=1)
    found: Floats = np.where(contains(corners, points), 0.0, nearest)
    return found


def edges(polygons: Sequence[Floats]) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Return begins and ends of all edges, (n, 2) each, and the index of each polygon's first."""
    begin = np.concatenate(polygons)
    counts = np.array([len(one) for one in polygons])
    first = np.cumsum(counts) - counts
    following = np.arange(1, len(begin) + 1)
    following[first + counts - 1] = first
    return begin, begin[following], first


def points_on_edges(polygons: Sequence[Floats], step: float, most: int | None = None) -> Floats:
    """Return points (n, 2) on the edges of all `polygons`, corners included.

    They are at most `step` [m] apart, but an edge has at most `most` of them.
    """
    begin, end, _ = edges(polygons)
    length = np.hypot(*(end - begin).T)
    counts = np.clip(np.ceil(length / step), 1, most).astype(np.intp)
    edge, number = spread(counts)
    share = number / counts[edge]
    points: Floats = begin[edge] + share[:, None] * (end - begin)[edge]
    return points


def spread(counts: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Repeat each index `counts` (n,) times. Return the indices and the repetition numbers."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - np.repeat(np.cumsum(counts) - counts, counts)
