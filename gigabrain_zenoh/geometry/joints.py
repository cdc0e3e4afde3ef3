"""Joint motion within limits, tick by tick. Pure functions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from gigabrain_schemas.body import JointDescription

AT_REST_JOINT_SPEED = 0.05  # [rad/s] or [m/s]; a slower joint counts as at rest
BRAKING_FACTOR = 2.0  # times a joint's maximum planned acceleration, to stop it
OVERRUN_SHARE = 0.6  # of its lag, by which a servo would overrun a stop


class JointMotion(msgspec.Struct, frozen=True):
    """Measured motion of a joint, or its commanded motion with its servo's lag."""

    position: float  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]
    lag: float = 0.0  # [rad] or [m], from the servo to the commanded position


def joints_at_rest(measured: Sequence[JointMotion]) -> bool:
    """Return whether all joints stand still; False where a speed is NaN."""
    return all(abs(joint.velocity) < AT_REST_JOINT_SPEED for joint in measured)


def frozen(now: JointMotion) -> JointMotion:
    """Return `now` without velocity and lag."""
    return JointMotion(now.position)


def stopped(now: JointMotion) -> JointMotion:
    """Return the command that brings a joint to rest as soon as its servo can.

    The servo still lags behind `now`, so the command goes back by a part of that lag.
    """
    return JointMotion(now.position - OVERRUN_SHARE * now.lag)


def braked(now: JointMotion, limits: JointDescription, dt: float) -> JointMotion:
    """Return the command after `dt` [s] of braking, which is harder than in any plan.

    Like `stopped`, it takes back a part of the lag: that of the lost speed.
    """
    speed = max(0.0, abs(now.velocity) - BRAKING_FACTOR * limits.max_acceleration * dt)
    after = _moved(now, math.copysign(speed, now.velocity), limits, dt)
    ahead = limits.gains.feed_forward * (now.velocity - after.velocity)
    lost = min(now.lag, ahead, key=abs)  # a joint that has just started lags less
    lag = min(now.lag - lost, after.lag, key=abs)
    return JointMotion(after.position - OVERRUN_SHARE * lost, after.velocity, lag)


class SpeedBand(NamedTuple):
    """Range of velocities that a joint may have now [rad/s] or [m/s]."""

    lowest: float
    highest: float


ANY_SPEED = SpeedBand(-math.inf, math.inf)


def approach(
    now: JointMotion,
    target: JointMotion,
    limits: JointDescription,
    dt: float,
    band: SpeedBand = ANY_SPEED,
) -> JointMotion:
    """Return a joint after `dt` [s] on the way to `target`, which is given for that time.

    It stays within its maximum speed and acceleration, and does not overshoot a target at rest.
    """
    behind = target.position - target.velocity * dt - now.position
    catch_up = min(abs(behind) / dt, braking_speed(abs(behind), limits.max_acceleration, dt))
    wanted = target.velocity + math.copysign(catch_up, behind)
    return accelerated(now, wanted, limits, dt, band)


def accelerated(
    now: JointMotion,
    velocity: float,
    limits: JointDescription,
    dt: float,
    band: SpeedBand = ANY_SPEED,
) -> JointMotion:
    """Return a joint after `dt` [s] of acceleration towards `velocity`.

    A joint that is faster than `band` allows brakes at its maximum acceleration.
    """
    change = limits.max_acceleration * dt
    velocity = max(-limits.max_speed, min(limits.max_speed, velocity))
    velocity = max(band.lowest, min(band.highest, velocity))
    velocity = max(now.velocity - change, min(now.velocity + change, velocity))
    return _moved(now, velocity, limits, dt)


def braking_speed(distance: float, acceleration: float, dt: float) -> float:
    """Return the maximum speed from which a joint stops within `distance`, in steps of `dt` [s].

    A speed of n full speed changes and a part of one takes n + 1 steps.
    """
    change = acceleration * dt
    steps = 2 * max(0.0, distance) / (change * dt)
    n = math.floor((math.sqrt(1 + 4 * steps) - 1) / 2)
    return max(0.0, distance) / ((n + 1) * dt) + n * change / 2


def _moved(now: JointMotion, velocity: float, limits: JointDescription, dt: float) -> JointMotion:
    """Return `now` after `dt` [s] at `velocity`, limited so that it can stop within its range."""
    a = limits.max_acceleration
    highest = braking_speed(limits.upper - now.position, a, dt)
    lowest = -braking_speed(now.position - limits.lower, a, dt)
    velocity = max(lowest, min(highest, velocity))
    position = now.position + velocity * dt
    if limits.lower <= now.position <= limits.upper:
        position = max(limits.lower, min(limits.upper, position))
    return JointMotion(position, velocity, _lag(now, position, limits, dt))


def _lag(now: JointMotion, position: float, limits: JointDescription, dt: float) -> float:
    """Return the servo's lag after its command has moved to `position` within `dt` [s].

    The servo is a first-order lag. Its feed-forward compensates for the time constant.
    """
    time_constant = limits.gains.feed_forward
    decay = math.exp(-dt / time_constant) if time_constant else 0.0
    return now.lag * decay + (position - now.position) / dt * time_constant * (1.0 - decay)
