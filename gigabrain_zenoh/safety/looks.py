"""Where the lidar does not look now: free as far as it has just seen, or the body has just stood.

A lidar that covers 270 degrees has looked at what is behind the body on the way there. For half a
minute the newest scan that looked at a place says whether it is free, and nothing stands where the
body itself has been. Of all else nothing is known.
"""

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.body import BodyDescription, Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import relative
from gigabrain_zenoh.geometry.scan import Floats
from gigabrain_zenoh.geometry.sweep import depth, edges, radius

OLDEST_TICKS = 30_000_000_000 // TICK_NS
SPACING_M = 0.05  # of the places that are looked from; turns count by how far they take a corner
MOST = 48  # places
JUMP_M = 0.5  # so far from one scan to the next, and the odometry has begun anew
NEAR_M = 0.05  # what is nearer than this to where a beam ends is not free
GAP = math.radians(10)  # [rad], narrower ones are no blind side
EDGE = 1e-9  # [rad]


class Look(msgspec.Struct, frozen=True):
    """A scan, and where the body was in the odometry."""

    pose: Pose
    scan: LaserScan


Looks = tuple[Look, ...]  # oldest first, the last one from where the body is now


def then(looks: Looks, body: BodyDescription, pose: Pose, scan: LaserScan) -> Looks:
    """What is remembered once the body has this scan at `pose`; nothing if that looks all round."""
    if abs(scan.angle_increment) * len(ranges(scan)) > math.tau - GAP:
        return ()
    outer = radius(body.footprint)
    if looks and _way(looks[-1].pose, pose, outer) > JUMP_M:
        looks = ()
    here = _place(pose, outer)
    kept = tuple(
        look
        for look in looks
        if scan.basis - look.scan.basis <= OLDEST_TICKS and _place(look.pose, outer) != here
    )
    return (*kept, Look(pose, scan))[-MOST:]


def _way(a: Pose, b: Pose, outer: float) -> float:
    turned = math.remainder(b.yaw - a.yaw, math.tau)
    return math.hypot(b.x - a.x, b.y - a.y) + outer * abs(turned)


def _place(pose: Pose, outer: float) -> tuple[int, ...]:
    """The same for poses so near that the newer look tells all that the older one did."""
    return tuple(round(way / SPACING_M) for way in (pose.x, pose.y, pose.yaw * outer))


def free(
    body: BodyDescription, lidar: Lidar, nearest: float, looks: Looks, points: Floats
) -> NDArray[np.bool_]:
    """Which of `points` (n, 2) [m], in the frame of the body as it is now, are known to be free.

    Beams below `nearest` [m] have hit the lidar's own housing.
    """
    found, asked = np.zeros(len(points), bool), np.arange(len(points))
    hull = edges(body.footprint)
    for look in reversed(looks[:-1]):
        if not asked.size:
            break
        here = relative(look.pose, looks[-1].pose)
        cosine, sine = math.cos(here.yaw), math.sin(here.yaw)
        placed = points[asked] @ np.array([[cosine, sine], [-sine, cosine]]) + (here.x, here.y)
        stood = depth(hull, placed) < 0
        through, hit = _seen(lidar, nearest, look.scan, placed)
        found[asked[stood | (through & ~hit)]] = True
        asked = asked[~(stood | through | hit)]
    return found


def _seen(
    lidar: Lidar, nearest: float, scan: LaserScan, points: Floats
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which `points` in the body's frame a scan looked through, and which are where it hit."""
    values = ranges(scan).astype(np.float64)
    unknown = values < nearest
    if lidar.no_return == "unknown":
        unknown |= np.isinf(values)
    values[unknown] = np.nan
    x, y = points[:, 0] - lidar.x, points[:, 1] - lidar.y
    distance, step = np.hypot(x, y), scan.angle_increment
    ahead = (np.arctan2(y, x) - lidar.yaw - scan.angle_min) * math.copysign(1.0, step) + EDGE
    beam = np.floor(np.remainder(ahead, math.tau) / abs(step)).astype(np.intp)
    covered = beam + 1 < len(values)
    beam = np.where(covered, beam, 0)
    ends = np.stack([values[beam], values[beam + 1]])
    through = covered & (ends > distance + NEAR_M).all(axis=0)
    hit = covered & (np.abs(ends - distance) <= NEAR_M).any(axis=0)
    return through, hit
