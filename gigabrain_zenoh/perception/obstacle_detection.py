"""Detects discs in one scan, and motion by free space between scans.

Clusters end where neighbours are farther apart than on a surface met at 10 degrees (Borges and
Aldon 2004). A thing has moved if beams passed its place before, or pass its former place now.
"""

import math
from collections import deque
from functools import cached_property
from typing import TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.geometry.pose import compose

Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
S = TypeVar("S", bound=np.generic)
MAX_RANGE_M = 10.0  # things beyond are left alone
MIN_CLUSTER_HITS = 3  # hits; fewer may be chance
GRAZING_RAD = math.radians(10.0)  # surfaces met at less than that fall into single hits
MIN_GAP_M, MAX_GAP_M = 0.10, 0.35  # between two things
NOISE_GAP_SIGMAS = 5.0  # standard deviations of what noise alone puts between two neighbours
TO_DEVIATION = math.sqrt(2.0) / (0.6745 * math.sqrt(6.0))  # from the median of second differences
LOST_GAP_M, LOST_BEAMS = 0.10, 6.5  # so near, few beams may be lost on one thing
MISSING_BEAMS = 2.5  # neighbours so many beams apart are two things
MAX_SIZE_M = 1.2  # what is longer is a wall
MAX_RADIUS_M = 0.75
EDGE_BEAMS = 1.5  # so near to the end of the field of view a thing may go on beyond it
USABLE_RANGE_SHARE = 0.97  # of the lidar's range; what reaches beyond is cut off there
NOISE_M = 0.01  # of a place, beside what the spacing of the beams leaves open

RIM_GATES_M = (0.25, 0.2, 0.15, 0.12, 0.12)  # off its rim a hit may be, in each round
MIN_RIM_HITS = 4  # hits; fewer say nothing of where the middle is
MAX_RIM_RMS_M = 0.05  # root mean square off its rim; more is another thing
MIN_RIM_NOISE_M = 0.015
MIN_MIDDLE_DISTANCE_M = 0.02  # so near to the middle a hit says nothing of where that is
RIM_TOLERANCE_M = 0.1  # off the rim the hits on it are
PRIOR_WEIGHT = 0.02  # of the hits' own weight: what they leave open stays where it was

FittedDisc = tuple[float, float, float]
ARC_GAP_M = 0.2  # between hits; a wider one ends an arc
MIN_ARC_HITS = 8  # hits of an arc
MAX_ARC_RADII = 2.0  # radii; what is longer is a wall
MIDDLE_OFFSET_RADII = 0.7  # radii, so far behind the middle of its hits the middle of a disc may be
MAX_ARC_NOISE_M = 0.08  # standard deviation of its place
MIN_RIM_SHARE = 0.9  # share of the hits

MOTION_M = 0.4  # or by something quick, since it has gone so far
COMPARED_S = 0.5  # what was seen so long ago is compared
KEPT_SCANS = 32  # scans
BEYOND_MARGIN_M = 0.12  # beyond a point; noise and odometry do not reach so far
HIT_MARGIN_M = 0.1  # round a thing, its hits may lie
MIN_FREE_SHARE = 0.35  # of its hits that must be in free space
FIELD_EDGE_BEAMS = 3  # at the ends of the field of view


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
    points, ranges = _rotated(begin, points), _rotated(begin, ranges)
    breaks, empty = _rotated(begin, breaks), _rotated(begin, empty)
    bearings = np.concatenate((bearings[begin:], bearings[:begin] + math.tau))
    last = np.flatnonzero(breaks)
    first = np.concatenate(([0], last[:-1] + 1))
    in_front = _in_front(ranges, empty, first, last, lidar.range_max * USABLE_RANGE_SHARE)
    in_front &= _inside(bearings - lidar.yaw, first, last, lidar.beams * spacing / 2, spacing)
    sized = _sized(points, ranges, first, last)
    return [
        _disc_of_cluster(
            ranges[a : b + 1], float(bearings[a]), float(bearings[b]), spacing, whole=whole
        )
        for a, b, whole in zip(first[sized], last[sized], in_front[sized].tolist(), strict=True)
    ]


def _rotated(begin: int, values: NDArray[S]) -> NDArray[S]:
    """All `values` in turn, from one of them on. numpy's roll takes four times as long."""
    return np.concatenate((values[begin:], values[:begin]))


