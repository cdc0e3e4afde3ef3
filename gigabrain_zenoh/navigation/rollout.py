"""Where plans of commands lead, as many at a time as the processor takes in one go.

The body answers a command after its delay, and then as a first-order lag: what it does in the
first moments was decided by commands that have already been sent.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import lean_kernel
from gigabrain_zenoh.navigation.models import Lag, Model, answer, feasible

Floats = NDArray[np.float64]

LANES = 8  # plans at a time
X, Y, YAW, VX, VY, W = range(0, 6 * LANES, LANES)  # where the lanes of each begin in a state:
COSINE, SINE, MOVED = range(6 * LANES, 9 * LANES, LANES)  # its pose, velocity, and the way [m] that
MIDDLE, SURE, AWAY, CLOSE = range(9 * LANES, 13 * LANES, LANES)  # no point exceeds; see price.py
STATE = 13 * LANES
SECOND_X, SECOND_Y, SECOND_TURN = range(3 * LANES, 6 * LANES, LANES)  # of two commands in a row
COMMAND = 3 * LANES


class Start(NamedTuple):
    """Where the body is, how it moves, and what it has still to answer."""

    x: float  # [m], in the frame that is planned in
    y: float
    yaw: float  # [rad]
    vx: float  # [m/s], as measured
    vy: float
    w: float  # [rad/s]
    before: tuple[float, float, float]  # the last command
    past: Floats  # (n + 1, 3), mean of what was sent in each of the last steps, oldest first
    share: float  # of the first step that the oldest of them still rules, 0 to 1
    lag: Lag
    gain: float  # of the yaw rate: no more than so much of its largest can be had


@lean_kernel
def obey(model: Model, start: Start, dt: float, plans: Floats) -> None:
    """Make `plans` (T, 3, LANES) feasible in place.

    In one array, and slices of it, all offsets are known: it is vectorised. So below.
    """
    turning = model.turning * min(1.0, start.gain)
    flat = plans.reshape(-1)
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
def move(model: Model, far: float, start: Start, dt: float, plans: Floats, states: Floats) -> None:
    """Fill `states` (T + 1, STATE) with where feasible `plans` (T, 3, LANES) take the body.

    It reaches so `far` [m] from its origin.
    """
    _begin(start, states[0])
    flat = states.reshape(-1)
    for t in range(plans.shape[0]):
        _rule(start, plans, t, states[t + 1])
        s = flat[t * STATE : (t + 2) * STATE]
        for lane in range(LANES):
            n = STATE + lane
            vx, ahead = answer(s[VX + lane], s[VX + n], start.lag, dt)
            vy, aside = answer(s[VY + lane], s[VY + n], start.lag, dt)
            w, turned = answer(s[W + lane], s[W + n], start.lag, dt)
            cosine, sine = _turn(s[COSINE + lane], s[SINE + lane], 0.5 * turned)
            s[X + n] = s[X + lane] + (cosine * ahead - sine * aside)
            s[Y + n] = s[Y + lane] + (sine * ahead + cosine * aside)
            s[YAW + n] = s[YAW + lane] + turned
            s[VX + n], s[VY + n], s[W + n] = vx, vy, w
            s[COSINE + n], s[SINE + n] = _turn(cosine, sine, 0.5 * turned)
            s[MOVED + n] = abs(ahead) + abs(aside) + far * abs(turned)


@lean_kernel
def _begin(start: Start, state: Floats) -> None:
    cosine, sine = math.cos(start.yaw), math.sin(start.yaw)
    for lane in range(LANES):
        state[X + lane], state[Y + lane], state[YAW + lane] = start.x, start.y, start.yaw
        state[VX + lane], state[VY + lane], state[W + lane] = start.vx, start.vy, start.w
        state[COSINE + lane], state[SINE + lane], state[MOVED + lane] = cosine, sine, 0.0


@lean_kernel
def _rule(start: Start, plans: Floats, t: int, state: Floats) -> None:
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
    """A direction turned by less than half a radian; Taylor's series is quicker than sin, cos."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0))))
    return cosine * c - sine * s, sine * c + cosine * s
