"""Scans as points with normals, keyframes made of them, and both as arrays to save."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.scan import median
from gigabrain_zenoh.kernels.jit import kernel

Points = NDArray[np.float32]
NEIGHBOUR = 0.4  # [m], a point farther away lies on something else
SPREAD, FARTHEST = 2.5, 1.2  # unless beams are so many times farther apart there; and [m]
SPAN = 0.12  # [m], a normal rests on neighbours at least so far to either side, where there are any
MIN_NEIGHBOURS, MAX_NEIGHBOURS = 3, 10  # neighbours on either side
MIN_POINTS = 3  # points under a normal

BINS = 360  # of bearing
MARGIN = 0.3  # [m], what lies nearer than a beam's end by less was hit by it
MIN_SEEN_POINTS = 20  # points in view; fewer prove nothing

Arrays = Mapping[str, NDArray[np.generic]]
REACH_M = 200.0  # of a beam: what it passes is drawn cell by cell


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan in the body's frame. Points are in the order of the beams, which normals need."""

    points: Points  # [m], (n, 2): where beams hit
    normals: Points  # (n, 2), unit length, sign unknown; zeros where unknown
    free: Points  # [m], (m, 2): how far beams that hit nothing are known to be free

    @classmethod
    def of(cls, points: NDArray[np.floating], free: NDArray[np.floating] | None = None) -> "Scan":
        """Make a scan of hits (n, 2) in beam order; ValueError for another shape or NaN.

        Hits beyond REACH_M are left out: no map could be loaded with them.
        """
        kept = pairs("points", points)
        near = np.abs(kept) <= REACH_M
        kept = kept if near.all() else kept[near.all(axis=1)]
        ends = np.empty((0, 2), np.float32) if free is None else pairs("free", free)
        return cls(kept, normals(kept), ends)


class Beams(NamedTuple):
    """Ends of a scan's beams in the body's frame [m]."""

    hits: Points  # (n, 2)
    free: Points  # (m, 2): how far beams that hit nothing are known to be free
    sensor: Floats  # (2,): where they start


@dataclass(frozen=True, slots=True)
class View:
    """One scan in the body's frame."""

    scan: Scan
    sensor: Floats  # (2,) [m], where the beams start

    @property
    def beams(self) -> Beams:
        """The beams of the scan, without its normals."""
        return Beams(self.scan.points, self.scan.free, self.sensor)


def pairs(name: str, values: NDArray[np.floating]) -> Points:
    """Return a copy of `values` as (n, 2) points; ValueError for another shape or NaN."""
    if values.ndim != 2 or values.shape[1] != 2:
        raise ValueError(f"{name}: expected shape (n, 2), got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite numbers")
    return np.array(values, np.float32, order="C")  # a copy: the caller's buffer may be a message


def from_beams(
    angles: Floats, ranges: Floats, range_min: float, range_max: float, free_range: float = 0.0
) -> Scan:
    """Return the scan of beams at `angles` [rad]; ValueError unless `ranges` [m] match.

    A beam that hit nothing within `range_max` counts as free up to `free_range`. One shorter than
    `range_min`, or NaN, is left out.
    """
    if angles.shape != ranges.shape or angles.ndim != 1:
        raise ValueError(f"expected {angles.shape[0]} ranges, got {ranges.shape}")
    hit = (ranges > range_min) & (ranges < range_max)
    clear = (ranges >= range_max) & (free_range > 0)
    ways = np.column_stack((np.cos(angles), np.sin(angles)))
    return Scan.of(ways[hit] * ranges[hit, None], ways[clear] * free_range)


def thinned(points: Points, most: int) -> Points:
    """Return at most `most` of the points, evenly spaced by beam."""
    if len(points) <= most:
        return points
    return points[_evenly(len(points), most)]


@lru_cache(maxsize=256)
def _evenly(count: int, most: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, most).astype(np.intp)


def normals(points: Points) -> Points:
    """Return the normal at each point, of the line through its neighbours in beam order."""
    if len(points) < MIN_POINTS:
        return np.zeros_like(points)
    bearings = np.arctan2(points[:, 1], points[:, 0])
    return _normals(points, median(np.abs(np.diff(bearings))))


