"""Motion model of a body, and where plans of commands lead, LANES at a time.

The body answers a command after its delay, then as a first-order lag.
"""

import math
from typing import NamedTuple

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.kernels.jit import lean_kernel

ACCELERATION_RESERVE = 0.9  # of the body's accelerations: plans must work on a bad floor too
GENTLEST_SHARE = 0.4  # of that reserve, at an aggressiveness of 0
MIN_SPEED = 0.01  # [m/s]; a body that may drive at all may drive so fast
MAX_REVERSE_SPEED = 0.4  # [m/s], no faster backwards: the lidar may not see there
SLOWEST = 0.001  # [m/s], where it must not reverse
STRAFING = ("mecanum", "omni")  # drive types

LANES = 8  # plans at a time
X, Y, YAW, VX, VY, W = range(0, 6 * LANES, LANES)  # where the lanes of each begin in a state:
COSINE, SINE, MOVED = range(6 * LANES, 9 * LANES, LANES)  # its pose, velocity, and the way [m] that
MIDDLE, SURE, AWAY, CLOSE = range(9 * LANES, 13 * LANES, LANES)  # no point exceeds; see price.py
STATE = 13 * LANES
SECOND_X, SECOND_Y, SECOND_TURN = range(3 * LANES, 6 * LANES, LANES)  # of two commands in a row
COMMAND = 3 * LANES


class MotionModel(NamedTuple):
    """Limits of a body's motion."""

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
    strafes: bool  # it is made to go sideways, and need not face its way


def model_of(
    body: BodyDescription, speed: float | None = None, aggressiveness: float = 0.5
) -> MotionModel:
    """Return the model of `body`, driven no faster than `speed` [m/s].

    Below an `aggressiveness` of 0.5, to 0, it gains speed ever more gently.
    """
    fastest = body.max_linear_speed if speed is None else min(speed, body.max_linear_speed)
    eager = min(1.0, 2.0 * aggressiveness)
    gain = ACCELERATION_RESERVE * (GENTLEST_SHARE + (1.0 - GENTLEST_SHARE) * eager)
    car, limits = body.drive_type == "ackermann", limits_of(body)
    sees_ahead = any(camera.depth for camera in body.cameras)  # so it had better face its way
    return MotionModel(
        forward=fastest,
        backward=min(MAX_REVERSE_SPEED, 0.5 * fastest),
        lateral=0.0 if car else min(body.max_lateral_speed, fastest),
        turning=body.max_angular_speed,
        acceleration=gain * body.max_linear_acceleration,
        deceleration=ACCELERATION_RESERVE * body.max_linear_deceleration,
        angular_acceleration=gain * body.max_angular_acceleration,
        radius=body.turning_radius,
        reaction_time=body.thresholds.reaction_time,
        margin=body.thresholds.stop_margin,
        side_margin=body.thresholds.side_margin,
        rim=limits.rim_speed,
        half_track=limits.half_track,
        strafes=body.drive_type in STRAFING and body.max_lateral_speed > 0.0 and not sees_ahead,
    )


def slowed_model(model: MotionModel, speed: float | None) -> MotionModel:
    """Return the model of a body that must not drive faster than `speed` [m/s]."""
    if speed is None or speed >= model.forward:
        return model
    slow = max(speed, MIN_SPEED)
    return model._replace(
        forward=slow, backward=min(model.backward, slow), lateral=min(model.lateral, slow)
    )


def delayed_model(model: MotionModel, seconds: float) -> MotionModel:
    """Return the model of a body that reacts later, with speeds that keep the stopping distance."""
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
def step_toward(before: float, target: float, up: float, down: float) -> float:
    """Return `target`, or the nearest value that one step from `before` reaches.

    A step lasts several ticks, so it may pass 0, where a ramp rests for a tick.
    """
    highest = before + (up if before >= 0.0 else down)
    lowest = before - (up if before <= 0.0 else down)
    return max(lowest, min(highest, target))


