"""Obstacles assumed where the lidar sees nothing now, unless earlier scans show free space.

The surroundings are divided into sectors that keep their direction while the body turns. A sector
without a valid beam counts as an obstacle. Its range is the last valid one, minus the distance that
the body may have moved since. A lidar that covers 270 degrees saw the space behind the body
earlier. There a place counts as free for 30 s if the newest scan of it shows that, or if the body
stood on it. Nothing else is assumed to be free.
"""

import math

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.body import BodyDescription, Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import relative
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.geometry.sweep import depth, edges, radius

SECTORS = 36
SECTOR_RAD = math.tau / SECTORS
CONTACT_M = 0.001  # just outside the footprint
PROBE_STEP_M, PROBE_MAX_M = 0.05, 0.35  # distances from the body, checked in past views
MAX_AGE_TICKS = 30_000_000_000 // TICK_NS  # of a past view: 30 s
VIEW_SPACING_M = 0.05  # between past views; a turn counts by the travel of a corner
MAX_VIEWS = 48
JUMP_M = 0.5  # farther between two scans, the odometry has restarted
HIT_TOLERANCE_M = 0.05  # a point this close to the end of a beam is not free
MIN_GAP_RAD = math.radians(10)  # a narrower gap in the scan is no blind spot
ANGLE_EPSILON_RAD = 1e-9

Ranges = tuple[float, ...]  # (SECTORS,) [m], counter-clockwise from yaw 0


class PastView(Struct, frozen=True):
    """A scan, and the odometry pose of the body at that time."""

    pose: Pose
    scan: LaserScan


PastViews = tuple[PastView, ...]  # oldest first; the last one is from the present pose


def update(
    lidar: Lidar, scan: LaserScan, housing_m: float, yaw: float, last: Ranges, moved_m: float
) -> tuple[Ranges, tuple[int, ...]]:
    """Return the nearest range of each sector [m], and the unknown sectors.

    `yaw` is the body's. `last` has the ranges of the scan before, and is empty at the start. The
    body may have moved by `moved_m` since then. Ranges below `housing_m` are invalid.
    """
    values = scan.ranges_m.astype(np.float64)
    sector = _sectors(lidar, scan, yaw)
    known = values >= housing_m
    if lidar.no_return == "unknown":
        known &= values < np.inf
    near = np.full(SECTORS, np.inf)
    np.minimum.at(near, sector[known], values[known])
    seen = np.zeros(SECTORS, bool)
    seen[sector[known]] = True
    before = np.array(last) if last else _first_ranges(lidar, values, sector)
    now = np.where(seen, near, np.maximum(0.0, before - moved_m))
    return tuple(now.tolist()), tuple(np.flatnonzero(~seen).tolist())


def _first_ranges(lidar: Lidar, values: Floats, sector: NDArray[np.intp]) -> Floats:
    """Return the ranges of sectors at the start (SECTORS,) [m]; 0 without a beam.

    A beam without an echo counts as the lidar's reach, since a person watches the start.
    """
    far = np.zeros(SECTORS)
    far[sector[np.isinf(values)]] = lidar.range_max
    return far


def _sectors(lidar: Lidar, scan: LaserScan, yaw: float) -> NDArray[np.intp]:
    """Return the sector of each beam (beams,) for a body at `yaw`."""
    beams = np.arange(len(scan.ranges_m))
    angles = scan.angle_min + (lidar.yaw + yaw) + scan.angle_increment * beams
    sectors: NDArray[np.intp] = (
        np.floor((angles + ANGLE_EPSILON_RAD) / SECTOR_RAD).astype(np.intp) % SECTORS
    )
    return sectors


