"""Where the odometry had the robot of late, by the robot's clock."""

from bisect import bisect_left

from msgspec import Struct

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.planar import between

KEPT = 100  # states; 2 s
WIDEST_GAP_TICKS = 10  # between two states, over which a pose may still be worked out


class PoseHistory(Struct, frozen=True):
    """The odometry of the newest states. It does not change: `then` returns another one."""

    boot: int = 0
    ticks: tuple[int, ...] = ()  # ascending
    poses: tuple[Pose, ...] = ()

    def then(self, state: RobotState) -> "PoseHistory":
        """With one state more. A new start of the driver begins anew, for so does the odometry."""
        if state.boot != self.boot:
            return PoseHistory(state.boot, (state.tick,), (state.pose,))
        if self.ticks and state.tick <= self.ticks[-1]:
            return self
        ticks, poses = (*self.ticks, state.tick), (*self.poses, state.pose)
        return PoseHistory(self.boot, ticks[-KEPT:], poses[-KEPT:])

    def at(self, boot: int, tick: int) -> Pose | None:
        """The pose at `tick`, between two states where none came; None where it is not known."""
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
        """The tick of the newest state; 0 while none has come."""
        return self.ticks[-1] if self.ticks else 0
