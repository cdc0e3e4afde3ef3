"""Follow the leader: a perceptor finds who walks in front, and a behaviour follows.

Both run without a change to gigabrain_zenoh; `follow.yaml` puts them on a robot.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import DetectedObject, Intent
from gigabrain_zenoh.decision.behaviours import Inputs, StepOutcome, StepResult
from gigabrain_zenoh.geometry.pose import to_frame, to_parent
from gigabrain_zenoh.geometry.scan import hits
from gigabrain_zenoh.perception.perceptors import PerceptorInputs

NEAREST_M = 0.12  # nearer hits are the robot's own
GAP_M = 0.15  # between neighbouring points of two things
SMOOTHING = 0.3  # of a new velocity in the filtered one
LOST_SCANS = 15
HIDDEN_M = 1.0  # farthest that a leader moves while it is not seen


class LeaderConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the perceptor `leader`."""

    reach: float = 1.8  # [m], how far off a leader may be at first
    width: float = 0.7  # [m], widest that a leader is
    jump: float = 0.4  # [m], farthest that it moves from scan to scan
    radius: float = 0.25  # [m]


class Leader:
    """Finds the nearest narrow thing ahead, and keeps to it while it moves."""

    Config = LeaderConfig

    def __init__(self, config: LeaderConfig) -> None:
        self._config = config
        self._at: tuple[float, float] | None = None  # [m], in the odometry frame
        self._velocity = (0.0, 0.0)  # [m/s]
        self._boot = self._tick = self._unseen = 0

    def step(self, inputs: PerceptorInputs) -> Sequence[DetectedObject]:
        """Return the leader, or nobody."""
        if inputs.scan.boot != self._boot:  # the driver was restarted, and odometry began again
            self._boot, self._at, self._velocity = inputs.scan.boot, None, (0.0, 0.0)
        found = self._find(inputs)
        if found is None:
            self._unseen += 1
            if self._unseen > LOST_SCANS:
                self._at, self._velocity = None, (0.0, 0.0)
            return ()
        self._move(found, inputs.scan.basis)
        x, y = found
        vx, vy = self._velocity
        return (
            DetectedObject(
                id=1,
                x=x,
                y=y,
                velocity_x=vx,
                velocity_y=vy,
                radius=self._config.radius,
                label="leader",
            ),
        )

    def _find(self, inputs: PerceptorInputs) -> tuple[float, float] | None:
        if inputs.body.lidar is None:
            return None
        x, y = hits(inputs.body.lidar, inputs.scan, NEAREST_M)
        things = [
            self._middle(one) for one in clusters(np.column_stack((x, y)), self._config.width)
        ]
        if self._at is None:
            ahead = [(x, y) for x, y in things if x > 0 and abs(y) < x]
            near = [one for one in ahead if math.hypot(*one) < self._config.reach]
            if not near:
                return None
            return to_parent(inputs.pose, *min(near, key=lambda one: math.hypot(*one)))
        placed = [to_parent(inputs.pose, *one) for one in things]
        nearest = min(placed, key=lambda one: math.dist(one, self._at or one), default=None)
        jump = self._config.jump
        far = min(jump * (1 + self._unseen), max(jump, HIDDEN_M))
        return nearest if nearest and math.dist(nearest, self._at) < far else None

    def _middle(self, points: NDArray[np.float64]) -> tuple[float, float]:
        """Return the middle of a round thing of which the near side was hit."""
        x, y = points.mean(axis=0)
        beyond = 1.0 + 0.6 * self._config.radius / max(math.hypot(x, y), 1e-6)
        return float(x * beyond), float(y * beyond)

    def _move(self, found: tuple[float, float], tick: int) -> None:
        seconds = (tick - self._tick) * 0.02
        if self._at and seconds > 0:
            vx, vy = self._velocity
            self._velocity = (
                vx + SMOOTHING * ((found[0] - self._at[0]) / seconds - vx),
                vy + SMOOTHING * ((found[1] - self._at[1]) / seconds - vy),
            )
        self._at, self._tick, self._unseen = found, tick, 0


def clusters(points: NDArray[np.float64], width: float) -> list[NDArray[np.float64]]:
    """Return the groups of neighbouring points of a turn that are at most `width` wide [m]."""
    if len(points) < 2:
        return []
    gaps = np.hypot(*np.diff(points, axis=0).T) > GAP_M
    groups = np.split(points, np.flatnonzero(gaps) + 1)
    if len(groups) > 1 and math.dist(points[-1], points[0]) <= GAP_M:  # the turn is closed
        groups[0] = np.concatenate((groups.pop(), groups[0]))
    narrow = (one for one in groups if len(one) >= 3)
    return [one for one in narrow if math.hypot(*np.ptp(one, axis=0)) <= width]


class FollowConfig(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the behaviour `follow`."""

    distance: float = 0.9  # [m], from the robot's middle to the leader's
    max_linear_speed: float = 0.25  # [m/s]
    max_angular_speed: float = 1.0  # [rad/s]


class Follow:
    """Keeps its distance to the leader, backing away where it must, and faces it."""

    Config = FollowConfig
    PARAMS: ClassVar[Mapping[str, str]] = {"distance": "a number [m]"}
    DEMO: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, config: FollowConfig) -> None:
        self._config = config

    def configure(self, config: FollowConfig) -> None:
        """Use other settings from now on."""
        self._config = config

    def step(self, inputs: Inputs) -> StepResult:
        """Return the intent for one scan."""
        found = inputs.objects.get("leader")
        if inputs.world is None or not inputs.world.scan_ok:
            return stand("waiting for a scan")
        if not found or not found.objects:
            return stand("nobody to follow")
        return self._follow(inputs.pose, found.objects[0])

    def _follow(self, pose: Pose, leader: DetectedObject) -> StepResult:
        x, y = to_frame(pose, leader.x, leader.y)
        away, bearing = math.hypot(x, y), math.atan2(y, x)
        forward = leader.velocity_x * math.cos(pose.yaw) + leader.velocity_y * math.sin(pose.yaw)
        wanted = 0.8 * (away - self._config.distance) + max(0.0, forward)
        wanted *= max(0.0, math.cos(bearing))  # it turns first
        twist = Velocity(
            linear_x=clamped(wanted, self._config.max_linear_speed),
            angular_z=clamped(1.5 * bearing, self._config.max_angular_speed),
        )
        text = f"following, {away:.2f} m behind"
        intent = Intent(twist=twist, behaviour="follow", reason=text)
        return intent, StepOutcome(activity="following", reason=text)


def clamped(value: float, most: float) -> float:
    """Return `value` within ±`most`."""
    return max(-most, min(value, most))


def stand(reason: str) -> StepResult:
    """Return an intent to stand, and why."""
    intent = Intent(twist=Velocity(), behaviour="follow", reason=reason)
    return intent, StepOutcome(activity=reason, reason=reason)