@kernel
def _normals(points: Points, between: float) -> Points:
    """Fit lines; where beams, `between` [rad] apart, are far apart, so are neighbours."""
    count = len(points)
    found = np.zeros((count, 2), np.float32)
    for k in range(count):
        n, sx, sy, sxx, syy, sxy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
        range_ = np.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2)
        most_away = min(max(NEIGHBOUR, SPREAD * between * range_), FARTHEST)
        for side in (-1, 1):
            for step in range(1, min(MAX_NEIGHBOURS, count - 1) + 1):
                j = (k + side * step) % count
                dx, dy = points[j, 0] - points[k, 0], points[j, 1] - points[k, 1]
                away = np.sqrt(dx * dx + dy * dy)
                if away < most_away:
                    n += 1
                    sx, sy = sx + dx, sy + dy
                    sxx, syy, sxy = sxx + dx * dx, syy + dy * dy, sxy + dx * dy
                if step >= MIN_NEIGHBOURS and away >= SPAN:
                    break
        if n >= MIN_POINTS:
            xx, yy, xy = sxx - sx * sx / n, syy - sy * sy / n, sxy - sx * sy / n
            along = 0.5 * np.arctan2(2 * xy, xx - yy)  # the principal axis
            found[k, 0], found[k, 1] = -np.sin(along), np.cos(along)
    return found


def seen_through(shown: Points, scan: Points, pose: Floats) -> float:
    """Return the share of the points `shown` (n, 2) that a scan at `pose` looks through.

    Only points in its view count, not those behind its hits. `scan` (m, 2) is in the body's frame.
    NaN if hardly any point is in view.
    """
    nearest, farthest = _ends(scan)
    through, hit = _look(shown, nearest, farthest, pose)
    return through / (through + hit) if through + hit >= MIN_SEEN_POINTS else np.nan


def share_hit(shown: Points, scan: Points, pose: Floats) -> float:
    """Return the share of the points `shown` (n, 2) that a scan at `pose` has hit as well."""
    if not len(shown):
        return 1.0
    nearest, farthest = _ends(scan)
    _, hit = _look(shown, nearest, farthest, np.array(pose))
    return hit / len(shown)


@kernel
def _bin(x: float, y: float) -> int:
    return int((np.arctan2(y, x) / (2 * np.pi) + 1.0) * BINS) % BINS


@kernel
def _ends(scan: Points) -> tuple[Floats, Floats]:
    """Return the least and the greatest range of the beams around each bearing."""
    low, high = np.full(BINS, np.inf), np.full(BINS, -np.inf)
    for x, y in scan:
        away, at = np.sqrt(x * x + y * y), _bin(x, y)
        for side in (-1, 0, 1):
            b = (at + side) % BINS
            low[b], high[b] = min(low[b], away), max(high[b], away)
    return low, high


@kernel
def _look(shown: Points, low: Floats, high: Floats, pose: Floats) -> tuple[int, int]:
    """Count the points that beams have passed through, and those that they have hit."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    through = hit = 0
    for k in range(len(shown)):
        dx, dy = shown[k, 0] - pose[0], shown[k, 1] - pose[1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        at, away = _bin(x, y), np.sqrt(dx * dx + dy * dy)
        if low[at] == np.inf:
            continue
        if away < low[at] - MARGIN:
            through += 1
        elif away < high[at] + MARGIN:
            hit += 1
    return through, hit


@dataclass(frozen=True, slots=True)
class Edge:
    """Keyframe `second` as seen from keyframe `first`, both by index."""

    first: int
    second: int
    relative: Floats
    covariance: Floats  # (3, 3), of x, y and yaw in the axes of `second`
    doubtful: bool  # may be all wrong, so it counts the less the more it disagrees with others


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A scan that is kept, and the link by which it hangs on an earlier one."""

    points: Points  # as in Scan
    free: Points
    link: Edge  # the first keyframe hangs on itself, `relative` being its pose in the map
    travel: float  # [m], driven until here
    segment: int  # parts of the drive between which the sequence broke

    @property
    def scan(self) -> Scan:
        """The scan. Its normals are computed again, as storing them would double the memory."""
        return Scan(self.points, normals(self.points), self.free)


