"""Smooth motion of joints from tick to tick, within speed, acceleration and jerk. Pure.

Ruckig finds the fastest way; it is imported where joints are moved, and nowhere else.
"""

import importlib
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgspec

from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_zenoh.errors import ConfigError

OVER = 1.02  # by which a step along a path may be beyond the limits: rounding, float32
CATCH_UP = 0.95  # of a joint's greatest speed, at which a path may run away from it
PATHS = 0.5  # of its acceleration, that a path may have while a joint gets onto it
NOTHING = 1e-9  # speed and acceleration that are rounding, for which Ruckig may find no way
SLACK = 1e-3  # [rad/s] or [m/s], the same for joints that barely move


class JointPoint(msgspec.Struct, frozen=True):
    """The position, velocity and acceleration of a joint at one time."""

    position: float  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]
    acceleration: float = 0.0  # [rad/s2] or [m/s2]


class JointGoal(msgspec.Struct, frozen=True):
    """The goal of a joint: a position, or a velocity."""

    position: float | None = None  # [rad] or [m]; None: nowhere, it moves at `velocity`
    velocity: float = 0.0  # [rad/s] or [m/s], without a position
    max_speed: float | None = None  # [rad/s] or [m/s] on the way there, lower than its own


REST = JointGoal()


def prepare(joints: int) -> None:
    """Import Ruckig before the first motion. Raises ConfigError where it is missing."""
    _solver(joints)


def within(joint: JointDescription, position: float) -> float:
    """Return the position in the joint's range that is nearest to `position`."""
    return max(joint.lower, min(joint.upper, position))


def measured(body: BodyDescription, state: RobotState) -> tuple[JointPoint, ...]:
    """Return the joints that can be commanded, as measured; none while one is missing."""
    found = {joint.name: joint for joint in state.joints}
    if any(joint.name not in found for joint in body.joints):
        return ()
    these = (found[joint.name] for joint in body.joints)
    return tuple(JointPoint(joint.position, joint.velocity) for joint in these)


def held(body: BodyDescription, state: RobotState) -> tuple[JointPoint, ...]:
    """Return the posture that the joints were sent to; the measured one, if nothing holds them.

    It is within their ranges. None while a joint is missing.
    """
    now = measured(body, state)
    if now and not state.limp and len(state.joints_sent) == len(now):
        now = tuple(map(JointPoint, state.joints_sent))
    pairs = zip(body.joints, now, strict=False)
    return tuple(JointPoint(within(joint, point.position)) for joint, point in pairs)


def ramp(
    now: Sequence[JointPoint],
    goals: Sequence[JointGoal],
    limits: Sequence[JointDescription],
    dt: float,
) -> tuple[JointPoint, ...]:
    """Return where the joints are `dt` [s] later on the fastest way to their goals.

    All that have a position arrive there at once; the others do not wait for them. Raises
    ConfigError without Ruckig.
    """
    given = _input(now, limits)
    interface, synchronization = _ruckig().ControlInterface, _ruckig().Synchronization
    pairs = tuple(zip(goals, limits, now, strict=True))
    given.max_velocity = [
        min(goal.max_speed or one.max_speed, one.max_speed) for goal, one, _ in pairs
    ]
    given.target_position = [
        point.position if goal.position is None else within(joint, goal.position)
        for goal, joint, point in pairs
    ]
    given.target_velocity = [
        0.0 if goal.position is not None else _braking_in_time(goal.velocity, point, joint)
        for goal, joint, point in pairs
    ]
    given.per_dof_control_interface = [
        interface.Velocity if goal.position is None else interface.Position for goal in goals
    ]
    given.per_dof_synchronization = [
        synchronization.No if goal.position is None else synchronization.Time for goal in goals
    ]
    return tuple(
        msgspec.structs.replace(point, position=within(joint, point.position))
        for point, joint in zip(_after(given, dt), limits, strict=True)
    )


def along(
    now: Sequence[JointPoint],
    path: Sequence[Sequence[float]],
    limits: Sequence[JointDescription],
    dt: float,
) -> tuple[JointPoint, ...]:
    """Return where joints are `dt` [s] later that follow a path.

    One that cannot be on it by then gets there as fast as it may: seen from a frame that goes along
    the path, it comes to rest. Raises ConfigError without Ruckig.

    Args:
        now: Where the joints are.
        path: Where each should be now, `dt` later, and twice as late.
        limits: What they can.
        dt: Time step [s].
    """
    before, after, _ = path
    steps = tuple(
        JointPoint(place, speed := (place - point.position) / dt, (speed - point.velocity) / dt)
        for point, place in zip(now, after, strict=True)
    )
    nexts = tuple(
        JointPoint(b, (b - a) / dt, ((b - a) / dt - step.velocity) / dt)
        for a, b, step in zip(before, after, steps, strict=True)
    )  # from then on at the path's speed
    if all(map(_possible, (*steps, *nexts), (*limits, *limits))):
        return steps
    return _onto(now, path, limits, dt)


