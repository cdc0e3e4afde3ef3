"""What a plan of commands leads to, and what that costs. Costs are such that a second is worth 8.

The body answers a command after its delay, and then as a first-order lag: what it does in the
first moments was decided by commands that have already been sent.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel, lean_kernel
from gigabrain_zenoh.navigation.among import of_contact, of_discs
from gigabrain_zenoh.navigation.footprint import ROOM, Outline, clearance_of, depth_of
from gigabrain_zenoh.navigation.models import Lag, Model, answer, feasible
from gigabrain_zenoh.navigation.rating import (
    Scene,
    Weights,
    from_discs,
    of_braking,
    of_end,
    of_motion,
    of_place,
    of_time,
    rest,
)

Floats = NDArray[np.float64]

TOUCHED = 300.0  # what a contact costs
LEAST_TOUCHED = 80.0  # or with what moves, in the last step
IMPACT = 50.0  # per m/s of a contact
BRAKE_EVERY = 3  # steps
AT_EASE = 0.25  # [m], room of more than that is not looked at anew before it can have gone


class State(NamedTuple):
    """Where the body is in one moment of a plan, and how it moves."""

    x: float  # [m]
    y: float
    yaw: float  # [rad]
    vx: float  # [m/s]
    vy: float
    w: float  # [rad/s]
    cosine: float  # of the yaw
    sine: float
    moved: float  # [m], no point of it has gone farther in the step before


STATE = len(State._fields)


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
    rooms: Floats,
    plan: Floats,
    states: Floats,
    limit: float,
) -> float:
    """The cost of `plan` (T, 3), which is first made feasible in place; inf for `limit` or more.

    `rooms` are those of `first_rooms`. `states` (T + 1, STATE) takes what the plan leads to.
    """
    _move(model, outline.far, start, dt, plan, states)
    return _rate(model, outline, weights, scene, dt, rooms, states, limit)


@kernel
def first_rooms(
    model: Model, outline: Outline, scene: Scene, start: Start, dt: float, states: Floats
) -> Floats:
    """The clearances [m] from the start on, until a plan has any effect: (n,), n of 1 or more.

    `states` (T + 1, STATE) is scribbled on.
    """
    rooms = np.empty(min(states.shape[0], start.past.shape[0]))
    _move(model, outline.far, start, dt, np.zeros((len(rooms) - 1, 3)), states)
    for t in range(len(rooms)):
        at = _noted(states, t)
        rooms[t] = clearance_of(scene.grid, outline, at.x, at.y, at.cosine, at.sine, 0)[0]
    return rooms


@lean_kernel
def _move(model: Model, far: float, start: Start, dt: float, plan: Floats, states: Floats) -> None:
    """Fill `states` with where `plan`, made feasible, takes a body that reaches so `far` [m]."""
    x, y, yaw, vx, vy, w = start.x, start.y, start.yaw, start.vx, start.vy, start.w
    before = start.before
    cosine, sine = math.cos(yaw), math.sin(yaw)
    turning = model.turning * min(1.0, start.gain)
    _note(states, 0, State(x, y, yaw, vx, vy, w, cosine, sine, 0.0))
    for t in range(plan.shape[0]):
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
        moved = abs(ahead) + abs(aside) + far * abs(turned)
        _note(states, t + 1, State(x, y, yaw, vx, vy, w, cosine, sine, moved))


@lean_kernel
def _rate(
    model: Model, outline: Outline, weights: Weights, scene: Scene, dt: float, rooms: Floats,
    states: Floats, limit: float,
) -> float:  # fmt: skip
    """The cost of going through `states`, or inf as soon as it is clear that it reaches `limit`."""
    steps, grid, discs = states.shape[0] - 1, scene.grid, scene.discs
    at, last = _noted(states, 0), _noted(states, steps)
    away = from_discs(discs, outline, at.x, at.y, at.cosine, at.sine, 0.0)
    least, least_disc = (
        min(weights.margin, rooms[0] - 0.003),
        min(weights.disc_margin, away - 0.003),
    )
    limit = _sound(model, weights, scene, dt, states, limit)
    end = of_end(model, weights, scene, last.x, last.y, last.yaw, last.vx, last.vy)
    to_come = end + dt * _anyway(outline, scene, states, least, limit)
    cost: float = 0.0
    room, slack, touches = ROOM, 0.0, 0
    for t in range(1, steps + 1):
        if cost + to_come >= limit:
            return math.inf
        at = _noted(states, t)
        slack -= at.moved
        if slack < 0.0:
            if t < len(rooms):
                room = rooms[t]
            else:
                room, touches = clearance_of(grid, outline, at.x, at.y, at.cosine, at.sine, touches)
            slack = room - AT_EASE
        away, close = of_discs(weights, discs, outline, at.x, at.y, at.cosine, at.sine, t * dt)
        if room < least:
            cost += TOUCHED * (1.0 - 0.7 * (t / steps)) + rest(model, scene, at.x, at.y)
            cost += IMPACT * math.hypot(at.vx, at.vy)
            return cost
        if away < least_disc:
            cost += of_contact(weights, t * dt, t / steps) + rest(model, scene, at.x, at.y)
            return cost
        cost += dt * close
        cost += dt * of_place(weights, scene, room, away, at.x, at.y, at.yaw)
        cost += dt * of_motion(weights, room, at.vx, at.vy, at.w)
        to_come -= dt * of_time(scene, at.x, at.y, at.yaw)
        if t % BRAKE_EVERY == 1:
            braking = of_braking(
                model, outline, scene, room, at.x, at.y, at.cosine, at.sine, at.vx, at.vy
            )
            cost += dt * BRAKE_EVERY * braking
    return cost + end


@lean_kernel
def _sound(
    model: Model, weights: Weights, scene: Scene, dt: float, states: Floats, limit: float
) -> float:
    """The `limit`, if no contact on the way costs less; inf otherwise.

    What a plan costs that touches nothing says nothing of one that does, and ends there.
    """
    least = min(LEAST_TOUCHED, of_contact(weights, (states.shape[0] - 1) * dt, 1.0))
    if limit <= least or limit == math.inf:
        return limit
    for t in range(1, states.shape[0]):
        if least + rest(model, scene, states[t, 0], states[t, 1]) < limit:
            return math.inf
    return limit


@lean_kernel
def _anyway(outline: Outline, scene: Scene, states: Floats, least: float, limit: float) -> float:
    """What `states` cost per second, however near obstacles are; inf with one well inside the body.

    Nobody looks for that where there is no `limit`.
    """
    cost, deepest = 0.0, min(0.0, least)
    for t in range(1, states.shape[0]):
        at = _noted(states, t)
        if limit < math.inf:
            depth = depth_of(scene.grid, outline, at.x, at.y, at.cosine, at.sine)
            if depth < deepest:
                return math.inf
        cost += of_time(scene, at.x, at.y, at.yaw)
    return cost


@lean_kernel
def _turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """A direction turned by less than half a radian; Taylor's series is quicker than sin, cos."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square * (1.0 / 5040.0))))
    return cosine * c - sine * s, sine * c + cosine * s


@lean_kernel
def _note(states: Floats, t: int, at: State) -> None:
    one = states[t]
    one[0], one[1], one[2], one[3], one[4], one[5] = at.x, at.y, at.yaw, at.vx, at.vy, at.w
    one[6], one[7], one[8] = at.cosine, at.sine, at.moved


@lean_kernel
def _noted(states: Floats, t: int) -> State:
    one = states[t]
    return State(one[0], one[1], one[2], one[3], one[4], one[5], one[6], one[7], one[8])
