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
from gigabrain_zenoh.geometry.scan import median

Bools = NDArray[np.bool_]
Indices = NDArray[np.intp]
S = TypeVar("S", bound=np.generic)
MAX_RANGE_M = 10.0  # farther things are ignored
MIN_CLUSTER_HITS = 3  # fewer may be noise
GRAZING_RAD = math.radians(10.0)  # surfaces met at a smaller angle give single hits
MIN_GAP_M, MAX_GAP_M = 0.10, 0.35  # between two things
NOISE_GAP_SIGMAS = 5.0  # standard deviations of noise between two neighbours
TO_DEVIATION = math.sqrt(2.0) / (0.6745 * math.sqrt(6.0))  # per median of second differences
LOST_GAP_M, LOST_BEAMS = 0.10, 6.5  # a smaller gap with fewer lost beams ends no cluster
MISSING_BEAMS = 2.5  # with a wider step between two hits, beams are missing
MAX_SIZE_M = 1.2  # a longer cluster is a wall
MAX_RADIUS_M = 0.75
EDGE_BEAMS = 1.5  # things closer to the end of the field of view may extend beyond it
USABLE_RANGE_SHARE = 0.97  # of the lidar's range; farther things may be cut off
NOISE_M = 0.01  # of a position, in addition to the spacing of the beams

RIM_GATES_M = (0.25, 0.2, 0.15, 0.12, 0.12)  # largest distance of a hit from the rim, by round
MIN_RIM_HITS = 4  # fewer do not show the centre
MAX_RIM_RMS_M = 0.05  # of distances from the rim; more is another thing
MIN_RIM_NOISE_M = 0.015
MIN_MIDDLE_DISTANCE_M = 0.02  # hits closer to the centre do not show its direction
RIM_TOLERANCE_M = 0.1  # distance from the rim up to which a hit is on it
PRIOR_WEIGHT = 0.02  # of the expected centre, per hit

FittedDisc = tuple[float, float, float]
ARC_GAP_M = 0.2  # a wider gap between hits ends an arc
MIN_ARC_HITS = 8
MAX_ARC_RADII = 2.0  # a longer arc is a wall
MIDDLE_OFFSET_RADII = 0.7  # first guess of the centre, behind the mean of the hits
MAX_ARC_NOISE_M = 0.08  # standard deviation of the centre
MIN_RIM_SHARE = 0.9  # of the hits

MOTION_M = 0.4  # a quick thing is compared with the scan before it moved this far
COMPARED_S = 0.5  # age of the compared scan for slow things
KEPT_SCANS = 32
BEYOND_MARGIN_M = 0.12  # how far beyond a free point a beam must go; more than noise
HIT_MARGIN_M = 0.1  # around a disc; hits within it belong to the disc
MIN_FREE_SHARE = 0.35  # of hits in free space, to confirm motion
ODOMETRY_ERROR = 0.06  # of distance and turn between two scans, including late stamps
NOISE_GATE_M = 0.03  # between hits of two scans on the same surface
MIN_STATIC_SHARE = 0.2  # of hits, by which rest must explain more than motion does
FIELD_EDGE_BEAMS = 3  # ignored at the ends of the field of view


class Cluster(Struct, frozen=True):
    """One thing as a disc, in polar coordinates around the lidar."""

    near: float  # [m] from the lidar to its near side
    bearing: float  # [rad], in the body's frame
    radius: float  # [m]
    whole: bool  # neither end is hidden
    noise: float  # [m], standard deviation of its place


def find_clusters(hits: Floats, lidar: Lidar, spacing: float) -> list[Cluster]:
    """Return clusters of `hits` (n, 2) [m] in the body's frame; beams are `spacing` [rad] apart."""
    dx, dy = hits[:, 0] - lidar.x, hits[:, 1] - lidar.y
    bearings = np.arctan2(dy, dx)
    order = np.argsort(bearings, kind="stable")
    points = np.column_stack((dx[order], dy[order]))
    bearings = bearings[order]
    ranges = np.hypot(points[:, 0], points[:, 1])
    breaks, empty = _breaks(points, bearings, ranges, spacing)
    if not breaks.any():
        return []
    begin = int(np.flatnonzero(breaks)[0]) + 1  # begin after the end of a cluster
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
    """Return `values` rotated to begin at index `begin`. numpy's roll takes four times as long."""
    return np.concatenate((values[begin:], values[:begin]))


