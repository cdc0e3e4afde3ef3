"""Planar poses without numpy (compose, invert, interpolate), and the history of odometry poses."""

import math
from bisect import bisect_left

from msgspec import Struct

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState

ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)

KEPT_STATES = 100  # states; 2 s
MAX_GAP_TICKS = 10  # interpolate two states; over wider gaps no pose is interpolated


def wrap_angle(angle: float) -> float:
    """Return `angle` [rad] wrapped to [-pi, pi]."""
    return math.remainder(angle, math.tau)


def compose(frame: Pose, pose: Pose) -> Pose:
    """Transform `pose` from `frame` to the parent frame, in which `frame` itself is given."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    return Pose(
        x=frame.x + cosine * pose.x - sine * pose.y,
        y=frame.y + sine * pose.x + cosine * pose.y,
        yaw=wrap_angle(frame.yaw + pose.yaw),
    )


def relative(frame: Pose, pose: Pose) -> Pose:
    """Return `pose` relative to `frame`, both given in the same frame. Inverse of `compose`."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    dx, dy = pose.x - frame.x, pose.y - frame.y
    return Pose(
        x=cosine * dx + sine * dy,
        y=cosine * dy - sine * dx,
        yaw=wrap_angle(pose.yaw - frame.yaw),
    )


def inverse(pose: Pose) -> Pose:
    """Return the inverse transform: the parent frame as seen from `pose`."""
    return relative(pose, ORIGIN)


def interpolate(before: Pose, after: Pose, share: float) -> Pose:
    """Interpolate from `before` (`share` 0) to `after` (1); yaw takes the shorter direction."""
    return Pose(
        x=before.x + share * (after.x - before.x),
        y=before.y + share * (after.y - before.y),
        yaw=wrap_angle(before.yaw + share * wrap_angle(after.yaw - before.yaw)),
    )


class PoseHistory(Struct, frozen=True):
    """Odometry poses of the newest states. Immutable: `then` returns a new history."""

    boot: int = 0
    ticks: tuple[int, ...] = ()  # ascending
    poses: tuple[Pose, ...] = ()

    def then(self, state: RobotState) -> "PoseHistory":
        """Return a history with `state` added; it is cleared first if the driver has restarted.

        A driver restart resets the odometry. A state that is not newer than the last one is
        ignored.
        """
        if state.boot != self.boot:
            return PoseHistory(state.boot, (state.tick,), (state.pose,))
        if self.ticks and state.tick <= self.ticks[-1]:
            return self
        ticks, poses = (*self.ticks, state.tick), (*self.poses, state.pose)
        return PoseHistory(self.boot, ticks[-KEPT_STATES:], poses[-KEPT_STATES:])

    def at(self, boot: int, tick: int) -> Pose | None:
        """Return the pose at `tick`, interpolated if necessary; None if unavailable."""
        if boot != self.boot:
            return None
        i = bisect_left(self.ticks, tick)
        if i == len(self.ticks):
            return None
        after = self.ticks[i]
        if after == tick:
            return self.poses[i]
        if i == 0 or after - self.ticks[i - 1] > MAX_GAP_TICKS:
            return None
        before = self.ticks[i - 1]
        return interpolate(self.poses[i - 1], self.poses[i], (tick - before) / (after - before))

    @property
    def newest_tick(self) -> int:
        """Return the tick of the newest state; 0 before the first state."""
        return self.ticks[-1] if self.ticks else 0
