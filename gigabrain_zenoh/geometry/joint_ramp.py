"""Smooth joint motion, tick by tick, within limits of speed, acceleration and jerk. Pure.

Ruckig computes time-optimal motions. It is imported only by processes that move joints.
"""

import importlib
import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgspec

from gigabrain_schemas.body import BodyDescription, JointDescription, RobotState
from gigabrain_zenoh.errors import ConfigError

OVER = 1.02  # factor by which steps along a path may exceed the limits: rounding, float32
SLACK = 1e-3  # [rad/s] or [m/s], added to that limit, for joints that barely move
PATH_SPEED_SHARE = 0.95  # of a joint's maximum speed; the rest is left to catch up with a path
PATH_ACCELERATION_SHARE = 0.5  # of its maximum acceleration, likewise
ROUNDING = 1e-9  # smaller speeds and accelerations are set to 0, as Ruckig may fail on them


class JointPoint(msgspec.Struct, frozen=True):
    """The position, velocity and acceleration of a joint at one time."""

    position: float  # [rad] or [m]
    velocity: float = 0.0  # [rad/s] or [m/s]
    acceleration: float = 0.0  # [rad/s2] or [m/s2]


class JointGoal(msgspec.Struct, frozen=True):
    """The goal of a joint: a position, or a velocity."""

    position: float | None = None  # [rad] or [m]; None: move at `velocity`
    velocity: float = 0.0  # [rad/s] or [m/s], without a position
    max_speed: float | None = None  # [rad/s] or [m/s]; None: the joint's own limit


REST = JointGoal()


def prepare(joints: int) -> None:
    """Import Ruckig before the first motion. Raises ConfigError where it is missing."""
    _solver(joints)


def within(joint: JointDescription, position: float) -> float:
    """Return `position` limited to the joint's range."""
    return max(joint.lower, min(joint.upper, position))


def measured(body: BodyDescription, state: RobotState) -> tuple[JointPoint, ...]:
    """Return the measured state of all joints of `body`; empty while one is missing."""
    found = {joint.name: joint for joint in state.joints}
    if any(joint.name not in found for joint in body.joints):
        return ()
    ordered = (found[joint.name] for joint in body.joints)
    return tuple(JointPoint(joint.position, joint.velocity) for joint in ordered)


def held(body: BodyDescription, state: RobotState) -> tuple[JointPoint, ...]:
    """Return the newest commanded posture, or the measured one if the joints are not held.

    Positions are limited to the joints' ranges. Empty while a joint is missing.
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
    """Return the joints after `dt` [s] of time-optimal motion to their goals.

    Joints with a goal position arrive together. The others do not wait for them. Raises
    ConfigError without Ruckig.
    """
    inputs = _input(now, limits)
    interface, synchronization = _ruckig().ControlInterface, _ruckig().Synchronization
    joints = tuple(zip(goals, limits, now, strict=True))
    inputs.max_velocity = [
        min(goal.max_speed or joint.max_speed, joint.max_speed) for goal, joint, _ in joints
    ]
    inputs.target_position = [
        point.position if goal.position is None else within(joint, goal.position)
        for goal, joint, point in joints
    ]
    inputs.target_velocity = [
        0.0 if goal.position is not None else _stoppable_velocity(goal.velocity, point, joint)
        for goal, joint, point in joints
    ]
    inputs.per_dof_control_interface = [
        interface.Velocity if goal.position is None else interface.Position for goal in goals
    ]
    inputs.per_dof_synchronization = [
        synchronization.No if goal.position is None else synchronization.Time for goal in goals
    ]
    return tuple(
        msgspec.structs.replace(point, position=within(joint, point.position))
        for point, joint in zip(_advanced(inputs, dt), limits, strict=True)
    )


def along(
    now: Sequence[JointPoint],
    path: Sequence[Sequence[float]],
    limits: Sequence[JointDescription],
    dt: float,
) -> tuple[JointPoint, ...]:
    """Return the joints after `dt` [s] along a path.

    If a joint cannot reach the path in that time, all joints approach it as fast as their limits
    allow. Raises ConfigError without Ruckig.

    Args:
        now: Current state of the joints.
        path: Positions of the joints on the path: now, after `dt` and after 2 `dt`.
        limits: Limits of the joints.
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
    )  # the step after that, along the path
    if all(map(_within_limits, (*steps, *nexts), (*limits, *limits))):
        return steps
    return _approach_path(now, path, limits, dt)