def _onto(
    now: Sequence[JointPoint],
    path: Sequence[Sequence[float]],
    limits: Sequence[JointDescription],
    dt: float,
) -> tuple[JointPoint, ...]:
    """Return where joints are `dt` [s] later that get onto a path as fast as they may."""
    frame = [_frame(joint, places, dt) for joint, *places in zip(limits, *path, strict=True)]
    off = [
        JointPoint(
            p.position - f.position, p.velocity - f.velocity, p.acceleration - f.acceleration
        )
        for p, f in zip(now, frame, strict=True)
    ]
    given = _input(off, limits)
    pairs = list(zip(limits, frame, strict=True))
    given.max_acceleration = [j.max_acceleration - f.acceleration for j, f in pairs]
    given.min_acceleration = [-j.max_acceleration - f.acceleration for j, f in pairs]
    given.max_velocity = [j.max_speed - f.velocity for j, f in pairs]
    given.min_velocity = [-j.max_speed - f.velocity for j, f in pairs]
    given.target_position = given.target_velocity = [0.0] * len(limits)
    given.per_dof_synchronization = [_ruckig().Synchronization.No] * len(limits)
    return tuple(
        JointPoint(
            within(joint, f.position + speed * dt + p.position),
            speed + p.velocity,
            f.acceleration + p.acceleration,
        )
        for joint, f, p in zip(limits, frame, _after(given, dt), strict=True)
        for speed in (f.velocity + f.acceleration * dt,)
    )


def _frame(joint: JointDescription, path: Sequence[float], dt: float) -> JointPoint:
    """Return a frame that goes along a path, as fast as the joint can follow it."""
    before, after, later = path
    most, fastest = PATHS * joint.max_acceleration, CATCH_UP * joint.max_speed
    acceleration = max(-most, min(most, (later - 2.0 * after + before) / dt**2))
    velocity = max(-fastest, min(fastest, (after - before) / dt))
    return JointPoint(before, velocity - acceleration * dt, acceleration)


def _braking_in_time(velocity: float, now: JointPoint, joint: JointDescription) -> float:
    """Return the part of `velocity` from which the joint comes to rest within its range."""
    left = joint.upper - now.position if velocity > 0 else now.position - joint.lower
    most = min(joint.max_speed, math.sqrt(joint.max_acceleration * max(0.0, left)))
    return max(-most, min(most, velocity))


def _input(now: Sequence[JointPoint], limits: Sequence[JointDescription]) -> Any:
    given = _ruckig().InputParameter(len(limits))
    given.current_position = [point.position for point in now]
    given.current_velocity = [_rounded(point.velocity) for point in now]
    given.current_acceleration = [_rounded(point.acceleration) for point in now]
    given.max_acceleration = [joint.max_acceleration for joint in limits]
    given.max_jerk = [joint.max_jerk for joint in limits]
    return given


def _rounded(value: float) -> float:
    return 0.0 if abs(value) < NOTHING else value


def _after(given: Any, dt: float) -> tuple[JointPoint, ...]:
    """Return the points `dt` [s] later; where Ruckig finds no common way, each joint has its own.

    Joints for which it finds none either brake.
    """
    ruckig = _ruckig()
    path = ruckig.Trajectory(given.degrees_of_freedom)
    alone = [ruckig.Synchronization.No] * given.degrees_of_freedom
    for synchronization in (given.per_dof_synchronization, alone):
        given.per_dof_synchronization = synchronization
        try:
            _solver(given.degrees_of_freedom).calculate(given, path)
        except ruckig.RuckigError:  # numerical, where a joint hardly moves
            continue
        return tuple(map(JointPoint, *path.at_time(dt)))
    return tuple(
        _braked(*motion, dt)
        for motion in zip(
            given.current_position, given.current_velocity, given.max_acceleration, strict=True
        )
    )


def _braked(position: float, velocity: float, most: float, dt: float) -> JointPoint:
    slower = math.copysign(max(0.0, abs(velocity) - most * dt), velocity)
    return JointPoint(position + slower * dt, slower)


def _possible(step: JointPoint, limits: JointDescription) -> bool:
    fast = abs(step.velocity) > OVER * limits.max_speed + SLACK
    return not fast and abs(step.acceleration) <= OVER * limits.max_acceleration + SLACK


def _ruckig() -> Any:
    try:
        return importlib.import_module("ruckig")
    except ModuleNotFoundError:
        raise ConfigError(
            "moving joints needs ruckig; pip install 'gigabrain-zenoh[arm]'"
        ) from None


@lru_cache(maxsize=8)
def _solver(joints: int) -> Any:
    return _ruckig().Ruckig(joints)
