"""Obstacles assumed where the lidar sees nothing now, and what is known to be free there.

The surroundings are divided into sectors that keep their direction while the body turns. A sector
without a valid beam stands for an obstacle. Its range is the last one, less the distance that the
body may have moved since. A lidar that covers 270 degrees has seen what is behind the body on the
way there: for half a minute the newest scan of a place tells whether it is free, and so does having
stood there. Nothing else is assumed to be free.
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
CONTACT_M = 0.001  # outside the footprint
PROBE_STEP_M, PROBE_MAX_M = 0.05, 0.35  # distances from the body that are looked up in past views
MAX_AGE_TICKS = 30_000_000_000 // TICK_NS  # of a past view
VIEW_SPACING_M = 0.05  # turns count by how far they move a corner
MAX_VIEWS = 48
JUMP_M = 0.5  # between two scans: the odometry has restarted
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

    `yaw` is the body's; `last` has the ranges of the scan before, or is empty at the start. Since
    then the body may have moved by `moved_m` [m]. Ranges below `housing_m` are invalid.
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
    """Return ranges for sectors never seen: the lidar's reach where no echo came, since a person
    has looked; 0 where it has no beam.
    """
    far = np.zeros(SECTORS)
    far[sector[np.isinf(values)]] = lidar.range_max
    return far


def _sectors(lidar: Lidar, scan: LaserScan, yaw: float) -> NDArray[np.intp]:
    """Return the sector of each beam (beams,), for a body that is turned by `yaw`."""
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

    There are three for each: at its edges and in its middle.
    """
    lidar = body.lidar
    if lidar is None or not unknown:
        return np.empty((0, 2))
    where = np.repeat(np.array(unknown), 3)
    bearing = (where + np.tile([0.0, 0.5, 1.0], len(unknown))) * SECTOR_RAD - yaw
    heading = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    hull, mount = edges(body.footprint), np.array([lidar.x, lidar.y])
    towards = heading @ hull.normals.T
    room = hull.offsets - hull.normals @ mount
    with np.errstate(divide="ignore"):
        leaves = np.where(towards > 0, room / towards, np.inf).min(axis=1)
    reach = np.maximum(np.array(nearest)[where], leaves + CONTACT_M)
    if past:
        blind = ~np.isin(where, _sectors(lidar, past[-1].scan, yaw))
        steps = np.arange(CONTACT_M, PROBE_MAX_M + PROBE_STEP_M / 2, PROBE_STEP_M)
        ways = leaves[blind, None] + steps
        points = (mount + ways[..., None] * heading[blind, None]).reshape(-1, 2)
        known = known_free(body, lidar, housing_m, past, points).reshape(ways.shape)
        first = np.where(known.all(axis=1), ways.shape[1] - 1, known.argmin(axis=1))
        reach[blind] = np.maximum(reach[blind], ways[np.arange(len(ways)), first])
    found: Floats = (mount + reach[:, None] * heading)[np.isfinite(reach)]
    return found


def remember(views: PastViews, body: BodyDescription, pose: Pose, scan: LaserScan) -> PastViews:
    """Return the views with a new one at `pose`; none if the scan covers the full circle."""
    if abs(scan.angle_increment) * len(scan.ranges_m) > math.tau - MIN_GAP_RAD:
        return ()
    outer = radius(body.footprint)
    if views and _distance(views[-1].pose, pose, outer) > JUMP_M:
        views = ()
    here = _cell(pose, outer)
    kept = tuple(
        view
        for view in views
        if scan.basis - view.scan.basis <= MAX_AGE_TICKS and _cell(view.pose, outer) != here
    )
    return (*kept, PastView(pose, scan))[-MAX_VIEWS:]


def _distance(a: Pose, b: Pose, outer: float) -> float:
    turned = math.remainder(b.yaw - a.yaw, math.tau)
    return math.hypot(b.x - a.x, b.y - a.y) + outer * abs(turned)


def _cell(pose: Pose, outer: float) -> tuple[int, ...]:
    """Return the cell of a pose: of two views in one cell the newer tells all."""
    return tuple(round(way / VIEW_SPACING_M) for way in (pose.x, pose.y, pose.yaw * outer))


def known_free(
    body: BodyDescription, lidar: Lidar, housing_m: float, views: PastViews, points: Floats
) -> NDArray[np.bool_]:
    """Return which of `points` (n, 2) [m], in the body's present frame, are known to be free."""
    found, pending = np.zeros(len(points), bool), np.arange(len(points))
    hull = edges(body.footprint)
    for view in reversed(views[:-1]):
        if not pending.size:
            break
        placed = transform(from_pose(relative(view.pose, views[-1].pose)), points[pending])
        stood = depth(hull, placed) < 0
        through, hit = _seen(lidar, housing_m, view.scan, placed)
        found[pending[stood | (through & ~hit)]] = True
        pending = pending[~(stood | through | hit)]
    return found


def _seen(
    lidar: Lidar, housing_m: float, scan: LaserScan, points: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which `points` in the body's frame beams passed through, and which they hit."""
    values = scan.ranges_m.astype(np.float64)
    unknown = values < housing_m
    if lidar.no_return == "unknown":
        unknown |= np.isinf(values)
    values[unknown] = np.nan
    x, y = points[:, 0] - lidar.x, points[:, 1] - lidar.y
    distance, step = np.hypot(x, y), scan.angle_increment
    ahead = (np.arctan2(y, x) - lidar.yaw - scan.angle_min) * math.copysign(1.0, step)
    ahead += ANGLE_EPSILON_RAD
    beam = np.floor(np.remainder(ahead, math.tau) / abs(step)).astype(np.intp)
    covered = beam + 1 < len(values)
    beam = np.where(covered, beam, 0)
    ends = np.stack([values[beam], values[beam + 1]])
    through = covered & (ends > distance + HIT_TOLERANCE_M).all(axis=0)
    hit = covered & (np.abs(ends - distance) <= HIT_TOLERANCE_M).any(axis=0)
    return through, hit
