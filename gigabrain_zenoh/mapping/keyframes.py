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
NEIGHBOUR_M = 0.4  # a point farther away lies on another surface,
NEIGHBOUR_BEAMS = 2.5  # unless the beams are sparse: then it may be so many beams away,
SPARSE_NEIGHBOUR_M = 1.2  # up to this distance
MIN_SPAN_M = 0.12  # a normal uses neighbours up to at least this distance on either side
MIN_NEIGHBOURS, MAX_NEIGHBOURS = 3, 10  # neighbours on either side
MIN_POINTS = 3  # for a normal

BEARING_BINS = 360
HIT_MARGIN_M = 0.3  # a point this near to the end of a beam was hit by it
MIN_SEEN_POINTS = 20  # fewer points in view prove nothing

Arrays = Mapping[str, NDArray[np.generic]]
REACH_M = 200.0  # longest beam, as the grid draws every cell that it passes


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan in the body's frame. Points are in beam order, which normals need."""

    points: Points  # [m], (n, 2): where beams hit
    normals: Points  # (n, 2), unit length, sign unknown; zeros where unknown
    free: Points  # [m], (m, 2): free ends of beams that hit nothing

    @classmethod
    def of(cls, points: NDArray[np.floating], free: NDArray[np.floating] | None = None) -> "Scan":
        """Make a scan of hits (n, 2) in beam order; ValueError for another shape or NaN.

        Hits beyond REACH_M are left out, as no map could be loaded with them.
        """
        kept = as_points("points", points)
        near = np.abs(kept) <= REACH_M
        kept = kept if near.all() else kept[near.all(axis=1)]
        ends = np.empty((0, 2), np.float32) if free is None else as_points("free", free)
        return cls(kept, normals(kept), ends)


class Beams(NamedTuple):
    """Ends of a scan's beams in the body's frame [m]."""

    hits: Points  # (n, 2)
    free: Points  # (m, 2): free ends of beams that hit nothing
    sensor: Floats  # (2,): where beams start


@dataclass(frozen=True, slots=True)
class View:
    """One scan in the body's frame, and the sensor's position."""

    scan: Scan
    sensor: Floats  # (2,) [m], where the beams start

    @property
    def beams(self) -> Beams:
        """The beams of the scan, without its normals."""
        return Beams(self.scan.points, self.scan.free, self.sensor)


def as_points(name: str, values: NDArray[np.floating]) -> Points:
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

    A beam that hit nothing within `range_max` counts as free up to `free_range`. Ranges below
    `range_min` and NaN are left out.
    """
    if angles.shape != ranges.shape or angles.ndim != 1:
        raise ValueError(f"expected {angles.shape[0]} ranges, got {ranges.shape}")
    hit = (ranges > range_min) & (ranges < range_max)
    clear = (ranges >= range_max) & (free_range > 0)
    directions = np.column_stack((np.cos(angles), np.sin(angles)))
    return Scan.of(directions[hit] * ranges[hit, None], directions[clear] * free_range)


def thinned(points: Points, limit: int) -> Points:
    """Return at most `limit` of the points, evenly spaced by beam."""
    if len(points) <= limit:
        return points
    return points[_spaced_indices(len(points), limit)]


@lru_cache(maxsize=256)
def _spaced_indices(count: int, limit: int) -> NDArray[np.intp]:
    return np.linspace(0, count - 1, limit).astype(np.intp)


def normals(points: Points) -> Points:
    """Return the normal (n, 2) at each point: of the line through its neighbours in beam order."""
    if len(points) < MIN_POINTS:
        return np.zeros_like(points)
    bearings = np.arctan2(points[:, 1], points[:, 0])
    return _normals(points, median(np.abs(np.diff(bearings))))


@kernel
def _normals(points: Points, spacing: float) -> Points:
    """Fit lines to neighbours, farther away where the beams' `spacing` [rad] is wide."""
    count = len(points)
    found = np.zeros((count, 2), np.float32)
    for k in range(count):
        n, sx, sy, sxx, syy, sxy = 1, 0.0, 0.0, 0.0, 0.0, 0.0
        range_ = np.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2)
        max_distance = min(max(NEIGHBOUR_M, NEIGHBOUR_BEAMS * spacing * range_), SPARSE_NEIGHBOUR_M)
        for side in (-1, 1):
            for step in range(1, min(MAX_NEIGHBOURS, count - 1) + 1):
                j = (k + side * step) % count
                dx, dy = points[j, 0] - points[k, 0], points[j, 1] - points[k, 1]
                distance = np.sqrt(dx * dx + dy * dy)
                if distance < max_distance:
                    n += 1
                    sx, sy = sx + dx, sy + dy
                    sxx, syy, sxy = sxx + dx * dx, syy + dy * dy, sxy + dx * dy
                if step >= MIN_NEIGHBOURS and distance >= MIN_SPAN_M:
                    break
        if n >= MIN_POINTS:
            xx, yy, xy = sxx - sx * sx / n, syy - sy * sy / n, sxy - sx * sy / n
            along = 0.5 * np.arctan2(2 * xy, xx - yy)  # the principal axis
            found[k, 0], found[k, 1] = -np.sin(along), np.cos(along)
    return found


def seen_through(mapped: Points, scan: Points, pose: Floats) -> float:
    """Return the share of the points `mapped` (n, 2) that beams of a scan at `pose` pass through.

    Points behind hits do not count. `scan` (m, 2) is in the body's frame. NaN if fewer than
    MIN_SEEN_POINTS are in view.
    """
    nearest, farthest = _range_limits(scan)
    through, hit = _count_seen(mapped, nearest, farthest, pose)
    return through / (through + hit) if through + hit >= MIN_SEEN_POINTS else np.nan