def _breaks(
    points: Floats, bearings: Floats, ranges: Floats, spacing: float
) -> tuple[Bools, Bools]:
    """Return masks (n,) of hits after which a cluster ends, and after which beams are missing."""
    following = _rotated(1, points)
    turned = _rotated(1, bearings) - bearings
    turned[-1:] += math.tau
    apart = np.hypot(following[:, 0] - points[:, 0], following[:, 1] - points[:, 1])
    nearer = np.minimum(ranges, _rotated(1, ranges))
    steps = np.minimum(turned, GRAZING_RAD / 2)
    surface_gap = nearer * np.sin(steps) / np.sin(GRAZING_RAD - steps)
    empty = turned > MISSING_BEAMS * spacing
    noise_gap = max(MIN_GAP_M, NOISE_GAP_SIGMAS * _roughness(ranges))
    ended = empty & ((apart > max(LOST_GAP_M, noise_gap)) | (turned > LOST_BEAMS * spacing))
    return ended | (apart > np.minimum(np.maximum(surface_gap, noise_gap), MAX_GAP_M)), empty


def _roughness(ranges: Floats) -> float:
    """Return the standard deviation of the ranges' noise [m], from their second differences.

    A surface changes ranges alike on both sides of a beam; noise does not.
    """
    if len(ranges) < MIN_CLUSTER_HITS:
        return 0.0
    bends = np.abs(ranges[:-2] - 2 * ranges[1:-1] + ranges[2:])
    return median(bends) * TO_DEVIATION


def _in_front(ranges: Floats, empty: Bools, first: Indices, last: Indices, reach: float) -> Bools:
    """Return which clusters are nearer than their neighbours at both ends, (k,)."""
    free_before, free_after = empty[first - 1], empty[last]
    before, after = ranges[first - 1], ranges[(last + 1) % len(ranges)]
    begins, ends = ranges[first], ranges[last]
    left = (free_before | (before > begins)) & (begins < reach)
    right = (free_after | (after > ends)) & (ends < reach)
    found: Bools = left & right
    return found


def _inside(bearings: Floats, first: Indices, last: Indices, half: float, spacing: float) -> Bools:
    """Return which clusters are clear of both ends of the field of view, (k,).

    It extends by `half` [rad] to each side. `bearings` are from its middle.
    """
    if half > math.pi - spacing:
        return np.ones(len(first), dtype=np.bool_)
    limit = half - EDGE_BEAMS * spacing
    begins, ends = (np.remainder(bearings[k] + math.pi, math.tau) - math.pi for k in (first, last))
    found: Bools = (begins > -limit) & (ends < limit)
    return found


def _sized(points: Floats, ranges: Floats, first: Indices, last: Indices) -> Bools:
    """Return which clusters have enough hits, and are neither walls nor too far away, (k,)."""
    sides = np.maximum.reduceat(points, first) - np.minimum.reduceat(points, first)
    small = np.hypot(sides[:, 0], sides[:, 1]) <= MAX_SIZE_M
    found: Bools = (last - first + 1 >= MIN_CLUSTER_HITS) & small & (ranges[first] <= MAX_RANGE_M)
    return found


def _disc_of_cluster(
    ranges: Floats, begins: float, ends: float, spacing: float, *, whole: bool
) -> Cluster:
    """Return the disc between two tangents: sin(half the angle) = r / (near + r)."""
    count = len(ranges)
    third = count // 3
    near = float(ranges[third : count - third].sum()) / (count - 2 * third)
    sine = math.sin(min((ends - begins + spacing) / 2, 1.0))
    radius = min(near * sine / (1.0 - sine), MAX_RADIUS_M)
    return Cluster(
        near=near - 0.02 * radius,  # on average, the middle third is beyond the nearest point
        bearing=(begins + ends) / 2,
        radius=radius,
        whole=whole,
        noise=NOISE_M + 0.3 * near * spacing,
    )