@lean_kernel
def no_faster_aslant(model: MotionModel, vx: float, vy: float) -> tuple[float, float]:
    """Return a velocity of a body that strafes, no faster aslant than straight on."""
    vx = max(-model.backward, min(model.forward, vx))
    vy = max(-model.lateral, min(model.lateral, vy))
    along = vx / (model.forward if vx > 0.0 else max(model.backward, SLOWEST))
    slant = math.sqrt(along * along + (vy / model.lateral) ** 2)
    return (vx / slant, vy / slant) if slant > 1.0 else (vx, vy)


@lean_kernel
def feasible(
    model: MotionModel,
    before: tuple[float, float, float],
    target: tuple[float, float, float],
    dt: float,
) -> tuple[float, float, float]:
    """Return the command nearest to `target` that the body can obey `dt` [s] after `before`.

    See `no_faster_aslant` for a body that strafes.
    """
    up, down = model.acceleration * dt, model.deceleration * dt
    turn = model.angular_acceleration * dt
    vx = max(-model.backward, min(model.forward, target[0]))
    vy = max(-model.lateral, min(model.lateral, target[1]))
    w = max(-model.turning, min(model.turning, target[2]))
    rim = abs(vx) + abs(w) * model.half_track
    if rim > model.rim:
        vx, w = vx * model.rim / rim, w * model.rim / rim
    vx = step_toward(before[0], vx, up, down)
    vy = step_toward(before[1], vy, up, down)
    w = step_toward(before[2], w, turn, turn)
    if model.radius > 0.0:
        tightest = abs(vx) / model.radius
        w = max(-tightest, min(tightest, w))
    return vx, vy, w


class FirstOrderLag(NamedTuple):
    """A first-order lag over one step."""

    decay: float  # what is left of a difference after it
    glide: float  # [s], what a difference of 1 m/s adds to the way [m]


def first_order_lag(seconds: float, dt: float) -> FirstOrderLag:
    """Return the lag of a time constant of `seconds`, for steps of `dt` [s]."""
    if seconds < 1e-3:
        return FirstOrderLag(0.0, 0.0)
    decay = math.exp(-dt / seconds)
    return FirstOrderLag(decay, seconds * (1.0 - decay))


@lean_kernel
def lagged_step(
    velocity: float, command: float, lag: FirstOrderLag, dt: float
) -> tuple[float, float]:
    """Return the velocity after a step with `command`, and the distance covered."""
    off = velocity - command
    return command + off * lag.decay, command * dt + off * lag.glide


class InitialState(NamedTuple):
    """Pose and velocity of the body, and the commands on their way to it."""

    x: float  # [m], in the frame that is planned in
    y: float
    yaw: float  # [rad]
    vx: float  # [m/s], as measured
    vy: float
    w: float  # [rad/s]
    before: tuple[float, float, float]  # the last command
    past: Floats  # (n + 1, 3), mean of what was sent in each of the last steps, oldest first
    share: float  # of the first step that the oldest of them still rules, 0 to 1
    lag: FirstOrderLag
    gain: float  # of the yaw rate: no more than so much of its largest can be had