@dataclass(frozen=True, slots=True)
class KeyframePolicy:
    """Spacing of keyframes, and how many of them the local map holds."""

    travel: float = 0.2  # [m]
    turn: float = 0.26  # [rad]
    fewest: int = 8  # keyframes, however far apart they are
    most: int = 20  # keyframes, however near
    length: float = 4.0  # [m] of travel, between the two

    def first(self, poses: Floats) -> int:
        """Return the index of the first of the poses (n, 3) that the local map still holds."""
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        behind = np.append(np.cumsum(steps[::-1])[::-1], 0.0)  # travel from each to the last
        age = np.arange(len(poses))[::-1]
        held = (age < self.fewest) | ((age < self.most) & (behind <= self.length))
        return int(np.argmax(held))


def keyframes_to_arrays(keyframes: Sequence[Keyframe]) -> dict[str, NDArray[np.generic]]:
    """Return all keyframes as arrays, to be saved."""
    return {
        **edges_to_arrays("link", [keyframe.link for keyframe in keyframes]),
        "travel": np.array([keyframe.travel for keyframe in keyframes]),
        "segment": np.array([keyframe.segment for keyframe in keyframes], np.int32),
        "points": _joined(keyframe.points for keyframe in keyframes),
        "points_each": np.array([len(keyframe.points) for keyframe in keyframes], np.int32),
        "free": _joined(keyframe.free for keyframe in keyframes),
        "free_each": np.array([len(keyframe.free) for keyframe in keyframes], np.int32),
    }


def keyframes_from_arrays(arrays: Arrays) -> list[Keyframe]:
    """Restore keyframes; KeyError or ValueError if the arrays do not belong together."""
    links = edges_from_arrays("link", arrays)
    points = split(arrays["points"], arrays["points_each"])
    free = split(arrays["free"], arrays["free_each"])
    rows = zip(links, points, free, arrays["travel"], arrays["segment"], strict=True)
    return [
        Keyframe(pairs("points", hits), pairs("free", ends), link, float(travel), int(segment))
        for link, hits, ends, travel, segment in rows
    ]


def edges_to_arrays(name: str, edges: Sequence[Edge]) -> dict[str, NDArray[np.generic]]:
    """Return the edges as arrays whose names begin with `name`."""
    return {
        f"{name}_ends": np.array([(e.first, e.second) for e in edges], np.int32).reshape(-1, 2),
        f"{name}_relative": np.array([e.relative for e in edges]).reshape(-1, 3),
        f"{name}_covariance": np.array([e.covariance for e in edges]).reshape(-1, 3, 3),
        f"{name}_doubtful": np.array([e.doubtful for e in edges], np.bool_),
    }


def edges_from_arrays(name: str, arrays: Arrays) -> list[Edge]:
    """Restore edges from arrays."""
    ends = arrays[f"{name}_ends"].astype(int)
    relative = arrays[f"{name}_relative"].astype(np.float64)
    covariance = arrays[f"{name}_covariance"].astype(np.float64)
    keyframes = len(arrays["link_ends"])
    if ends.ndim != 2 or relative.shape != (len(ends), 3) or covariance.shape != (len(ends), 3, 3):
        raise ValueError(f"{name}: {len(ends)} edges, but {len(relative)} poses")
    if not ((ends >= 0) & (ends < keyframes)).all():
        raise ValueError(f"{name}: joins keyframes that there are not, of {keyframes}")
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise ValueError(f"{name}: expected positive definite covariances")
    rows = zip(ends, relative, covariance, arrays[f"{name}_doubtful"], strict=True)
    return [Edge(int(first), int(second), r, c, bool(d)) for (first, second), r, c, d in rows]


def shaped(arrays: Arrays, name: str, *shape: int) -> Floats:
    """Return one of the arrays; KeyError without it, ValueError for another shape."""
    values = arrays[name].astype(np.float64)
    if values.shape != shape:
        raise ValueError(f"{name} of shape {values.shape}, expected {shape}")
    return values


def _joined(parts: Iterable[Points]) -> Points:
    return np.concatenate([np.empty((0, 2), np.float32), *parts])


def split(rows: NDArray[np.generic], each: NDArray[np.generic]) -> list[Points]:
    """Split points (n, 2) by scan; ValueError for impossible points."""
    counts, points = each.astype(int), rows.astype(np.float32)
    if points.shape != (counts.sum(), 2) or (counts < 0).any():
        raise ValueError(f"expected {counts.sum()} points, got {points.shape}")
    if points.size and not -REACH_M <= points.min() <= points.max() <= REACH_M:
        raise ValueError(f"expected points within {REACH_M:g} m")
    return np.split(points, np.cumsum(counts)[:-1]) if len(counts) else []
