"""Closed-loop motions for scripts: drive a distance or turn by an angle, measured by odometry."""

import math

from msgspec import Struct

from gigabrain_schemas.base import Causes, Pose, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_zenoh.errors import Unsupported
from gigabrain_zenoh.geometry.limits import ZERO, at_rest

GAIN = 2.0  # [1/s], speed per remaining distance near the goal
BRAKE_SHARE = 0.5  # share of the body's deceleration to brake with
POSITION_TOLERANCE, ANGLE_TOLERANCE = 0.01, math.radians(1.0)  # [m], [rad]
MIN_LINEAR, MIN_ANGULAR = 0.02, 0.05  # [m/s], [rad/s], so that a motion reaches its goal
HEADING_GAIN = 2.0  # [1/s]
STALL_TICKS = 10 * 50  # without progress; then the motion gives up
REST_TICKS = 50  # timeout for the body to come to rest at the end of a motion
MISSED_TICKS = 25  # between two states; a longer gap does not count as a stall


class Reached(Struct, frozen=True, kw_only=True):
    """Result of a motion, as odometry measured it."""

    distance: float  # [m] along the heading at the start
    angle: float  # [rad]
    pose: Pose  # odometry, at the end
    ok: bool  # within tolerance of the goal
    held_back: tuple[str, ...] = ()  # codes of the causes that stopped or slowed the body


class OdometryMotion:
    """One motion: computes the velocity for each state, until `done`.

    Raises Unsupported for a turn of a body that cannot turn on the spot.
    """

    def __init__(self, body: BodyDescription, start: RobotState, distance: float, angle: float):
        if angle and not distance and body.turning_radius:
            raise Unsupported(
                f"{body.robot_type} cannot turn on the spot: its tightest turn has a radius of "
                f"{body.turning_radius:.2f} m; use `goto` with a heading, or `drive`"
            )
        self._body, self._start, self._last = body, start.pose, start
        self._distance, self._angle = distance, angle
        self._turned, self._yaw = 0.0, start.pose.yaw
        self._least_left, self._progress_tick = math.inf, start.tick
        self._end_tick = 0  # at which the goal was reached or given up
        self._held_back: dict[str, None] = {}

    def step(self, state: RobotState, speed: float | None = None, safety: Causes = ()) -> Velocity:
        """Return the velocity to send for `state`; zero once the goal is reached or given up.

        `safety` contains the causes of safety's verdict; only the one in this direction counts.
        """
        self._turned += math.remainder(state.pose.yaw - self._yaw, math.tau)
        if (passed := state.tick - self._last.tick) > MISSED_TICKS:
            self._progress_tick += passed
        self._yaw, self._last = state.pose.yaw, state
        self._held_back.update(dict.fromkeys(cause.code for cause in state.gate.causes))
        self._held_back.update({cause.code: None for cause in safety if cause.code == self._zone})
        linear_left, angle_left = self._left()
        self._watch_progress(state, linear_left, angle_left)
        if self._end_tick:
            return ZERO
        body = self._body
        if self._distance:
            linear = _approach(linear_left, speed or body.max_linear_speed,
                               body.max_linear_deceleration, MIN_LINEAR)  # fmt: skip
            return Velocity(linear_x=linear, angular_z=HEADING_GAIN * angle_left)
        limit = speed or body.max_angular_speed
        angular = _approach(angle_left, limit, body.max_angular_acceleration, MIN_ANGULAR)
        return Velocity(angular_z=angular)

    @property
    def done(self) -> bool:
        """Return whether the motion has ended and the body is at rest."""
        if not self._end_tick:
            return False
        return at_rest(self._last.velocity) or self._last.tick > self._end_tick + REST_TICKS

    def result(self) -> Reached:
        """Return the measurements of odometry so far."""
        linear_left, angle_left = self._left()
        ok = abs(linear_left) <= 2 * POSITION_TOLERANCE and abs(angle_left) <= 2 * ANGLE_TOLERANCE
        return Reached(
            distance=self._distance - linear_left,
            angle=self._turned,
            pose=self._last.pose,
            ok=ok,
            held_back=tuple(self._held_back),
        )

    def _left(self) -> tuple[float, float]:
        """Return the remaining distance [m] and angle [rad]."""
        start, pose = self._start, self._last.pose
        along = (pose.x - start.x) * math.cos(start.yaw) + (pose.y - start.y) * math.sin(start.yaw)
        return self._distance - along if self._distance else 0.0, self._angle - self._turned

    def _watch_progress(self, state: RobotState, linear_left: float, angle_left: float) -> None:
        left = abs(linear_left) if self._distance else abs(angle_left)
        tolerance = POSITION_TOLERANCE if self._distance else ANGLE_TOLERANCE
        if left < self._least_left - tolerance:
            self._least_left, self._progress_tick = left, state.tick
        stalled = state.tick - self._progress_tick > STALL_TICKS
        if not self._end_tick and (left <= tolerance or stalled):
            self._end_tick = state.tick

    @property
    def _zone(self) -> str:
        """Return safety's code for an obstacle in the direction of the motion."""
        if self._distance:
            return "zone_ahead" if self._distance > 0 else "zone_behind"
        return "zone_turn_left" if self._angle > 0 else "zone_turn_right"


def _approach(left: float, limit: float, deceleration: float, min_speed: float) -> float:
    """Return a speed from which the body stops within `left`, with the sign of `left`."""
    braking = math.sqrt(2.0 * BRAKE_SHARE * deceleration * abs(left))
    return math.copysign(min(limit, braking, max(GAIN * abs(left), min_speed)), left)
