"""What a scan shows of single things: hits that belong together, as discs seen from the lidar.

Where neighbours are farther apart than they could be on a surface that the beams meet at 10 degrees
(Borges and Aldon 2004), one thing ends and another begins.
"""

import math
from typing import TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.body import Lidar

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
S = TypeVar("S", bound=np.generic)

FARTHEST_M = 10.0  # things beyond are left alone
FEWEST = 3  # hits; fewer may be chance
GRAZING_RAD = math.radians(10.0)  # surfaces met at less than that fall into single hits
LEAST_GAP_M, MOST_GAP_M = 0.10, 0.35  # between two things
NOISE_GAP = 5.0  # standard deviations of what noise alone puts between two neighbours
TO_DEVIATION = math.sqrt(2.0) / (0.6745 * math.sqrt(6.0))  # from the median of second differences
LOST_GAP_M, LOST_BEAMS = 0.10, 6.5  # so near, few beams may be lost on one thing
MISSING_BEAMS = 2.5  # neighbours so many beams apart are two things
LARGEST_M = 1.2  # what is longer is a wall
LARGEST_RADIUS_M = 0.75
EDGE_BEAMS = 1.5  # so near to the end of the field of view a thing may go on beyond it
IN_RANGE = 0.97  # of the lidar's range; what reaches beyond is cut off there
NOISE_M = 0.01  # of a place, beside what the spacing of the beams leaves open


class Cluster(Struct, frozen=True):
    """One thing as a disc, in polar coordinates round the lidar."""

    near: float  # [m] from the lidar to its near side
    bearing: float  # [rad], in the body's frame
    radius: float  # [m]
    whole: bool  # nothing hides an end of it
    noise: float  # [m], standard deviation of its place


def find_clusters(hits: Floats, lidar: Lidar, spacing: float) -> list[Cluster]:
    """The things among `hits`, (n, 2) [m] in the body's frame, of beams `spacing` [rad] apart."""
    dx, dy = hits[:, 0] - lidar.x, hits[:, 1] - lidar.y
    bearings = np.arctan2(dy, dx)
    order = np.argsort(bearings, kind="stable")
    points = np.column_stack((dx[order], dy[order]))
    bearings = bearings[order]
    ranges = np.hypot(points[:, 0], points[:, 1])
    breaks, empty = _breaks(points, bearings, ranges, spacing)
    if not breaks.any():
        return []
    begin = int(np.flatnonzero(breaks)[0]) + 1  # cut the turn where one thing ends
    points, ranges = _from(begin, points), _from(begin, ranges)
    breaks, empty = _from(begin, breaks), _from(begin, empty)
    bearings = np.concatenate((bearings[begin:], bearings[:begin] + math.tau))
    last = np.flatnonzero(breaks)
    first = np.concatenate(([0], last[:-1] + 1))
    in_front = _in_front(ranges, empty, first, last, lidar.range_max * IN_RANGE)
    in_front &= _inside(bearings - lidar.yaw, first, last, lidar.beams * spacing / 2, spacing)
    sized = _sized(points, ranges, first, last)
    return [
        _disc(ranges[a : b + 1], float(bearings[a]), float(bearings[b]), spacing, whole=whole)
        for a, b, whole in zip(first[sized], last[sized], in_front[sized].tolist(), strict=True)
    ]


def _from(begin: int, values: NDArray[S]) -> NDArray[S]:
    """All `values` in turn, from one of them on. numpy's roll takes four times as long."""
    return np.concatenate((values[begin:], values[:begin]))


def _breaks(
    points: Floats, bearings: Floats, ranges: Floats, spacing: float
) -> tuple[Bools, Bools]:
    """After which hits one thing ends, and after which of them beams hit nothing; (n,) each."""
    following = _from(1, points)
    turned = _from(1, bearings) - bearings
    turned[-1:] += math.tau
    apart = np.hypot(following[:, 0] - points[:, 0], following[:, 1] - points[:, 1])
    nearer = np.minimum(ranges, _from(1, ranges))
    steps = np.minimum(turned, GRAZING_RAD / 2)
    most = nearer * np.sin(steps) / np.sin(GRAZING_RAD - steps)
    empty = turned > MISSING_BEAMS * spacing
    least = max(LEAST_GAP_M, NOISE_GAP * _roughness(ranges))
    ended = empty & ((apart > max(LOST_GAP_M, least)) | (turned > LOST_BEAMS * spacing))
    return ended | (apart > np.clip(most, least, MOST_GAP_M)), empty


def _roughness(ranges: Floats) -> float:
    """How much ranges differ from beam to beam [m], as a standard deviation, where nothing ends.

    What a surface does to them is much the same on both sides of a beam; noise is not.
    """
    if len(ranges) < FEWEST:
        return 0.0
    bends = np.abs(ranges[:-2] - 2 * ranges[1:-1] + ranges[2:])
    return float(np.median(bends)) * TO_DEVIATION


def _in_front(ranges: Floats, empty: Bools, first: Indices, last: Indices, reach: float) -> Bools:
    """Which clusters are nearer than what is beside them, at both ends, (k,)."""
    free_before, free_after = empty[first - 1], empty[last]
    before, after = ranges[first - 1], ranges[(last + 1) % len(ranges)]
    begins, ends = ranges[first], ranges[last]
    left = (free_before | (before > begins)) & (begins < reach)
    right = (free_after | (after > ends)) & (ends < reach)
    found: Bools = left & right
    return found


def _inside(bearings: Floats, first: Indices, last: Indices, half: float, spacing: float) -> Bools:
    """Return which clusters stay clear of both ends, `half` [rad] to each side, (k,).

    `bearings` are from the middle of the field of view.
    """
    if half > math.pi - spacing:
        return np.ones(len(first), dtype=np.bool_)
    most = half - EDGE_BEAMS * spacing
    begins, ends = (np.remainder(bearings[k] + math.pi, math.tau) - math.pi for k in (first, last))
    found: Bools = (begins > -most) & (ends < most)
    return found


def _sized(points: Floats, ranges: Floats, first: Indices, last: Indices) -> Bools:
    """Which clusters have hits enough, are no walls and not too far away, (k,)."""
    sides = np.maximum.reduceat(points, first) - np.minimum.reduceat(points, first)
    small = np.hypot(sides[:, 0], sides[:, 1]) <= LARGEST_M
    found: Bools = (last - first + 1 >= FEWEST) & small & (ranges[first] <= FARTHEST_M)
    return found


def _disc(ranges: Floats, begins: float, ends: float, spacing: float, *, whole: bool) -> Cluster:
    """The disc that fills the angle between two tangents: sin(half the angle) = r / (near + r)."""
    count = len(ranges)
    third = count // 3
    near = float(ranges[third : count - third].mean())
    sine = math.sin(min((ends - begins + spacing) / 2, 1.0))
    radius = min(near * sine / (1.0 - sine), LARGEST_RADIUS_M)
    return Cluster(
        near=near - 0.02 * radius,  # the middle third is not quite all at its nearest point
        bearing=(begins + ends) / 2,
        radius=radius,
        whole=whole,
        noise=NOISE_M + 0.3 * near * spacing,
    )
