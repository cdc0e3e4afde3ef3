"""Planar poses without numpy, the history of odometry poses, and the pose of each scan.

For arrays of poses see `se2`.
"""

import math
from bisect import bisect_left
from collections.abc import Callable

from msgspec import Struct

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.sensors import LaserScan

ORIGIN = Pose(x=0.0, y=0.0, yaw=0.0)

KEPT_STATES = 100  # 2 s
MAX_GAP_TICKS = 10  # between states; no pose is interpolated over wider gaps


def wrap_angle(angle: float) -> float:
    """Return `angle` [rad] wrapped to [-pi, pi]."""
    return math.remainder(angle, math.tau)


def to_parent(frame: Pose, x: float, y: float) -> tuple[float, float]:
    """Transform a point from `frame` to the parent frame, in which `frame` itself is given."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    return frame.x + cosine * x - sine * y, frame.y + sine * x + cosine * y


def to_frame(frame: Pose, x: float, y: float) -> tuple[float, float]:
    """Transform a point from the parent frame to `frame`. Inverse of `to_parent`."""
    cosine, sine = math.cos(frame.yaw), math.sin(frame.yaw)
    dx, dy = x - frame.x, y - frame.y
    return cosine * dx + sine * dy, cosine * dy - sine * dx


def compose(frame: Pose, pose: Pose) -> Pose:
    """Transform `pose` from `frame` to the parent frame, in which `frame` itself is given."""
    x, y = to_parent(frame, pose.x, pose.y)
    return Pose(x=x, y=y, yaw=wrap_angle(frame.yaw + pose.yaw))


def relative(frame: Pose, pose: Pose) -> Pose:
    """Return `pose` relative to `frame`, both given in the same frame. Inverse of `compose`."""
    x, y = to_frame(frame, pose.x, pose.y)
    return Pose(x=x, y=y, yaw=wrap_angle(pose.yaw - frame.yaw))


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


def velocity_of(message: CmdVel | Twist) -> Velocity:
    """Return the velocity that a command requests."""
    return Velocity(
        linear_x=message.linear_x, linear_y=message.linear_y, angular_z=message.angular_z
    )


def axes(velocity: Velocity) -> tuple[float, float, float]:
    """Return a velocity as a tuple [m/s, m/s, rad/s]."""
    return velocity.linear_x, velocity.linear_y, velocity.angular_z


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
    def newest(self) -> Pose | None:
        """Return the pose of the newest state; None before the first state."""
        return self.poses[-1] if self.poses else None

    @property
    def newest_tick(self) -> int:
        """Return the tick of the newest state; 0 before the first state."""
        return self.ticks[-1] if self.ticks else 0


class PlacedScans:
    """Calls `on_scan(scan, pose)` for each scan; the pose is None if states are missing.

    A scan that arrives before the state of its tick waits for it, so that the outcome does not
    depend on which message came first. If another scan comes first, the waiting scan goes to
    `on_missed`.
    """

    def __init__(
        self,
        on_scan: Callable[[LaserScan, Pose | None], None],
        on_missed: Callable[[LaserScan], None],
    ) -> None:
        self._on_scan, self._on_missed = on_scan, on_missed
        self._waiting: LaserScan | None = None
        self.history = PoseHistory()

    def state(self, state: RobotState) -> None:
        """Add a robot state; process the waiting scan if its tick has been reached."""
        self.history = self.history.then(state)
        if self._waiting:
            self._place(self._waiting)

    def scan(self, scan: LaserScan) -> None:
        """Process a scan, or keep it until the state of its tick arrives."""
        if self._waiting:
            self._on_missed(self._waiting)
        self._place(scan)

    def _place(self, scan: LaserScan) -> None:
        """Pass a scan on if its tick has been reached; otherwise keep it waiting."""
        history = self.history
        self._waiting = scan
        if scan.boot == history.boot and scan.basis <= history.newest_tick:
            self._waiting = None
            self._on_scan(scan, history.at(scan.boot, scan.basis))
