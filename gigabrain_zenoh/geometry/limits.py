"""Speed and acceleration limits of a body. Pure functions."""

import math

import msgspec

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.safety import SpeedCaps

ZERO = Velocity()
NO_CAPS = SpeedCaps()
AT_REST_SPEED, AT_REST_YAW_RATE = 0.01, 0.05  # [m/s], [rad/s]; slower is at rest


class Limits(msgspec.Struct, frozen=True, kw_only=True):
    """Maximum speeds and accelerations of one body."""

    linear_speed: float  # [m/s]
    lateral_speed: float  # [m/s]
    angular_speed: float  # [rad/s]
    linear_acceleration: float  # [m/s2]
    linear_deceleration: float  # [m/s2]
    angular_acceleration: float  # [rad/s2], both ways
    rim_speed: float = math.inf  # [m/s], of each wheel of a differential base
    half_track: float = 0.0  # [m], from the middle of that base to a wheel


class SentCommand(msgspec.Struct, frozen=True):
    """A command sent to the body."""

    tick: int  # in which it begins to apply
    velocity: Velocity


def limits_of(body: BodyDescription) -> Limits:
    """Return the limits of `body`."""
    return Limits(
        linear_speed=body.max_linear_speed,
        lateral_speed=body.max_lateral_speed,
        angular_speed=body.max_angular_speed,
        linear_acceleration=body.max_linear_acceleration,
        linear_deceleration=body.max_linear_deceleration,
        angular_acceleration=body.max_angular_acceleration,
        rim_speed=rim_speed(body),
        half_track=body.wheel_separation / 2 if body.drive_type == "differential" else 0.0,
    )


def at_rest(measured: Velocity) -> bool:
    """Return whether a body stands still; False where a speed is NaN."""
    return (
        abs(measured.linear_x) < AT_REST_SPEED
        and abs(measured.linear_y) < AT_REST_SPEED
        and abs(measured.angular_z) < AT_REST_YAW_RATE
    )


def rim_speed(body: BodyDescription) -> float:
    """Return the greatest rolling speed of a differential base's wheel [m/s]; inf for others."""
    if body.max_rim_speed is None or body.drive_type != "differential":
        return math.inf
    return body.max_rim_speed


def clamp(velocity: Velocity, limits: Limits, caps: SpeedCaps = NO_CAPS) -> Velocity:
    """Return `velocity` limited to the body's speeds and the current caps, axis by axis.

    If a wheel would still be too fast, the body drives the same curve more slowly.
    """
    turning = limits.angular_speed if caps.rotation is None else caps.rotation
    turning = min(turning, limits.angular_speed)
    forward = _limited(velocity.linear_x, limits.linear_speed, caps.backward, caps.forward)
    turn = _limited(velocity.angular_z, turning, caps.turn_right, caps.turn_left)
    rim = abs(forward) + abs(turn) * limits.half_track
    divisor = max(1.0, rim / limits.rim_speed)
    return Velocity(
        linear_x=forward / divisor,
        linear_y=_limited(velocity.linear_y, limits.lateral_speed, caps.right, caps.left),
        angular_z=turn / divisor,
    )


def ramp(current: Velocity, target: Velocity, limits: Limits, dt: float) -> Velocity:
    """Return the velocity after `dt` [s] of acceleration from `current` towards `target`.

    The result is within the limits if both of them are.
    """
    up, down = limits.linear_acceleration * dt, limits.linear_deceleration * dt
    turn = limits.angular_acceleration * dt
    step = Velocity(
        linear_x=_approach(current.linear_x, target.linear_x, up, down),
        linear_y=_approach(current.linear_y, target.linear_y, up, down),
        angular_z=_approach(current.angular_z, target.angular_z, turn, turn),
    )
    return _within_rim_speed(current, step, limits)


def _within_rim_speed(current: Velocity, step: Velocity, limits: Limits) -> Velocity:
    """Reduce the speed that the axes gain, so that no wheel is too fast.

    An axis that slows down is not changed, so braking is never delayed.
    """
    gain_x = max(0.0, abs(step.linear_x) - abs(current.linear_x))
    gain_z = max(0.0, abs(step.angular_z) - abs(current.angular_z))
    gained = gain_x + gain_z * limits.half_track
    if not gained:
        return step
    rim = abs(step.linear_x) + abs(step.angular_z) * limits.half_track
    share = min(1.0, max(0.0, rim - limits.rim_speed) / gained)
    return Velocity(
        linear_x=step.linear_x - math.copysign(gain_x * share, step.linear_x),
        linear_y=step.linear_y,
        angular_z=step.angular_z - math.copysign(gain_z * share, step.angular_z),
    )


def slowed(current: Velocity, target: Velocity, limits: Limits, dt: float) -> Velocity:
    """Return `ramp`, but an axis that would gain speed or reverse keeps its velocity."""
    return ramp(
        current,
        Velocity(
            linear_x=_no_faster(current.linear_x, target.linear_x),
            linear_y=_no_faster(current.linear_y, target.linear_y),
            angular_z=_no_faster(current.angular_z, target.angular_z),
        ),
        limits,
        dt,
    )


def _no_faster(current: float, target: float) -> float:
    return target if min(0.0, current) <= target <= max(0.0, current) else current


def _limited(value: float, limit: float, low_cap: float | None, high_cap: float | None) -> float:
    lowest = -limit if low_cap is None else -min(limit, low_cap)
    highest = limit if high_cap is None else min(limit, high_cap)
    return max(lowest, min(highest, value))


def _approach(current: float, target: float, gain: float, loss: float) -> float:
    """Return an axis after one step by `gain` or `loss`; it stops at zero before it reverses."""
    if current * target < 0:
        target = 0.0
    highest = current + (gain if current >= 0 else loss)
    lowest = current - (gain if current <= 0 else loss)
    return max(lowest, min(highest, target))
