"""Motion model of a body, and simulation of plans, LANES at a time.

The body reacts to a command after a delay, with a first-order lag.
"""

import math
from typing import NamedTuple

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.geometry.limits import limits_of
from gigabrain_zenoh.kernels.jit import lean_kernel

ACCELERATION_SHARE = 0.9  # of the body's accelerations, as plans must work on slippery floors too
MIN_ACCELERATION_SHARE = 0.4  # of those again, at an aggressiveness of 0
MIN_SPEED = 0.01  # [m/s], lowest speed limit
MAX_REVERSE_SPEED = 0.4  # [m/s], as the lidar may not see behind the body
MIN_DIVISOR = 0.001  # [m/s], in place of a reverse speed of 0
STRAFING = ("mecanum", "omni")  # drive types

LANES = 8  # plans at a time
# Offsets of the lanes of each quantity in a state. MOVED [m] is an upper bound of the distance
# that any point of the body moves in the step. `cost.evaluate_surroundings` fills the last four.
X, Y, YAW, VX, VY, W = range(0, 6 * LANES, LANES)
COSINE, SINE, MOVED = range(6 * LANES, 9 * LANES, LANES)
MIDDLE_DISTANCE, MIN_COST, DISC_DISTANCE, DISC_COST = range(9 * LANES, 13 * LANES, LANES)
STATE = 13 * LANES
# Offsets of the second of two successive commands.
SECOND_X, SECOND_Y, SECOND_TURN = range(3 * LANES, 6 * LANES, LANES)
COMMAND = 3 * LANES


class MotionModel(NamedTuple):
    """Limits of a body's motion."""

    forward: float  # [m/s], maximum
    backward: float  # [m/s], maximum, positive
    lateral: float  # [m/s], maximum; 0 for bodies that cannot move sideways
    turning: float  # [rad/s], maximum
    acceleration: float  # [m/s2]
    deceleration: float  # [m/s2]
    angular_acceleration: float  # [rad/s2]
    radius: float  # [m], turning radius of a car; 0 for bodies that turn on the spot
    reaction_time: float  # [s], from a scan to braking
    margin: float  # [m], kept free in front of the body at rest
    side_margin: float  # [m], kept free beside it
    rim: float  # [m/s], maximum of each wheel of a differential base; inf for others
    half_track: float  # [m], from the middle of the base to a wheel
    strafes: bool  # it may drive sideways instead of turning first


