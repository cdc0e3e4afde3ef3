"""How each kind of body can move, in numbers that compiled functions take."""

import math
from typing import NamedTuple

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.kernels.kernel import lean_kernel

RESERVE = 0.9  # of the body's accelerations: what is planned must be possible on a bad floor too
SLOWEST_REVERSE = 0.4  # [m/s], no faster backwards: the lidar may not see there


class Model(NamedTuple):
    """What a body's file says of its motion."""

    forward: float  # [m/s], fastest
    backward: float  # [m/s], fastest, as a positive number
    lateral: float  # [m/s]; 0 for bodies that cannot go sideways
    turning: float  # [rad/s]
    acceleration: float  # [m/s2]
    deceleration: float  # [m/s2]
    angular_acceleration: float  # [rad/s2]
    radius: float  # [m], of the tightest turn of a car; 0 for bodies that turn on the spot
    reaction_time: float  # [s] from a scan to the brake
    margin: float  # [m], kept free in front of the body at rest
    side_margin: float  # [m], kept free beside it
    rim: float  # [m/s], fastest of each wheel of a differential base; inf for others
    half_track: float  # [m], from its middle to a wheel


def model_of(body: BodyDescription, speed: float | None = None) -> Model:
    """The model of `body`, driven no faster than `speed` [m/s].

    A car reaches its largest yaw rate at full speed with the wheels turned as far as they go: that
    is its tightest turn.
    """
    fastest = body.max_linear_speed if speed is None else min(speed, body.max_linear_speed)
    car, limits = body.drive_type == "ackermann", limits_of(body)
    return Model(
        forward=fastest,
        backward=min(SLOWEST_REVERSE, 0.5 * fastest),
        lateral=0.0 if car else min(body.max_lateral_speed, fastest),
        turning=body.max_angular_speed,
        acceleration=RESERVE * body.max_linear_acceleration,
        deceleration=RESERVE * body.max_linear_deceleration,
        angular_acceleration=RESERVE * body.max_angular_acceleration,
        radius=body.max_linear_speed / body.max_angular_speed if car else 0.0,
        reaction_time=body.thresholds.reaction_time,
        margin=body.thresholds.stop_margin,
        side_margin=body.thresholds.side_margin,
        rim=limits.rim_speed,
        half_track=limits.half_track,
    )


def slowed(model: Model, seconds: float) -> Model:
    """The model of a body that reacts so much later: its way to a stop stays as long as it was."""
    if seconds <= 0.0:
        return model
    reaction, brake = model.reaction_time + seconds, model.deceleration
    way = model.forward * model.reaction_time + model.forward**2 / (2.0 * brake)
    fastest = math.sqrt((brake * reaction) ** 2 + 2.0 * brake * way) - brake * reaction
    share = fastest / model.forward
    return model._replace(
        forward=fastest,
        backward=share * model.backward,
        lateral=share * model.lateral,
        turning=share * model.turning,
        reaction_time=reaction,
    )


@lean_kernel
def toward(before: float, target: float, up: float, down: float) -> float:
    """`target`, or as near to it as one step from `before` gets.

    A step is several ticks, so that it may go through 0, where a ramp rests for a tick.
    """
    highest = before + (up if before >= 0.0 else down)
    lowest = before - (up if before <= 0.0 else down)
    return max(lowest, min(highest, target))


@lean_kernel
def feasible(
    model: Model, before: tuple[float, float, float], target: tuple[float, float, float], dt: float
) -> tuple[float, float, float]:
    """The command nearest to `target` that the body can obey `dt` [s] after `before`."""
    up, down = model.acceleration * dt, model.deceleration * dt
    turn = model.angular_acceleration * dt
    vx = max(-model.backward, min(model.forward, target[0]))
    vy = max(-model.lateral, min(model.lateral, target[1]))
    w = max(-model.turning, min(model.turning, target[2]))
    rim = abs(vx) + abs(w) * model.half_track
    if rim > model.rim:
        vx, w = vx * model.rim / rim, w * model.rim / rim
    vx = toward(before[0], vx, up, down)
    vy = toward(before[1], vy, up, down)
    w = toward(before[2], w, turn, turn)
    if model.radius > 0.0:
        tightest = abs(vx) / model.radius
        w = max(-tightest, min(tightest, w))
    return vx, vy, w


class Lag(NamedTuple):
    """A first-order lag over one step."""

    decay: float  # what is left of a difference after it
    glide: float  # [s], what a difference of 1 m/s adds to the way [m]


def lag_of(seconds: float, dt: float) -> Lag:
    """The lag of a time constant of so many seconds, for steps of `dt` [s]."""
    if seconds < 1e-3:
        return Lag(0.0, 0.0)
    decay = math.exp(-dt / seconds)
    return Lag(decay, seconds * (1.0 - decay))


@lean_kernel
def answer(velocity: float, command: float, lag: Lag, dt: float) -> tuple[float, float]:
    """A body's velocity after a step with `command`, and the way that it has made."""
    off = velocity - command
    return command + off * lag.decay, command * dt + off * lag.glide
