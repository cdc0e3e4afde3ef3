"""Whether a thing has moved: it is where beams passed before, or they pass where it was.

What only shows another side, or comes out of a shadow, does neither.
"""

import math
from collections import deque
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.geometry.planar import compose

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

TICK_S = TICK_NS / 1e9
MOVED_M = 0.4  # or by something quick, since it has gone so far
BEFORE_S = 0.5  # what was seen so long ago is compared
KEPT = 32  # scans
MARGIN_M = 0.12  # beyond a point; noise and odometry do not reach so far
ROUND_M = 0.1  # round a thing, its hits may lie
SHARE = 0.35  # of its hits that must be in free space
EDGE_BEAMS = 3  # at the ends of the field of view


class Seen:
    """One scan in the frame of the odometry. Its field of view is centred ahead of the lidar."""

    def __init__(self, tick: int, points: Floats, lidar: Lidar, spacing: float, pose: Pose) -> None:
        place = compose(pose, Pose(x=lidar.x, y=lidar.y, yaw=lidar.yaw))
        self.tick, self.points, self._place, self._spacing = tick, points, place, spacing
        self._reach, half = lidar.range_max, lidar.beams * spacing / 2
        self._half = math.pi if half > math.pi - spacing else half - EDGE_BEAMS * spacing

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
        passed = (np.abs(bearings) < self._half) & (ranges < self._reach - MARGIN_M)
        if not len(seen):
            return passed
        after = np.clip(np.searchsorted(seen, bearings), 1, len(seen) - 1)
        for beam in (after - 1, after):
            beside = np.abs(seen[beam] - bearings) < 1.5 * self._spacing
            passed &= ~beside | (far[beam] > ranges + MARGIN_M)
        return passed

    def _polar(self, points: Floats) -> tuple[Floats, Floats]:
        dx, dy = points[:, 0] - self._place.x, points[:, 1] - self._place.y
        bearings = np.arctan2(dy, dx) - self._place.yaw
        return np.mod(bearings + math.pi, math.tau) - math.pi, np.hypot(dx, dy)


class FreeSpace:
    """The scans of the last second."""

    def __init__(self) -> None:
        self._scans: deque[Seen] = deque(maxlen=KEPT)

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()

    def see(self, scan: Seen) -> None:
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
        long_ago = BEFORE_S if speed * BEFORE_S < MOVED_M else MOVED_M / speed
        old = [scan for scan in self._scans if (now.tick - scan.tick) * TICK_S >= long_ago]
        before = old[-1] if old else self._scans[0]
        if before is now:
            return False
        dt = (now.tick - before.tick) * TICK_S
        mine = _near(now.points, x, y, radius)
        was = _near(before.points, x - velocity_x * dt, y - velocity_y * dt, radius)
        return _share(before.free(mine)) > SHARE or _share(now.free(was)) > SHARE


def _near(points: Floats, x: float, y: float, radius: float) -> Floats:
    found: Floats = points[np.hypot(points[:, 0] - x, points[:, 1] - y) < radius + ROUND_M]
    return found


def _share(of: Bools) -> float:
    return float(of.mean()) if len(of) else 0.0
