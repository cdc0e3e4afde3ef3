"""Joint motion within limits, from tick to tick. Pure functions."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

from gigabrain_schemas.body import JointDescription

AT_REST_JOINT_SPEED = 0.05  # [rad/s] or [m/s], of a joint that stands still
BRAKING = 2.0  # times its greatest planned acceleration, by which a joint is stopped
OVERRUN = 0.6  # of the way that a joint lags behind, which it runs on if nothing takes it back


class JointMotion(msgspec.Struct, frozen=True):
    """The position and velocity of a joint; of one that is sent there, its servo's lag as well."""

    position: float  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]
    lag: float = 0.0  # [rad] or [m], how far the joint is still from there


def joints_at_rest(measured: Sequence[JointMotion]) -> bool:
    """Return whether all joints stand still; False where a speed is NaN."""
    return all(abs(joint.velocity) < AT_REST_JOINT_SPEED for joint in measured)


def frozen(now: JointMotion) -> JointMotion:
    """Return a joint that stops where it is."""
    return JointMotion(now.position)


def stopped(now: JointMotion) -> JointMotion:
    """Return a joint that comes to rest as soon as its servo can make it.

    The servo is still on its way to `now`. It stops on the rest of that way.
    """
    return JointMotion(now.position - OVERRUN * now.lag)


def braked(now: JointMotion, limits: JointDescription, dt: float) -> JointMotion:
    """Return where a joint is sent after `dt` [s] of braking harder than any plan would.

    As `stopped`, it takes back what was sent ahead for the speed that is lost.
    """
    slower = max(0.0, abs(now.velocity) - BRAKING * limits.max_acceleration * dt)
    after = _moved(now, math.copysign(slower, now.velocity), limits, dt)
    ahead = limits.gains.feed_forward * (now.velocity - after.velocity)
    lost = min(now.lag, ahead, key=abs)  # a joint that has just set off lags behind by less
    lag = min(now.lag - lost, after.lag, key=abs)
    return JointMotion(after.position - OVERRUN * lost, after.velocity, lag)


class SpeedBand(NamedTuple):
    """The velocities that a joint may have now [rad/s] or [m/s]."""

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
    """Return where a joint gets within `dt` [s] on the way to where `target` is then.

    It keeps to its greatest speed and acceleration, and does not run past a target that rests.
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
    """Return where a joint gets within `dt` [s] that should move at `velocity`.

    A joint that is faster than `band` allows brakes at its greatest acceleration.
    """
    change = limits.max_acceleration * dt
    velocity = max(-limits.max_speed, min(limits.max_speed, velocity))
    velocity = max(band.lowest, min(band.highest, velocity))
    velocity = max(now.velocity - change, min(now.velocity + change, velocity))
    return _moved(now, velocity, limits, dt)


def braking_speed(distance: float, acceleration: float, dt: float) -> float:
    """Return the greatest speed from which steps of `dt` [s] come to rest within `distance`.

    From n whole changes of speed and a part of one, n + 1 steps are left.
    """
    change = acceleration * dt
    steps = 2 * max(0.0, distance) / (change * dt)
    n = math.floor((math.sqrt(1 + 4 * steps) - 1) / 2)
    return max(0.0, distance) / ((n + 1) * dt) + n * change / 2


def _moved(now: JointMotion, velocity: float, limits: JointDescription, dt: float) -> JointMotion:
    """Return `now` after `dt` [s], slow enough to come to rest within the joint's range."""
    a = limits.max_acceleration
    highest = braking_speed(limits.upper - now.position, a, dt)
    lowest = -braking_speed(now.position - limits.lower, a, dt)
    velocity = max(lowest, min(highest, velocity))
    position = now.position + velocity * dt
    if limits.lower <= now.position <= limits.upper:
        position = max(limits.lower, min(limits.upper, position))
    return JointMotion(position, velocity, _lag(now, position, limits, dt))


def _lag(now: JointMotion, position: float, limits: JointDescription, dt: float) -> float:
    """Return how far a servo is behind `position`, to which it was sent on within `dt` [s].

    It follows with the time constant that its feed-forward makes up for.
    """
    late = limits.gains.feed_forward
    kept = math.exp(-dt / late) if late else 0.0
    return now.lag * kept + (position - now.position) / dt * late * (1.0 - kept)
