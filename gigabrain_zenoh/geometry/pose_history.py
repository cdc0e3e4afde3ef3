"""Recent odometry poses (the last 2 s), by the robot's clock."""

from bisect import bisect_left

from msgspec import Struct

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.geometry.planar import between

KEPT = 100  # states; 2 s
WIDEST_GAP_TICKS = 10  # between two states; over wider gaps no pose is interpolated


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
        return PoseHistory(self.boot, ticks[-KEPT:], poses[-KEPT:])

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
        if i == 0 or after - self.ticks[i - 1] > WIDEST_GAP_TICKS:
            return None
        before = self.ticks[i - 1]
        return between(self.poses[i - 1], self.poses[i], (tick - before) / (after - before))

    @property
    def newest_tick(self) -> int:
        """Return the tick of the newest state; 0 before the first state."""
        return self.ticks[-1] if self.ticks else 0
