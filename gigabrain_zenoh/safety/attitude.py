"""Tilted or knocked: what the inertial sensor and the bumpers say."""

import math

import msgspec

from gigabrain_schemas.base import Cause
from gigabrain_schemas.body import RobotState, Thresholds
from gigabrain_schemas.sensors import Accelerations, Quaternion
from gigabrain_zenoh.safety.sustain import held
from gigabrain_zenoh.safety.words import say

TILT_TICKS = 10  # 0.2 s: a bump in the floor is over by then
UNIT = 0.1  # how far the length of an attitude may be from 1


class Attitude(msgspec.Struct, frozen=True, kw_only=True):
    """What is remembered of tilt and shocks."""

    tilted_ticks: int = 0
    hit: bool = False  # in this state


def look(
    limits: Thresholds, before: Attitude, state: RobotState, shock: float, elapsed: int
) -> Attitude:
    """One state more; `shock` is the hardest horizontal acceleration since the last [m/s2]."""
    tilt = tilt_deg(state.imu.orientation) if state.imu else None
    if state.imu:
        shock = max(shock, horizontal(state.imu.linear_acceleration))
    return Attitude(
        tilted_ticks=held(
            before.tilted_ticks, tilt is not None and tilt > limits.tilt_stop, elapsed
        ),
        hit=any(state.bumpers) or shock > limits.shock_stop,
    )


def causes(now: Attitude) -> tuple[Cause, ...]:
    """Why the body must stop, for good."""
    found = []
    if now.tilted_ticks >= TILT_TICKS:
        found.append(say("tilted"))
    if now.hit:
        found.append(say("collision"))
    return tuple(found)


def tilt_deg(orientation: Quaternion) -> float | None:
    """Angle between the body's z axis and the vertical [deg]; None for what is no attitude."""
    x, y, z, w = orientation
    if abs(math.hypot(x, y, z, w) - 1.0) > UNIT:
        return None
    return math.degrees(math.acos(max(-1.0, min(1.0, 1.0 - 2.0 * (x * x + y * y)))))


def horizontal(acceleration: Accelerations) -> float:
    """Acceleration across the body's z axis [m/s2]."""
    return math.hypot(acceleration[0], acceleration[1])