def on_rim(points: Floats, x: float, y: float, radius: float) -> Bools:
    """Return which `points` (n, 2) are hits on the rim of a disc at (x, y) [m], (n,)."""
    away = np.hypot(points[:, 0] - x, points[:, 1] - y)
    found: Bools = np.abs(away - radius) < RIM_TOLERANCE_M
    return found


def off_rims(points: Floats, discs: Floats) -> Floats:
    """Return the `points` (n, 2) that are on no rim of `discs` (m, 3): x, y, radius [m]."""
    away = np.hypot(points[:, :1] - discs[:, 0], points[:, 1:] - discs[:, 1])
    found: Floats = points[(np.abs(away - discs[:, 2]) >= RIM_TOLERANCE_M).all(axis=1)]
    return found


def fit_disc(
    points: Floats, x: float, y: float, radius: float
) -> tuple[float, float, float] | None:
    """Return the centre (x, y) of a disc and its standard deviation in the worse direction [m].

    Gauss-Newton steps from the expected centre fit the rim to the `points` (n, 2) near it. None if
    they do not show the disc.
    """
    for gate in RIM_GATES_M:
        dx, dy = points[:, 0] - x, points[:, 1] - y
        away = np.hypot(dx, dy)
        rim = (np.abs(away - radius) < gate) & (away > MIN_MIDDLE_DISTANCE_M)
        count = int(rim.sum())
        if count < MIN_RIM_HITS:
            return None
        ux, uy, off = dx[rim] / away[rim], dy[rim] / away[rim], away[rim] - radius
        xx, xy, yy = float(ux @ ux), float(ux @ uy), float(uy @ uy)
        fx, fy = float(ux @ off), float(uy @ off)
        a, b = xx + PRIOR_WEIGHT * count, yy + PRIOR_WEIGHT * count
        determinant = a * b - xy * xy
        x += (b * fx - xy * fy) / determinant
        y += (a * fy - xy * fx) / determinant
    rms = math.sqrt(float(off @ off) / count)
    if rms > MAX_RIM_RMS_M:
        return None
    worse = (a + b) / 2 - math.sqrt(((a - b) / 2) ** 2 + xy * xy)
    return x, y, max(rms, MIN_RIM_NOISE_M) / math.sqrt(worse)


def discs_of(points: Floats, eye: tuple[float, float], radius: float) -> list[FittedDisc]:
    """Return discs of this `radius` [m] that arcs of `points` (n, 2) belong to, seen from `eye`.

    The points are in the order of their beams. A disc is its centre (x, y) and the
    centre's standard deviation [m].
    """
    if len(points) < MIN_ARC_HITS:
        return []
    apart = np.hypot(*np.diff(points, axis=0).T)
    arcs = np.split(points, np.flatnonzero(apart > ARC_GAP_M) + 1)
    found = (_disc_of_arc(arc, eye, radius) for arc in arcs)
    return [disc for disc in found if disc]