def obstacles(
    body: BodyDescription,
    yaw: float,
    nearest: Ranges,
    unknown: tuple[int, ...],
    housing_m: float,
    past: PastViews,
) -> Floats:
    """Return points (n, 2) [m] in the body's frame that stand for the `unknown` sectors.

    Each sector has three: at both edges and in the middle.
    """
    lidar = body.lidar
    if lidar is None or not unknown:
        return np.empty((0, 2))
    sectors = np.repeat(np.array(unknown), 3)
    bearing = (sectors + np.tile([0.0, 0.5, 1.0], len(unknown))) * SECTOR_RAD - yaw
    heading = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    hull, mount = edges(body.footprint), np.array([lidar.x, lidar.y])
    towards = heading @ hull.normals.T
    room = hull.offsets - hull.normals @ mount
    with np.errstate(divide="ignore"):
        exits = np.where(towards > 0, room / towards, np.inf).min(axis=1)
    reach = np.maximum(np.array(nearest)[sectors], exits + CONTACT_M)
    if past:
        blind = ~np.isin(sectors, _sectors(lidar, past[-1].scan, yaw))
        steps = np.arange(CONTACT_M, PROBE_MAX_M + PROBE_STEP_M / 2, PROBE_STEP_M)
        probes = exits[blind, None] + steps
        points = (mount + probes[..., None] * heading[blind, None]).reshape(-1, 2)
        free = known_free(body, lidar, housing_m, past, points).reshape(probes.shape)
        end = np.where(free.all(axis=1), probes.shape[1] - 1, free.argmin(axis=1))
        reach[blind] = np.maximum(reach[blind], probes[np.arange(len(probes)), end])
    found: Floats = (mount + reach[:, None] * heading)[np.isfinite(reach)]
    return found


def remember(views: PastViews, body: BodyDescription, pose: Pose, scan: LaserScan) -> PastViews:
    """Add a view at `pose`; return no views if the scan covers the full circle."""
    if abs(scan.angle_increment) * len(scan.ranges_m) > math.tau - MIN_GAP_RAD:
        return ()
    outer_m = radius(body.footprint)
    if views and _distance(views[-1].pose, pose, outer_m) > JUMP_M:
        views = ()
    cell = _cell(pose, outer_m)
    kept = tuple(
        view
        for view in views
        if scan.basis - view.scan.basis <= MAX_AGE_TICKS and _cell(view.pose, outer_m) != cell
    )
    return (*kept, PastView(pose, scan))[-MAX_VIEWS:]


def _distance(a: Pose, b: Pose, outer_m: float) -> float:
    turned = math.remainder(b.yaw - a.yaw, math.tau)
    return math.hypot(b.x - a.x, b.y - a.y) + outer_m * abs(turned)


def _cell(pose: Pose, outer_m: float) -> tuple[int, ...]:
    """Return the grid cell of a pose; each cell keeps its newest view."""
    return tuple(round(value / VIEW_SPACING_M) for value in (pose.x, pose.y, pose.yaw * outer_m))


def known_free(
    body: BodyDescription, lidar: Lidar, housing_m: float, views: PastViews, points: Floats
) -> NDArray[np.bool_]:
    """Return a mask of the `points` (n, 2) [m], in the body's present frame, that are free."""
    found, pending = np.zeros(len(points), bool), np.arange(len(points))
    hull = edges(body.footprint)
    for view in reversed(views[:-1]):
        if not pending.size:
            break
        placed = transform(from_pose(relative(view.pose, views[-1].pose)), points[pending])
        stood = depth(hull, placed) < 0
        passed, hit = _seen(lidar, housing_m, view.scan, placed)
        found[pending[stood | (passed & ~hit)]] = True
        pending = pending[~(stood | passed | hit)]
    return found


def _seen(
    lidar: Lidar, housing_m: float, scan: LaserScan, points: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return masks of the `points` (n, 2), in the body's frame, that beams passed and hit."""
    values = scan.ranges_m.astype(np.float64)
    unknown = values < housing_m
    if lidar.no_return == "unknown":
        unknown |= np.isinf(values)
    values[unknown] = np.nan
    x, y = points[:, 0] - lidar.x, points[:, 1] - lidar.y
    distance, step = np.hypot(x, y), scan.angle_increment
    angle = (np.arctan2(y, x) - lidar.yaw - scan.angle_min) * math.copysign(1.0, step)
    angle += ANGLE_EPSILON_RAD
    beam = np.floor(np.remainder(angle, math.tau) / abs(step)).astype(np.intp)
    covered = beam + 1 < len(values)
    beam = np.where(covered, beam, 0)
    ranges = np.stack([values[beam], values[beam + 1]])
    passed = covered & (ranges > distance + HIT_TOLERANCE_M).all(axis=0)
    hit = covered & (np.abs(ranges - distance) <= HIT_TOLERANCE_M).any(axis=0)
    return passed, hit
