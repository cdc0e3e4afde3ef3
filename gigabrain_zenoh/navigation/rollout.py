"""What a plan of commands leads to, and what that costs. Costs are such that a second is worth 8.

The body answers a command after its delay, and then as a first-order lag: what it does in the
first moments was decided by commands that have already been sent.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import lean_kernel
from gigabrain_zenoh.navigation.footprint import ROOM, Outline, clearance
from gigabrain_zenoh.navigation.models import Lag, Model, answer, feasible
from gigabrain_zenoh.navigation.rating import (
    Scene,
    Weights,
    from_discs,
    of_braking,
    of_end,
    of_motion,
    of_place,
    rest,
)

Floats = NDArray[np.float64]

TOUCHED, TOUCHED_DISC = 300.0, 200.0  # what a contact costs
IMPACT = 50.0  # per m/s of a contact
BRAKE_EVERY = 3  # steps
AT_EASE = 0.25  # [m], room of more than that is not looked at anew before it can have gone


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
def effective(start: Start, plan: Floats, t: int, axis: int) -> float:
    """The mean command [m/s or rad/s] that rules the body in step `t`."""
    delayed = start.past.shape[0]
    older, newer = t - delayed, t - delayed + 1
    old = start.past[t, axis] if older < 0 else plan[older, axis]
    new = start.past[t + 1, axis] if newer < 0 else plan[newer, axis]
    mean: float = start.share * old + (1.0 - start.share) * new
    return mean


@lean_kernel
def drive(
    model: Model,
    outline: Outline,
    weights: Weights,
    scene: Scene,
    start: Start,
    dt: float,
    plan: Floats,
    track: Floats,
) -> float:
    """The cost of `plan` (T, 3), which is first made feasible in place.

    Where there is room, `track` (T + 1, 6) takes the states: x, y, yaw, vx, vy, w.
    """
    steps = plan.shape[0]
    x, y, yaw, vx, vy, w = start.x, start.y, start.yaw, start.vx, start.vy, start.w
    before = start.before
    cosine, sine = math.cos(yaw), math.sin(yaw)
    least = clearance(scene.grid, outline, x, y, cosine, sine) - 0.003
    least_disc = from_discs(scene.discs, outline, x, y, cosine, sine, 0.0) - 0.003
    least, least_disc = min(weights.margin, least), min(weights.disc_margin, least_disc)
    turning = model.turning * min(1.0, start.gain)
    cost, alive, noted = 0.0, True, len(track) > 0
    room, slack = ROOM, 0.0
    _note(track, 0, x, y, yaw, vx, vy, w)
    for t in range(steps):
        w_wanted = max(-turning, min(turning, plan[t, 2]))
        before = feasible(model, before, (plan[t, 0], plan[t, 1], w_wanted), dt)
        plan[t, 0], plan[t, 1], plan[t, 2] = before
        vx, ahead = answer(vx, effective(start, plan, t, 0), start.lag, dt)
        vy, aside = answer(vy, effective(start, plan, t, 1), start.lag, dt)
        w, turned = answer(w, effective(start, plan, t, 2), start.lag, dt)
        cosine, sine = _turn(cosine, sine, 0.5 * turned)
        x += cosine * ahead - sine * aside
        y += sine * ahead + cosine * aside
        cosine, sine = _turn(cosine, sine, 0.5 * turned)
        yaw += turned
        _note(track, t + 1, x, y, yaw, vx, vy, w)
        if not alive:
            continue
        slack -= abs(ahead) + abs(aside) + outline.far * abs(turned)
        if slack < 0.0:
            room = clearance(scene.grid, outline, x, y, cosine, sine)
            slack = room - AT_EASE
        away = from_discs(scene.discs, outline, x, y, cosine, sine, (t + 1) * dt)
        late = (t + 1.0) / steps
        if room < least:
            cost += TOUCHED * (1.0 - 0.7 * late) + rest(model, scene, x, y)
            cost += IMPACT * math.hypot(vx, vy)
            alive = False
        elif away < least_disc:
            cost += TOUCHED_DISC * (1.0 - 0.6 * late) + rest(model, scene, x, y)
            alive = False
        else:
            cost += dt * of_place(weights, scene, room, away, x, y, yaw)
            cost += dt * of_motion(weights, room, vx, vy, w)
            if t % BRAKE_EVERY == 0:
                braking = of_braking(model, outline, scene, room, x, y, cosine, sine, vx, vy)
                cost += dt * BRAKE_EVERY * braking
        if not (alive or noted):
            break
    if alive:
        cost += of_end(model, weights, scene, x, y, yaw, vx, vy)
    return cost


@lean_kernel
def _turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """A direction turned by less than half a radian; Taylor's series is quicker than sin, cos."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square / 720.0))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0)))
    return cosine * c - sine * s, sine * c + cosine * s


@lean_kernel
def _note(
    track: Floats, t: int, x: float, y: float, yaw: float, vx: float, vy: float, w: float
) -> None:
    if t < track.shape[0]:
        track[t, 0], track[t, 1], track[t, 2] = x, y, yaw
        track[t, 3], track[t, 4], track[t, 5] = vx, vy, w