def _approach_path(
    now: Sequence[JointPoint],
    path: Sequence[Sequence[float]],
    limits: Sequence[JointDescription],
    dt: float,
) -> tuple[JointPoint, ...]:
    """Return the joints after `dt` [s] of the fastest approach to a path.

    In a frame that moves along the path, they come to rest at its origin.
    """
    frame = [_path_frame(joint, places, dt) for joint, *places in zip(limits, *path, strict=True)]
    off = [
        JointPoint(
            p.position - f.position, p.velocity - f.velocity, p.acceleration - f.acceleration
        )
        for p, f in zip(now, frame, strict=True)
    ]
    inputs = _input(off, limits)
    pairs = list(zip(limits, frame, strict=True))
    inputs.max_acceleration = [j.max_acceleration - f.acceleration for j, f in pairs]
    inputs.min_acceleration = [-j.max_acceleration - f.acceleration for j, f in pairs]
    inputs.max_velocity = [j.max_speed - f.velocity for j, f in pairs]
    inputs.min_velocity = [-j.max_speed - f.velocity for j, f in pairs]
    inputs.target_position = inputs.target_velocity = [0.0] * len(limits)
    inputs.per_dof_synchronization = [_ruckig().Synchronization.No] * len(limits)
    return tuple(
        JointPoint(
            within(joint, f.position + speed * dt + p.position),
            speed + p.velocity,
            f.acceleration + p.acceleration,
        )
        for joint, f, p in zip(limits, frame, _advanced(inputs, dt), strict=True)
        for speed in (f.velocity + f.acceleration * dt,)
    )


def _path_frame(joint: JointDescription, path: Sequence[float], dt: float) -> JointPoint:
    """Return a frame that moves along a path, slowly enough for the joint to catch up."""
    before, after, later = path
    max_acceleration = PATH_ACCELERATION_SHARE * joint.max_acceleration
    max_speed = PATH_SPEED_SHARE * joint.max_speed
    wanted = (later - 2.0 * after + before) / dt**2
    acceleration = max(-max_acceleration, min(max_acceleration, wanted))
    velocity = max(-max_speed, min(max_speed, (after - before) / dt))
    return JointPoint(before, velocity - acceleration * dt, acceleration)


def _stoppable_velocity(velocity: float, now: JointPoint, joint: JointDescription) -> float:
    """Return `velocity`, limited so that the joint can stop within its range."""
    room = joint.upper - now.position if velocity > 0 else now.position - joint.lower
    max_speed = min(joint.max_speed, math.sqrt(joint.max_acceleration * max(0.0, room)))
    return max(-max_speed, min(max_speed, velocity))


def _input(now: Sequence[JointPoint], limits: Sequence[JointDescription]) -> Any:
    inputs = _ruckig().InputParameter(len(limits))
    inputs.current_position = [point.position for point in now]
    inputs.current_velocity = [_rounded(point.velocity) for point in now]
    inputs.current_acceleration = [_rounded(point.acceleration) for point in now]
    inputs.max_acceleration = [joint.max_acceleration for joint in limits]
    inputs.max_jerk = [joint.max_jerk for joint in limits]
    return inputs


def _rounded(value: float) -> float:
    return 0.0 if abs(value) < ROUNDING else value


def _advanced(inputs: Any, dt: float) -> tuple[JointPoint, ...]:
    """Return the joints after `dt` [s].

    If Ruckig finds no synchronized motion, each joint moves by itself. If it still fails, all
    joints brake.
    """
    ruckig = _ruckig()
    trajectory = ruckig.Trajectory(inputs.degrees_of_freedom)
    independent = [ruckig.Synchronization.No] * inputs.degrees_of_freedom
    for synchronization in (inputs.per_dof_synchronization, independent):
        inputs.per_dof_synchronization = synchronization
        try:
            _solver(inputs.degrees_of_freedom).calculate(inputs, trajectory)
        except ruckig.RuckigError:  # numerical failure for joints that hardly move
            continue
        return tuple(map(JointPoint, *trajectory.at_time(dt)))
    return tuple(
        _braked(*motion, dt)
        for motion in zip(
            inputs.current_position, inputs.current_velocity, inputs.max_acceleration, strict=True
        )
    )


def _braked(position: float, velocity: float, deceleration: float, dt: float) -> JointPoint:
    speed = math.copysign(max(0.0, abs(velocity) - deceleration * dt), velocity)
    return JointPoint(position + speed * dt, speed)


def _within_limits(step: JointPoint, limits: JointDescription) -> bool:
    too_fast = abs(step.velocity) > OVER * limits.max_speed + SLACK
    return not too_fast and abs(step.acceleration) <= OVER * limits.max_acceleration + SLACK


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