def _breaks(
    points: Floats, bearings: Floats, ranges: Floats, spacing: float
) -> tuple[Bools, Bools]:
    """After which hits one thing ends, and after which of them beams hit nothing; (n,) each."""
    following = _rotated(1, points)
    turned = _rotated(1, bearings) - bearings
    turned[-1:] += math.tau
    apart = np.hypot(following[:, 0] - points[:, 0], following[:, 1] - points[:, 1])
    nearer = np.minimum(ranges, _rotated(1, ranges))
    steps = np.minimum(turned, GRAZING_RAD / 2)
    most = nearer * np.sin(steps) / np.sin(GRAZING_RAD - steps)
    empty = turned > MISSING_BEAMS * spacing
    least = max(MIN_GAP_M, NOISE_GAP_SIGMAS * _roughness(ranges))
    ended = empty & ((apart > max(LOST_GAP_M, least)) | (turned > LOST_BEAMS * spacing))
    return ended | (apart > np.clip(most, least, MAX_GAP_M)), empty


def _roughness(ranges: Floats) -> float:
    """How much ranges differ from beam to beam [m], as a standard deviation, where nothing ends.

    What a surface does to them is much the same on both sides of a beam; noise is not.
    """
    if len(ranges) < MIN_CLUSTER_HITS:
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
    small = np.hypot(sides[:, 0], sides[:, 1]) <= MAX_SIZE_M
    found: Bools = (last - first + 1 >= MIN_CLUSTER_HITS) & small & (ranges[first] <= MAX_RANGE_M)
    return found


def _disc_of_cluster(
    ranges: Floats, begins: float, ends: float, spacing: float, *, whole: bool
) -> Cluster:
    """The disc that fills the angle between two tangents: sin(half the angle) = r / (near + r)."""
    count = len(ranges)
    third = count // 3
    near = float(ranges[third : count - third].mean())
    sine = math.sin(min((ends - begins + spacing) / 2, 1.0))
    radius = min(near * sine / (1.0 - sine), MAX_RADIUS_M)
    return Cluster(
        near=near - 0.02 * radius,  # the middle third is not quite all at its nearest point
        bearing=(begins + ends) / 2,
        radius=radius,
        whole=whole,
        noise=NOISE_M + 0.3 * near * spacing,
    )


def on_rim(points: Floats, x: float, y: float, radius: float) -> Bools:
    """Which of the `points` (n, 2) are hits on a disc at (x, y) [m], (n,)."""
    away = np.hypot(points[:, 0] - x, points[:, 1] - y)
    found: Bools = np.abs(away - radius) < RIM_TOLERANCE_M
    return found


def off_rims(points: Floats, discs: Floats) -> Floats:
    """Those of the `points` (n, 2) that are hits on none of `discs` (m, 3): x, y, radius [m]."""
    away = np.hypot(points[:, :1] - discs[:, 0], points[:, 1:] - discs[:, 1])
    found: Floats = points[(np.abs(away - discs[:, 2]) >= RIM_TOLERANCE_M).all(axis=1)]
    return found


def fit_disc(
    points: Floats, x: float, y: float, radius: float
) -> tuple[float, float, float] | None:
    """The middle (x, y) [m] of a disc whose rim the `points` (n, 2) near it lie on, and how sure.

    From where it should be, by Gauss and Newton's steps; the third number is the standard
    deviation [m] in the worse direction. None where it does not show.
    """
    for gate in RIM_GATES_M:
        dx, dy = points[:, 0] - x, points[:, 1] - y
        away = np.hypot(dx, dy)
        mine = (np.abs(away - radius) < gate) & (away > MIN_MIDDLE_DISTANCE_M)
        count = int(mine.sum())
        if count < MIN_RIM_HITS:
            return None
        ux, uy, off = dx[mine] / away[mine], dy[mine] / away[mine], away[mine] - radius
        xx, xy, yy = float(ux @ ux), float(ux @ uy), float(uy @ uy)
        fx, fy = float(ux @ off), float(uy @ off)
        a, b = xx + PRIOR_WEIGHT * count, yy + PRIOR_WEIGHT * count
        determinant = a * b - xy * xy
        x += (b * fx - xy * fy) / determinant
        y += (a * fy - xy * fx) / determinant
    rough = math.sqrt(float(off @ off) / count)
    if rough > MAX_RIM_RMS_M:
        return None
    worse = (a + b) / 2 - math.sqrt(((a - b) / 2) ** 2 + xy * xy)
    return x, y, max(rough, MIN_RIM_NOISE_M) / math.sqrt(worse)


def discs_of(points: Floats, eye: tuple[float, float], radius: float) -> list[FittedDisc]:
    """Discs of this `radius` [m] that arcs of the `points` (n, 2) belong to, as seen from `eye`.

    The points are in the order of their beams. Each disc: its middle (x, y) [m] and the standard
    deviation of that.
    """
    if len(points) < MIN_ARC_HITS:
        return []
    apart = np.hypot(*np.diff(points, axis=0).T)
    arcs = np.split(points, np.flatnonzero(apart > ARC_GAP_M) + 1)
    found = (_disc_of_arc(arc, eye, radius) for arc in arcs)
    return [place for place in found if place]


