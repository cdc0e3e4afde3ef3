"""A scan as points with normals: what is matched, and what a map is drawn from."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.kernels.kernel import kernel

Points = NDArray[np.float32]

NEIGHBOUR = 0.4  # [m], a point farther away lies on something else
SPREAD, FARTHEST = 2.5, 1.2  # unless beams are so many times farther apart there; and [m]
SPAN = 0.12  # [m], a normal rests on neighbours at least so far to either side, where there are any
LEAST, MOST = 3, 10  # neighbours on either side
FEWEST = 3  # points under a normal


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan in the body's frame. Points are in the order of the beams, which normals need."""

    points: Points  # [m], (n, 2): where beams hit
    normals: Points  # (n, 2), unit length, sign unknown; zeros where there is none
    free: Points  # [m], (m, 2): how far beams that hit nothing are known to be free

    @classmethod
    def of(cls, points: NDArray[np.floating], free: NDArray[np.floating] | None = None) -> "Scan":
        """The scan with these hits, (n, 2) in beam order; ValueError for another shape or NaN."""
        kept = pairs("points", points)
        ends = np.empty((0, 2), np.float32) if free is None else pairs("free", free)
        return cls(kept, normals(kept), ends)


def pairs(name: str, values: NDArray[np.floating]) -> Points:
    """A copy of `values` as (n, 2) points; ValueError for another shape or NaN."""
    if values.ndim != 2 or values.shape[1] != 2:
        raise ValueError(f"{name}: expected shape (n, 2), got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite numbers")
    return np.array(values, np.float32, order="C")  # a copy: the caller's buffer may be a message


def from_beams(
    angles: Floats, ranges: Floats, range_min: float, range_max: float, free_range: float = 0.0
) -> Scan:
    """The scan of beams at `angles` [rad]; ValueError unless there are as many `ranges` [m].

    A beam that hit nothing within `range_max` counts as free up to `free_range`. One that is nearer
    than `range_min`, or NaN, says nothing.
    """
    if angles.shape != ranges.shape or angles.ndim != 1:
        raise ValueError(f"expected {angles.shape[0]} ranges, got {ranges.shape}")
    hit = (ranges > range_min) & (ranges < range_max)
    clear = (ranges >= range_max) & (free_range > 0)
    ways = np.column_stack((np.cos(angles), np.sin(angles)))
    return Scan.of(ways[hit] * ranges[hit, None], ways[clear] * free_range)


def thinned(points: Points, most: int) -> Points:
    """At most so many of the points, evenly by beam."""
    if len(points) <= most:
        return points
    return points[_evenly(len(points), most)]


@lru_cache(maxsize=256)
def _evenly(count: int, most: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, most).astype(np.intp)


def normals(points: Points) -> Points:
    """The normal at each point, from the line through its neighbours in beam order."""
    if len(points) < FEWEST:
        return np.zeros_like(points)
    bearings = np.arctan2(points[:, 1], points[:, 0])
    apart = np.sort(np.abs(np.diff(bearings)))
    median = (apart[(len(apart) - 1) // 2] + apart[len(apart) // 2]) / 2
    return _normals(points, float(median))


@kernel
def _normals(points: Points, between: float) -> Points:
    """`between` [rad] beams: where they are far apart, so are neighbours on a line."""
    count = len(points)
    found = np.zeros((count, 2), np.float32)
    for k in range(count):
        n, sx, sy, sxx, syy, sxy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
        range_ = np.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2)
        most_away = min(max(NEIGHBOUR, SPREAD * between * range_), FARTHEST)
        for side in (-1, 1):
            for step in range(1, min(MOST, count - 1) + 1):
                j = (k + side * step) % count
                dx, dy = points[j, 0] - points[k, 0], points[j, 1] - points[k, 1]
                away = np.sqrt(dx * dx + dy * dy)
                if away < most_away:
                    n += 1
                    sx, sy = sx + dx, sy + dy
                    sxx, syy, sxy = sxx + dx * dx, syy + dy * dy, sxy + dx * dy
                if step >= LEAST and away >= SPAN:
                    break
        if n >= FEWEST:
            xx, yy, xy = sxx - sx * sx / n, syy - sy * sy / n, sxy - sx * sy / n
            along = 0.5 * np.arctan2(2 * xy, xx - yy)  # the principal axis
            found[k, 0], found[k, 1] = -np.sin(along), np.cos(along)
    return found