def model_of(
    body: BodyDescription, speed: float | None = None, aggressiveness: float = 0.5
) -> MotionModel:
    """Return the model of `body`, driven no faster than `speed` [m/s].

    An `aggressiveness` below 0.5 reduces the acceleration.
    """
    fastest = body.max_linear_speed if speed is None else min(speed, body.max_linear_speed)
    eagerness = min(1.0, 2.0 * aggressiveness)
    gain = ACCELERATION_SHARE * (
        MIN_ACCELERATION_SHARE + (1.0 - MIN_ACCELERATION_SHARE) * eagerness
    )
    car, limits = body.drive_type == "ackermann", limits_of(body)
    sees_ahead = any(camera.depth for camera in body.cameras)  # then it should face its path
    return MotionModel(
        forward=fastest,
        backward=min(MAX_REVERSE_SPEED, 0.5 * fastest),
        lateral=0.0 if car else min(body.max_lateral_speed, fastest),
        turning=body.max_angular_speed,
        acceleration=gain * body.max_linear_acceleration,
        deceleration=ACCELERATION_SHARE * body.max_linear_deceleration,
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
    """Return `model` with speeds up to `speed` [m/s]."""
    if speed is None or speed >= model.forward:
        return model
    slow = max(speed, MIN_SPEED)
    return model._replace(
        forward=slow, backward=min(model.backward, slow), lateral=min(model.lateral, slow)
    )


def delayed_model(model: MotionModel, seconds: float) -> MotionModel:
    """Return a model that reacts `seconds` later, with the same stopping distance."""
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
    """Return the value nearest to `target` that one step from `before` can reach.

    A step may pass 0: it lasts several ticks, and a ramp stays at 0 for one of them only.
    """
    highest = before + (up if before >= 0.0 else down)
    lowest = before - (up if before <= 0.0 else down)
    return max(lowest, min(highest, target))


@lean_kernel
def limit_slanted(model: MotionModel, vx: float, vy: float) -> tuple[float, float]:
    """Limit a strafing body's velocity to the ellipse through its limits ahead and sideways."""
    vx = max(-model.backward, min(model.forward, vx))
    vy = max(-model.lateral, min(model.lateral, vy))
    along = vx / (model.forward if vx > 0.0 else max(model.backward, MIN_DIVISOR))
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

    Targets of strafing bodies need `limit_slanted` first.
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

    decay: float  # remaining share of a velocity error after the step
    glide: float  # [s], distance that the error adds, per unit of it


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

    x: float  # [m], in the planning frame
    y: float
    yaw: float  # [rad]
    vx: float  # [m/s], as measured
    vy: float
    w: float  # [rad/s]
    before: tuple[float, float, float]  # the last command
    past: Floats  # (n + 1, 3), mean commands of the last steps, oldest first
    share: float  # of each step in which the older command is still in force, 0 to 1
    lag: FirstOrderLag
    gain: float  # of the yaw rate; one below 1 limits the yaw rate to this share of its maximum


@lean_kernel
def make_feasible(model: MotionModel, start: InitialState, dt: float, plans: Floats) -> None:
    """Make `plans` (T, 3, LANES) feasible in place.

    Slices of one array have constant offsets, so that loops are vectorised; also below.
    """
    turning = model.turning * min(1.0, start.gain)
    flat = plans.reshape(-1)
    for t in range(plans.shape[0] if model.strafes else 0):  # in its own loop: it is slow
        command = flat[t * COMMAND : (t + 1) * COMMAND]
        for lane in range(LANES):
            slower = limit_slanted(model, command[lane], command[LANES + lane])
            command[lane], command[LANES + lane] = slower
    for lane in range(LANES):
        wanted = max(-turning, min(turning, flat[2 * LANES + lane]))
        first = feasible(model, start.before, (flat[lane], flat[LANES + lane], wanted), dt)
        flat[lane], flat[LANES + lane], flat[2 * LANES + lane] = first
    for t in range(1, plans.shape[0]):
        pair = flat[(t - 1) * COMMAND : (t + 1) * COMMAND]
        for lane in range(LANES):
            before = pair[lane], pair[LANES + lane], pair[2 * LANES + lane]
            wanted = max(-turning, min(turning, pair[SECOND_TURN + lane]))
            second = feasible(
                model, before, (pair[SECOND_X + lane], pair[SECOND_Y + lane], wanted), dt
            )
            pair[SECOND_X + lane], pair[SECOND_Y + lane], pair[SECOND_TURN + lane] = second


@lean_kernel
def simulate(
    model: MotionModel, far: float, start: InitialState, dt: float, plans: Floats, states: Floats
) -> None:
    """Fill `states` (T + 1, STATE) with the motion by feasible `plans` (T, 3, LANES).

    `far` [m] is the largest distance of the body's outline to its origin.
    """
    _fill_first(start, states[0])
    flat = states.reshape(-1)
    for t in range(plans.shape[0]):
        _fill_active_commands(start, plans, t, states[t + 1])
        s = flat[t * STATE : (t + 2) * STATE]
        for lane in range(LANES):
            n = STATE + lane
            vx, ahead = lagged_step(s[VX + lane], s[VX + n], start.lag, dt)
            vy, aside = lagged_step(s[VY + lane], s[VY + n], start.lag, dt)
            w, turned = lagged_step(s[W + lane], s[W + n], start.lag, dt)
            cosine, sine = _rotate(s[COSINE + lane], s[SINE + lane], 0.5 * turned)
            s[X + n] = s[X + lane] + (cosine * ahead - sine * aside)
            s[Y + n] = s[Y + lane] + (sine * ahead + cosine * aside)
            s[YAW + n] = s[YAW + lane] + turned
            s[VX + n], s[VY + n], s[W + n] = vx, vy, w
            s[COSINE + n], s[SINE + n] = _rotate(cosine, sine, 0.5 * turned)
            s[MOVED + n] = abs(ahead) + abs(aside) + far * abs(turned)


@lean_kernel
def _fill_first(start: InitialState, state: Floats) -> None:
    cosine, sine = math.cos(start.yaw), math.sin(start.yaw)
    for lane in range(LANES):
        state[X + lane], state[Y + lane], state[YAW + lane] = start.x, start.y, start.yaw
        state[VX + lane], state[VY + lane], state[W + lane] = start.vx, start.vy, start.w
        state[COSINE + lane], state[SINE + lane], state[MOVED + lane] = cosine, sine, 0.0


@lean_kernel
def _fill_active_commands(start: InitialState, plans: Floats, t: int, state: Floats) -> None:
    """Fill the velocities of `state` with the mean commands [m/s, rad/s] in force in step `t`."""
    older, newer = t - start.past.shape[0], t - start.past.shape[0] + 1
    share, rest = start.share, 1.0 - start.share
    for axis in range(3):
        active = state[VX + axis * LANES : VX + (axis + 1) * LANES]
        if newer < 0:
            mean = share * start.past[t, axis] + rest * start.past[t + 1, axis]
            for lane in range(LANES):
                active[lane] = mean
        elif older < 0:
            old, new = share * start.past[t, axis], plans[newer, axis]
            for lane in range(LANES):
                active[lane] = old + rest * new[lane]
        else:
            before, new = plans[older, axis], plans[newer, axis]
            for lane in range(LANES):
                active[lane] = share * before[lane] + rest * new[lane]


@lean_kernel
def _rotate(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """Turn a direction by less than 0.5 rad, by a Taylor series: faster than sin and cos."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0))))
    return cosine * c - sine * s, sine * c + cosine * s