@lean_kernel
def make_feasible(model: MotionModel, start: InitialState, dt: float, plans: Floats) -> None:
    """Make `plans` (T, 3, LANES) feasible in place.

    In one array, and slices of it, all offsets are known: it is vectorised. So below.
    """
    turning = model.turning * min(1.0, start.gain)
    flat = plans.reshape(-1)
    for t in range(plans.shape[0] if model.strafes else 0):  # apart: it takes as long as the rest
        one = flat[t * COMMAND : (t + 1) * COMMAND]
        for lane in range(LANES):
            slower = no_faster_aslant(model, one[lane], one[LANES + lane])
            one[lane], one[LANES + lane] = slower
    for lane in range(LANES):
        wanted = max(-turning, min(turning, flat[2 * LANES + lane]))
        first = feasible(model, start.before, (flat[lane], flat[LANES + lane], wanted), dt)
        flat[lane], flat[LANES + lane], flat[2 * LANES + lane] = first
    for t in range(1, plans.shape[0]):
        two = flat[(t - 1) * COMMAND : (t + 1) * COMMAND]
        for lane in range(LANES):
            before = two[lane], two[LANES + lane], two[2 * LANES + lane]
            wanted = max(-turning, min(turning, two[SECOND_TURN + lane]))
            then = feasible(model, before, (two[SECOND_X + lane], two[SECOND_Y + lane], wanted), dt)
            two[SECOND_X + lane], two[SECOND_Y + lane], two[SECOND_TURN + lane] = then


@lean_kernel
def simulate(
    model: MotionModel, far: float, start: InitialState, dt: float, plans: Floats, states: Floats
) -> None:
    """Fill `states` (T + 1, STATE) with where feasible `plans` (T, 3, LANES) take the body.

    It reaches so `far` [m] from its origin.
    """
    _fill_first(start, states[0])
    flat = states.reshape(-1)
    for t in range(plans.shape[0]):
        _ruling_commands(start, plans, t, states[t + 1])
        s = flat[t * STATE : (t + 2) * STATE]
        for lane in range(LANES):
            n = STATE + lane
            vx, ahead = lagged_step(s[VX + lane], s[VX + n], start.lag, dt)
            vy, aside = lagged_step(s[VY + lane], s[VY + n], start.lag, dt)
            w, turned = lagged_step(s[W + lane], s[W + n], start.lag, dt)
            cosine, sine = _turn(s[COSINE + lane], s[SINE + lane], 0.5 * turned)
            s[X + n] = s[X + lane] + (cosine * ahead - sine * aside)
            s[Y + n] = s[Y + lane] + (sine * ahead + cosine * aside)
            s[YAW + n] = s[YAW + lane] + turned
            s[VX + n], s[VY + n], s[W + n] = vx, vy, w
            s[COSINE + n], s[SINE + n] = _turn(cosine, sine, 0.5 * turned)
            s[MOVED + n] = abs(ahead) + abs(aside) + far * abs(turned)


@lean_kernel
def _fill_first(start: InitialState, state: Floats) -> None:
    cosine, sine = math.cos(start.yaw), math.sin(start.yaw)
    for lane in range(LANES):
        state[X + lane], state[Y + lane], state[YAW + lane] = start.x, start.y, start.yaw
        state[VX + lane], state[VY + lane], state[W + lane] = start.vx, start.vy, start.w
        state[COSINE + lane], state[SINE + lane], state[MOVED + lane] = cosine, sine, 0.0


@lean_kernel
def _ruling_commands(start: InitialState, plans: Floats, t: int, state: Floats) -> None:
    """Put the mean commands [m/s and rad/s] that rule the body in step `t` in their places."""
    older, newer = t - start.past.shape[0], t - start.past.shape[0] + 1
    share, rest = start.share, 1.0 - start.share
    for axis in range(3):
        ruled = state[VX + axis * LANES : VX + (axis + 1) * LANES]
        if newer < 0:
            mean = share * start.past[t, axis] + rest * start.past[t + 1, axis]
            for lane in range(LANES):
                ruled[lane] = mean
        elif older < 0:
            old, new = share * start.past[t, axis], plans[newer, axis]
            for lane in range(LANES):
                ruled[lane] = old + rest * new[lane]
        else:
            before, new = plans[older, axis], plans[newer, axis]
            for lane in range(LANES):
                ruled[lane] = share * before[lane] + rest * new[lane]


@lean_kernel
def _turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Turn a direction by less than half a radian; Taylor's series is faster than sin and cos."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0))))
    return cosine * c - sine * s, sine * c + cosine * s