def _disc_of_arc(arc: Floats, eye: tuple[float, float], radius: float) -> FittedDisc | None:
    """Return the disc that an arc belongs to; None if it fits no disc."""
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
        """Sorted bearings with their ranges, padded at both ends by the opposite end."""
        bearings, ranges = self._polar(self.points)
        order = np.argsort(bearings)
        ends = np.concatenate((order[-1:], order, order[:1]))
        bearings = bearings[ends]
        bearings[:1] -= math.tau
        bearings[-1:] += math.tau
        return bearings, ranges[ends]

    def free(self, points: Floats) -> Bools:
        """Return which `points` (n, 2) were free: beams went well beyond them."""
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

    def hit(self, points: Floats, within: float) -> Bools:
        """Return which `points` (n, 2) have a hit of this scan within `within` [m]."""
        if not len(self.points):
            return np.zeros(len(points), dtype=np.bool_)
        dx, dy = (points[:, k, None] - self.points[:, k] for k in (0, 1))
        near: Bools = (dx * dx + dy * dy).min(axis=1) <= within * within
        return near

    def tolerance(self, other: "PastScan", x: float, y: float) -> float:
        """Return how far hits of a standing thing at (x, y) may differ in two scans [m].

        The odometry error grows with the distance and turn between the scans. From another place,
        range noise along a beam also appears sideways.
        """
        here, there = self._place, other._place
        turn = abs(math.remainder(here.yaw - there.yaw, math.tau))
        distance = math.hypot(here.x - there.x, here.y - there.y)
        away = math.hypot(x - here.x, y - here.y)
        parallax = min(1.0, distance / away) if away else 1.0
        return ODOMETRY_ERROR * (turn * away + distance) + BEYOND_MARGIN_M * parallax

    def _polar(self, points: Floats) -> tuple[Floats, Floats]:
        dx, dy = points[:, 0] - self._place.x, points[:, 1] - self._place.y
        bearings = np.arctan2(dy, dx) - self._place.yaw
        return np.mod(bearings + math.pi, math.tau) - math.pi, np.hypot(dx, dy)


class FreeSpace:
    """The newest scans, which show where space is or was free."""

    def __init__(self) -> None:
        self._scans: deque[PastScan] = deque(maxlen=KEPT_SCANS)

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()

    def add(self, scan: PastScan) -> None:
        """Add the newest scan."""
        self._scans.append(scan)

    def is_free(self, x: float, y: float) -> bool:
        """Return whether beams of the newest scan went through (x, y) [m]."""
        return bool(self._scans[-1].free(np.array([[x, y]]))[0])

    def shows_motion(
        self, x: float, y: float, velocity_x: float, velocity_y: float, radius: float
    ) -> bool:
        """Return whether free space confirms the velocity [m/s] of a disc at (x, y) [m]."""
        now, before = self._scans[-1], self._earlier_scan(math.hypot(velocity_x, velocity_y))
        if before is now:
            return False
        dt, within = (now.tick - before.tick) * TICK_S, now.tolerance(before, x, y)
        mine = _near(now.points, x, y, radius)
        was = _near(before.points, x - velocity_x * dt, y - velocity_y * dt, radius)
        return any(
            _share(scan.free(points) & ~scan.hit(points, within)) > MIN_FREE_SHARE
            for scan, points in ((before, mine), (now, was))
        )

    def shows_rest(
        self, x: float, y: float, velocity_x: float, velocity_y: float, radius: float
    ) -> bool:
        """Return whether hits before show rest of a disc at (x, y) [m], not its velocity [m/s].

        At rest, hits were at the same places. With that velocity, they were behind.
        """
        now, before = self._scans[-1], self._earlier_scan(math.hypot(velocity_x, velocity_y))
        dt, within = (now.tick - before.tick) * TICK_S, now.tolerance(before, x, y)
        mine = _near(now.points, x, y, radius)
        behind = mine - np.array((velocity_x, velocity_y)) * dt
        stood, moved = (before.hit(points, within + NOISE_GATE_M) for points in (mine, behind))
        return before is not now and _share(stood) > _share(moved) + MIN_STATIC_SHARE

    def _earlier_scan(self, speed: float) -> PastScan:
        """Return the earlier scan that is compared for a thing of this `speed` [m/s]."""
        now = self._scans[-1]
        min_age_s = COMPARED_S if speed * COMPARED_S < MOTION_M else MOTION_M / speed
        old = [scan for scan in self._scans if (now.tick - scan.tick) * TICK_S >= min_age_s]
        return old[-1] if old else self._scans[0]


def _near(points: Floats, x: float, y: float, radius: float) -> Floats:
    found: Floats = points[np.hypot(points[:, 0] - x, points[:, 1] - y) < radius + HIT_MARGIN_M]
    return found


def _share(mask: Bools) -> float:
    return np.count_nonzero(mask) / len(mask) if len(mask) else 0.0