@kernel
def _bearing_bin(x: float, y: float) -> int:
    return int((np.arctan2(y, x) / (2 * np.pi) + 1.0) * BEARING_BINS) % BEARING_BINS


@kernel
def _range_limits(scan: Points) -> tuple[Floats, Floats]:
    """Return the smallest and the largest range of the beams around each bearing."""
    low, high = np.full(BEARING_BINS, np.inf), np.full(BEARING_BINS, -np.inf)
    for x, y in scan:
        distance, bearing = np.sqrt(x * x + y * y), _bearing_bin(x, y)
        for side in (-1, 0, 1):
            b = (bearing + side) % BEARING_BINS
            low[b], high[b] = min(low[b], distance), max(high[b], distance)
    return low, high


@kernel
def _count_seen(mapped: Points, low: Floats, high: Floats, pose: Floats) -> tuple[int, int]:
    """Return the numbers of points that beams pass through, and that they hit."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    through = hit = 0
    for k in range(len(mapped)):
        dx, dy = mapped[k, 0] - pose[0], mapped[k, 1] - pose[1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        bearing, distance = _bearing_bin(x, y), np.sqrt(dx * dx + dy * dy)
        if low[bearing] == np.inf:
            continue
        if distance < low[bearing] - HIT_MARGIN_M:
            through += 1
        elif distance < high[bearing] + HIT_MARGIN_M:
            hit += 1
    return through, hit


@dataclass(frozen=True, slots=True)
class Edge:
    """Pose of keyframe `second` in the frame of keyframe `first`, both by index."""

    first: int
    second: int
    relative: Floats  # (3,)
    covariance: Floats  # (3, 3), of x, y and yaw in the axes of `second`
    doubtful: bool  # may be false: it loses weight where it disagrees with other edges


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A scan that the map keeps, and its link to an earlier keyframe."""

    points: Points  # as in Scan
    free: Points
    link: Edge  # the first keyframe is linked to itself; `relative` is its pose in the map
    travel: float  # [m], driven before it
    segment: int  # number of its part of the drive; a break of the sequence starts a new one

    @property
    def scan(self) -> Scan:
        """The scan. Its normals are computed again: storing them would double the memory."""
        return Scan(self.points, normals(self.points), self.free)


@dataclass(frozen=True, slots=True)
class KeyframePolicy:
    """Spacing of keyframes, and how many of them the local map holds."""

    travel: float = 0.2  # [m]
    turn: float = 0.26  # [rad]
    min_held: int = 8
    max_held: int = 20
    held_travel: float = 4.0  # [m], limits the number between the two

    def first(self, poses: Floats) -> int:
        """Return the index of the first of the poses (n, 3) that the local map still holds."""
        steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
        behind = np.append(np.cumsum(steps[::-1])[::-1], 0.0)  # [m], from each to the last
        age = np.arange(len(poses))[::-1]
        held = (age < self.min_held) | ((age < self.max_held) & (behind <= self.held_travel))
        return int(np.argmax(held))


def keyframes_to_arrays(keyframes: Sequence[Keyframe]) -> dict[str, NDArray[np.generic]]:
    """Return all keyframes as arrays, to be saved."""
    return {
        **edges_to_arrays("link", [keyframe.link for keyframe in keyframes]),
        "travel": np.array([keyframe.travel for keyframe in keyframes]),
        "segment": np.array([keyframe.segment for keyframe in keyframes], np.int32),
        "points": _concatenated(keyframe.points for keyframe in keyframes),
        "points_each": np.array([len(keyframe.points) for keyframe in keyframes], np.int32),
        "free": _concatenated(keyframe.free for keyframe in keyframes),
        "free_each": np.array([len(keyframe.free) for keyframe in keyframes], np.int32),
    }


def keyframes_from_arrays(arrays: Arrays) -> list[Keyframe]:
    """Restore keyframes; KeyError or ValueError if the arrays do not belong together."""
    links = edges_from_arrays("link", arrays)
    points = split(arrays["points"], arrays["points_each"])
    free = split(arrays["free"], arrays["free_each"])
    rows = zip(links, points, free, arrays["travel"], arrays["segment"], strict=True)
    return [
        Keyframe(
            as_points("points", hits), as_points("free", ends), link, float(travel), int(segment)
        )
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
        raise ValueError(f"{name}: joins keyframes that do not exist, of {keyframes}")
    if not (np.linalg.eigvalsh(covariance) > 0).all():
        raise ValueError(f"{name}: expected positive definite covariances")
    rows = zip(ends, relative, covariance, arrays[f"{name}_doubtful"], strict=True)
    return [Edge(int(first), int(second), r, c, bool(d)) for (first, second), r, c, d in rows]


def shaped(arrays: Arrays, name: str, *shape: int) -> Floats:
    """Return an array as floats; KeyError if it is missing, ValueError for another shape."""
    values = arrays[name].astype(np.float64)
    if values.shape != shape:
        raise ValueError(f"{name} of shape {values.shape}, expected {shape}")
    return values


def _concatenated(parts: Iterable[Points]) -> Points:
    return np.concatenate([np.empty((0, 2), np.float32), *parts])


def split(rows: NDArray[np.generic], each: NDArray[np.generic]) -> list[Points]:
    """Split points (n, 2) by scan; ValueError for impossible points."""
    counts, points = each.astype(int), rows.astype(np.float32)
    if points.shape != (counts.sum(), 2) or (counts < 0).any():
        raise ValueError(f"expected {counts.sum()} points, got {points.shape}")
    if points.size and not -REACH_M <= points.min() <= points.max() <= REACH_M:
        raise ValueError(f"expected points within {REACH_M:g} m")
    return np.split(points, np.cumsum(counts)[:-1]) if len(counts) else []