def _disc_of_arc(arc: Floats, eye: tuple[float, float], radius: float) -> FittedDisc | None:
    """The disc that an arc belongs to, if there is one."""
    if len(arc) < MIN_ARC_HITS or np.hypot(*(arc[-1] - arc[0])) > MAX_ARC_RADII * radius:
        return None
    middle = arc.mean(axis=0)
    away = middle - eye
    ray = away / np.hypot(*away)
    begin_x, begin_y = (middle + MIDDLE_OFFSET_RADII * radius * ray).tolist()
    place = fit_disc(arc, begin_x, begin_y, radius)
    if place is None or place[2] > MAX_ARC_NOISE_M:
        return None
    x, y, _ = place
    faces = float((np.array((x, y)) - middle) @ ray) > 0.0
    return place if faces and on_rim(arc, x, y, radius).mean() > MIN_RIM_SHARE else None


class PastScan:
    """One scan in the frame of the odometry. Its field of view is centred ahead of the lidar."""

    def __init__(self, tick: int, points: Floats, lidar: Lidar, spacing: float, pose: Pose) -> None:
        place = compose(pose, Pose(x=lidar.x, y=lidar.y, yaw=lidar.yaw))
        self.tick, self.points, self._place, self._spacing = tick, points, place, spacing
        self._reach, half = lidar.range_max, lidar.beams * spacing / 2
        self._half = math.pi if half > math.pi - spacing else half - FIELD_EDGE_BEAMS * spacing

    @cached_property
    def _beams(self) -> tuple[Floats, Floats]:
        """Bearings in order, and ranges; at both ends once more, so that each has a neighbour."""
        bearings, ranges = self._polar(self.points)
        order = np.argsort(bearings)
        ends = [*order[-1:], *order, *order[:1]]
        bearings = bearings[ends]
        bearings[:1] -= math.tau
        bearings[-1:] += math.tau
        return bearings, ranges[ends]

    def free(self, points: Floats) -> Bools:
        """At which of `points` (n, 2) nothing was: beams went well beyond them."""
        bearings, ranges = self._polar(points)
        seen, far = self._beams
        passed = (np.abs(bearings) < self._half) & (ranges < self._reach - BEYOND_MARGIN_M)
        if not len(seen):
            return passed
        after = np.clip(np.searchsorted(seen, bearings), 1, len(seen) - 1)
        for beam in (after - 1, after):
            beside = np.abs(seen[beam] - bearings) < 1.5 * self._spacing
            passed &= ~beside | (far[beam] > ranges + BEYOND_MARGIN_M)
        return passed

    def _polar(self, points: Floats) -> tuple[Floats, Floats]:
        dx, dy = points[:, 0] - self._place.x, points[:, 1] - self._place.y
        bearings = np.arctan2(dy, dx) - self._place.yaw
        return np.mod(bearings + math.pi, math.tau) - math.pi, np.hypot(dx, dy)


class FreeSpace:
    """The scans of the last second."""

    def __init__(self) -> None:
        self._scans: deque[PastScan] = deque(maxlen=KEPT_SCANS)

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()

    def see(self, scan: PastScan) -> None:
        """Take one scan."""
        self._scans.append(scan)

    def is_free(self, x: float, y: float) -> bool:
        """Whether beams of the newest scan went through (x, y) [m]."""
        return bool(self._scans[-1].free(np.array([[x, y]]))[0])

    def shows_motion(
        self, x: float, y: float, velocity_x: float, velocity_y: float, radius: float
    ) -> bool:
        """Whether a thing at (x, y) [m], which is said to move so fast [m/s], does."""
        now = self._scans[-1]
        speed = math.hypot(velocity_x, velocity_y)
        long_ago = COMPARED_S if speed * COMPARED_S < MOTION_M else MOTION_M / speed
        old = [scan for scan in self._scans if (now.tick - scan.tick) * TICK_S >= long_ago]
        before = old[-1] if old else self._scans[0]
        if before is now:
            return False
        dt = (now.tick - before.tick) * TICK_S
        mine = _near(now.points, x, y, radius)
        was = _near(before.points, x - velocity_x * dt, y - velocity_y * dt, radius)
        return _share(before.free(mine)) > MIN_FREE_SHARE or _share(now.free(was)) > MIN_FREE_SHARE


def _near(points: Floats, x: float, y: float, radius: float) -> Floats:
    found: Floats = points[np.hypot(points[:, 0] - x, points[:, 1] - y) < radius + HIT_MARGIN_M]
    return found


def _share(of: Bools) -> float:
    return float(of.mean()) if len(of) else 0.0
