"""Drive straight on; turn on the spot while something is ahead; wait while nothing is known."""

import math
from functools import lru_cache
from typing import ClassVar

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import Intent, TrajectoryPoint, WorldModel
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import Situation

HORIZON_S, STEP_S = 2.0, 0.25  # how far ahead the expected trajectory reaches, and how finely
OPEN_M = 2.5  # [m], farther counts as open; a leg with nothing in sight is expected to be so long
TURN_RAD = math.pi / 2  # how far a turn is expected to go


class Avoid:
    """The simplest behaviour that keeps a robot moving and whole."""

    SETTINGS = frozenset({"turn", "linear_speed", "angular_speed"})
    PARAMS: ClassVar = {
        "linear_speed": "a number above 0, up to 10 [m/s]; the body's own limit holds as well",
        "angular_speed": "a number above 0, up to 10 [rad/s]; the body's own limit holds as well",
        "turn": "one of: right, left, clearer",
    }

    def __init__(self, config: DecisionConfig) -> None:
        self._config = config
        self._doing = "waiting"
        self._began = Pose(x=0.0, y=0.0, yaw=0.0)
        self._expected = 1.0  # [m] straight on, [rad] turning
        self._progress = 0.0

    def configure(self, config: DecisionConfig) -> None:
        """Go by other settings; a turn once begun keeps its side."""
        self._config = config

    def step(self, situation: Situation) -> Intent:
        """What to do now, with the reason in words."""
        world = situation.world
        if situation.must_charge:
            return self._wait("resting: the battery is nearly empty; charge it")
        if world is None:
            return self._wait("waiting: perception is silent")
        if not world.scan_ok:
            return self._wait(f"waiting: {world.scan_problem}")
        if world.obstacle_ahead:
            return self._turn(world, situation.pose)
        return self._straight(world, situation.pose)

    def _wait(self, reason: str) -> Intent:
        self._doing = "waiting"
        return Intent(twist=Velocity(), behaviour="avoid", reason=reason)

    def _straight(self, world: WorldModel, pose: Pose) -> Intent:
        if self._doing != "forward":
            free = world.sectors[0] if world.sectors else None
            self._begin("forward", pose, OPEN_M if free is None else free)
        done = math.hypot(pose.x - self._began.x, pose.y - self._began.y)
        speed = self._config.linear_speed
        return self._intent(Velocity(linear_x=speed), done, f"forward {speed:.2f} m/s")

    def _turn(self, world: WorldModel, pose: Pose) -> Intent:
        if not self._doing.startswith("turning"):
            self._begin(f"turning {self._side(world)}", pose, TURN_RAD)
        done = abs(math.remainder(pose.yaw - self._began.yaw, 2 * math.pi))
        sign = 1.0 if self._doing == "turning left" else -1.0
        what = "obstacle"
        if world.distance_ahead is not None:
            what = f"obstacle {world.distance_ahead:.2f} m ahead"
        twist = Velocity(angular_z=sign * self._config.angular_speed)
        return self._intent(twist, done, f"{self._doing}: {what}")

    def _side(self, world: WorldModel) -> str:
        if self._config.turn != "clearer":
            return self._config.turn
        free = [OPEN_M if d is None else min(d, OPEN_M) for d in world.sectors]
        left, right = free[1 : (len(free) + 1) // 2], free[len(free) // 2 + 1 :]
        return "left" if sum(left) > sum(right) else "right"

    def _begin(self, doing: str, pose: Pose, expected: float) -> None:
        self._doing, self._began, self._progress = doing, pose, 0.0
        self._expected = max(expected, 0.1)

    def _intent(self, twist: Velocity, done: float, reason: str) -> Intent:
        self._progress = min(1.0, max(self._progress, done / self._expected))
        return Intent(
            twist=twist,
            trajectory=expected_trajectory(twist),
            progress=self._progress,
            behaviour="avoid",
            reason=reason,
        )


@lru_cache(maxsize=16)
def expected_trajectory(twist: Velocity) -> tuple[TrajectoryPoint, ...]:
    """Where a constant twist leads from the present pose, as an arc in the body's frame."""
    v, w = twist.linear_x, twist.angular_z
    points = []
    for i in range(1, round(HORIZON_S / STEP_S) + 1):
        t = i * STEP_S
        yaw = w * t
        x = v * t if abs(w) < 1e-6 else v / w * math.sin(yaw)
        y = 0.0 if abs(w) < 1e-6 else v / w * (1 - math.cos(yaw))
        points.append(TrajectoryPoint(t=t, x=x, y=y, yaw=yaw, linear_x=v, angular_z=w))
    return tuple(points)
