"""Drive straight ahead, turn in place at obstacles, and wait while nothing is known."""

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, ClassVar, Literal

from msgspec import Struct

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import Intent, TrajectoryPoint, WorldModel
from gigabrain_zenoh.decision.behaviours import Inputs, SpeedLimit, StepOutcome, StepResult

HORIZON_S, STEP_S = 2.0, 0.25  # of the expected trajectory
MAX_LEG_M = 2.5  # expected length of a straight leg without obstacles
TURN_RAD = math.pi / 2  # expected angle of a turn


class AvoidConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the behaviour `avoid`."""

    turn: Literal["right", "left", "clearer"] = "right"
    max_linear_speed: SpeedLimit = 0.2  # [m/s]
    max_angular_speed: SpeedLimit = 0.5  # [rad/s]


class Avoid:
    """The simplest behaviour that keeps a robot moving without collisions."""

    Config = AvoidConfig
    PARAMS: ClassVar[Mapping[str, str]] = {
        "max_linear_speed": "a number above 0, up to 10 [m/s]; the body's own limit holds as well",
        "max_angular_speed": (
            "a number above 0, up to 10 [rad/s]; the body's own limit holds as well"
        ),
        "turn": "one of: right, left, clearer",
    }
    DEMO: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, config: AvoidConfig) -> None:
        self._config = config
        self._activity = "waiting"
        self._turn: Literal["", "left", "right"] = ""
        self._start = Pose(x=0.0, y=0.0, yaw=0.0)
        self._expected = 1.0  # [m] straight, [rad] turning
        self._progress = 0.0

    def configure(self, config: AvoidConfig) -> None:
        """Replace the settings; a turn in progress keeps its side."""
        self._config = config

    def step(self, inputs: Inputs) -> StepResult:
        """Return the intent for what is ahead."""
        world = inputs.world
        if inputs.must_charge:
            return self._wait("the battery is nearly empty; charge it", "resting")
        if world is None:
            return self._wait("perception is silent")
        if not world.scan_ok:
            return self._wait(world.scan_problem)
        if world.obstacle_ahead:
            return self._turn_away(world, inputs.pose)
        return self._straight(world, inputs.pose)

    def _wait(self, reason: str, activity: str = "waiting") -> StepResult:
        self._activity, self._turn = activity, ""
        text = f"{activity}: {reason}"
        intent = Intent(twist=Velocity(), behaviour="avoid", reason=text)
        return intent, StepOutcome(activity=activity, reason=text)

    def _straight(self, world: WorldModel, pose: Pose) -> StepResult:
        if self._activity != "forward":
            free = world.sectors[0] if world.sectors else None
            self._begin("forward", pose, MAX_LEG_M if free is None else free)
        driven = math.hypot(pose.x - self._start.x, pose.y - self._start.y)
        speed = self._config.max_linear_speed
        text = f"forward {speed:.2f} m/s"
        return self._step(Velocity(linear_x=speed), driven, text, activity=text)

    def _turn_away(self, world: WorldModel, pose: Pose) -> StepResult:
        if not self._turn:
            side = self._side(world)
            self._begin(f"turning {side}", pose, TURN_RAD, side)
        turned = abs(math.remainder(pose.yaw - self._start.yaw, 2 * math.pi))
        sign = 1.0 if self._turn == "left" else -1.0
        obstacle = "obstacle"
        if world.distance_ahead is not None:
            obstacle = f"obstacle {world.distance_ahead:.2f} m ahead"
        twist = Velocity(angular_z=sign * self._config.max_angular_speed)
        return self._step(twist, turned, f"{self._activity}: {obstacle}", activity=self._activity)

    def _side(self, world: WorldModel) -> Literal["left", "right"]:
        if self._config.turn != "clearer":
            return self._config.turn
        free = [MAX_LEG_M if d is None else min(d, MAX_LEG_M) for d in world.sectors]
        left, right = free[1 : (len(free) + 1) // 2], free[len(free) // 2 + 1 :]
        return "left" if sum(left) > sum(right) else "right"

    def _begin(
        self, activity: str, pose: Pose, expected: float, turn: Literal["", "left", "right"] = ""
    ) -> None:
        self._activity, self._turn = activity, turn
        self._start, self._progress = pose, 0.0
        self._expected = max(expected, 0.1)

    def _step(self, twist: Velocity, done: float, reason: str, *, activity: str) -> StepResult:
        self._progress = min(1.0, max(self._progress, done / self._expected))
        intent = Intent(
            twist=twist,
            trajectory=expected_trajectory(twist),
            progress=self._progress,
            behaviour="avoid",
            reason=reason,
        )
        return intent, StepOutcome(activity=activity, reason=reason, progress=self._progress)


@lru_cache(maxsize=16)
def expected_trajectory(twist: Velocity) -> tuple[TrajectoryPoint, ...]:
    """Return the arc of a constant twist, in the body's current frame."""
    v, w = twist.linear_x, twist.angular_z
    points = []
    for i in range(1, round(HORIZON_S / STEP_S) + 1):
        t = i * STEP_S
        yaw = w * t
        x = v * t if abs(w) < 1e-6 else v / w * math.sin(yaw)
        y = 0.0 if abs(w) < 1e-6 else v / w * (1 - math.cos(yaw))
        points.append(TrajectoryPoint(t=t, x=x, y=y, yaw=yaw, linear_x=v, angular_z=w))
    return tuple(points)
