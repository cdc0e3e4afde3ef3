"""What a plan of commands leads to, and what that costs. Costs are such that a second is worth 8.

The body answers a command after its delay, and then as a first-order lag: what it does in the
first moments was decided by commands that have already been sent.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import kernel
from gigabrain_zenoh.navigation.footprint import (
    Grid,
    Outline,
    clearance,
    distance_at,
    free_ahead,
)
from gigabrain_zenoh.navigation.models import Lag, Model, answer, feasible

Floats = NDArray[np.float64]

SECOND = 8.0  # what a second costs
TOUCHED, TOUCHED_DISC = 300.0, 200.0  # what a contact costs
IMPACT = 50.0  # per m/s of a contact
LOOK_AHEAD = 0.25  # [m], from where the last pose's heading is judged
NEAR_GOAL = 0.2  # [m], nearer the field is too coarse
SLOW = 0.05  # [m/s], slower than this it always stops in time
BRAKE_EVERY = 3  # steps
NO_DISC = 1e3  # [m], where nothing moves
TOO_FAST = 4.0  # per (m/s)2 and second above the speed from which the body stops in time


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
    gain: float  # of the yaw rate: how much of it the floor lets through


class Scene(NamedTuple):
    """All that is round the body."""

    grid: Grid  # distances to what stands still
    field: Grid  # cost to go [m]
    discs: Floats  # (m, 6): x, y [m], velocity x, y [m/s], radius [m] and its growth [m/s]
    goal_x: float  # [m]
    goal_y: float
    goal_yaw: float  # [rad]; nan where any will do
    tolerance: float  # [m]


class Weights(NamedTuple):
    """What is preferred, by how much."""

    margin: float = 0.03  # [m], nearer than this is a contact
    near: float = 1.2  # of having obstacles near, per second
    near_over: float = 0.05  # [m], over which that decays
    tight: float = 1.5  # of speed in tight places, per second
    tight_speed: float = 0.45  # [m/s], always allowed
    tight_rate: float = 4.0  # [1/s], more speed per metre of room
    turning: float = 0.02  # per (rad/s)2 and second
    backwards: float = 1.0  # per m
    heading: float = 1.5  # of facing away from the goal, in units of the time it takes to turn
    disc: float = 3.0  # of having moving things near, per second
    disc_over: float = 0.3  # [m]
    disc_margin: float = 0.02  # [m]


@kernel
def effective(start: Start, plan: Floats, t: int, axis: int) -> float:
    """The mean command [m/s or rad/s] that rules the body in step `t`."""
    delayed = start.past.shape[0]
    older, newer = t - delayed, t - delayed + 1
    old = start.past[t, axis] if older < 0 else plan[older, axis]
    new = start.past[t + 1, axis] if newer < 0 else plan[newer, axis]
    mean: float = start.share * old + (1.0 - start.share) * new
    return mean


@kernel
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
    least_disc = _from_discs(scene.discs, outline, x, y, cosine, sine, 0.0) - 0.003
    least, least_disc = min(weights.margin, least), min(weights.disc_margin, least_disc)
    cost, alive, noted = 0.0, True, len(track) > 0
    _note(track, 0, x, y, yaw, vx, vy, w)
    for t in range(steps):
        before = feasible(model, before, (plan[t, 0], plan[t, 1], plan[t, 2]), dt)
        plan[t, 0], plan[t, 1], plan[t, 2] = before
        vx, ahead = answer(vx, effective(start, plan, t, 0), start.lag, dt)
        vy, aside = answer(vy, effective(start, plan, t, 1), start.lag, dt)
        w, turned = answer(w, start.gain * effective(start, plan, t, 2), start.lag, dt)
        cosine, sine = _turn(cosine, sine, 0.5 * turned)
        x += cosine * ahead - sine * aside
        y += sine * ahead + cosine * aside
        cosine, sine = _turn(cosine, sine, 0.5 * turned)
        yaw += turned
        _note(track, t + 1, x, y, yaw, vx, vy, w)
        if not alive:
            continue
        room = clearance(scene.grid, outline, x, y, cosine, sine)
        away = _from_discs(scene.discs, outline, x, y, cosine, sine, (t + 1) * dt)
        late = (t + 1.0) / steps
        if room < least:
            cost += TOUCHED * (1.0 - 0.7 * late) + _rest(model, scene, x, y)
            cost += IMPACT * math.hypot(vx, vy)
            alive = False
        elif away < least_disc:
            cost += TOUCHED_DISC * (1.0 - 0.6 * late) + _rest(model, scene, x, y)
            alive = False
        else:
            cost += dt * _of_place(model, weights, scene, room, away, x, y)
            cost += dt * _of_motion(weights, room, vx, vy, w)
            if t % BRAKE_EVERY == 0:
                cost += (
                    dt
                    * BRAKE_EVERY
                    * _of_braking(model, outline, scene, room, x, y, cosine, sine, vx, vy)
                )
        if not (alive or noted):
            break
    if alive:
        cost += _of_end(model, weights, scene, x, y, yaw, vx, vy)
    return cost


@kernel
def _turn(cosine: float, sine: float, angle: float) -> tuple[float, float]:
    """A direction turned by less than half a radian; Taylor's series is quicker than sin, cos."""
    square = angle * angle
    c = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square / 720.0))
    s = angle * (1.0 - square * (1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0)))
    return cosine * c - sine * s, sine * c + cosine * s


@kernel
def _note(
    track: Floats, t: int, x: float, y: float, yaw: float, vx: float, vy: float, w: float
) -> None:
    if t < track.shape[0]:
        track[t, 0], track[t, 1], track[t, 2] = x, y, yaw
        track[t, 3], track[t, 4], track[t, 5] = vx, vy, w


@kernel
def _of_place(
    model: Model, weights: Weights, scene: Scene, room: float, away: float, x: float, y: float
) -> float:
    """What it costs to be here for a second, with obstacles and moving things so far away [m]."""
    cost = weights.near * math.exp((weights.margin - room) / weights.near_over)
    if away < NO_DISC:
        cost += weights.disc * math.exp(-away / weights.disc_over)
    if math.hypot(x - scene.goal_x, y - scene.goal_y) > scene.tolerance:
        cost += 0.5 * SECOND
    return cost


@kernel
def _of_motion(weights: Weights, room: float, vx: float, vy: float, w: float) -> float:
    """What it costs to move so for a second."""
    cost = weights.turning * w * w
    over = math.hypot(vx, vy) - (weights.tight_speed + weights.tight_rate * (room - weights.margin))
    if over > 0.0:
        cost += weights.tight * over * over
    if vx < 0.0:
        cost -= weights.backwards * vx
    return cost


@kernel
def _of_braking(
    model: Model, outline: Outline, scene: Scene, room: float, x: float, y: float,
    cosine: float, sine: float, vx: float, vy: float,
) -> float:  # fmt: skip
    """What it costs to be faster for a second than what is ahead allows: safety would step in."""
    speed = math.hypot(vx, vy)
    brake, t = model.deceleration, model.reaction_time
    needs = speed * t + speed * speed / (2.0 * brake) + model.margin
    if speed < SLOW or room >= needs:
        return 0.0
    sign = 1.0 if vx >= 0.0 else -1.0
    free = free_ahead(scene.grid, outline, x, y, cosine, sine, sign, model.side_margin, needs)
    allowed = math.sqrt((brake * t) ** 2 + 2.0 * brake * max(0.0, free - model.margin)) - brake * t
    over = max(0.0, speed - allowed)
    return TOO_FAST * over * over


@kernel
def _rest(model: Model, scene: Scene, x: float, y: float) -> float:
    """The cost of the way from (x, y) to the goal."""
    away = math.hypot(x - scene.goal_x, y - scene.goal_y)
    way = away if away < NEAR_GOAL else distance_in(scene.field, x, y)
    return SECOND * way / model.forward


@kernel
def distance_in(field: Grid, x: float, y: float) -> float:
    """The cost to go from (x, y) [m]; beyond the rim that of the rim."""
    rows, columns = field.distance.shape
    cell = field.cell
    inner_x = min(max(x, field.x + cell), field.x + (columns - 1) * cell)
    inner_y = min(max(y, field.y + cell), field.y + (rows - 1) * cell)
    return distance_at(field, inner_x, inner_y)


@kernel
def _of_end(
    model: Model, weights: Weights, scene: Scene, x: float, y: float, yaw: float,
    vx: float, vy: float,
) -> float:  # fmt: skip
    """What is left to do after the last step: to turn to the way, to drive it, to turn at its end.

    A body that has all but arrived only has to stand, with the right yaw.
    """
    cost = _rest(model, scene, x, y)
    dx, dy = scene.goal_x - x, scene.goal_y - y
    near = math.hypot(dx, dy) < NEAR_GOAL
    if not math.isnan(scene.goal_yaw):
        arrives = yaw if near else math.atan2(dy, dx)
        cost += SECOND * _turn_between(arrives, scene.goal_yaw) / model.turning
    if near:
        return cost + 0.5 * SECOND * math.hypot(vx, vy) / model.forward
    here = distance_in(scene.field, x, y)
    ahead = distance_in(scene.field, x + LOOK_AHEAD * math.cos(yaw), y + LOOK_AHEAD * math.sin(yaw))
    rise = max(-1.0, min(1.0, (ahead - here) / LOOK_AHEAD))
    return cost + weights.heading * (1.0 + rise) / model.turning


@kernel
def _turn_between(one: float, other: float) -> float:
    """The angle between two directions [rad], 0 to pi."""
    turn = one - other
    return abs(turn - math.tau * math.floor(turn / math.tau + 0.5))


@kernel
def _from_discs(
    discs: Floats, outline: Outline, x: float, y: float, cosine: float, sine: float, t: float
) -> float:
    """How far the body's box is from the nearest disc, `t` [s] from now [m]."""
    nearest = NO_DISC
    for i in range(discs.shape[0]):
        dx = discs[i, 0] + discs[i, 2] * t - x
        dy = discs[i, 1] + discs[i, 3] * t - y
        ahead, aside = cosine * dx + sine * dy, cosine * dy - sine * dx
        out_x = max(outline.rear - ahead, 0.0, ahead - outline.front)
        out_y = max(outline.right - aside, 0.0, aside - outline.left)
        away = math.hypot(out_x, out_y) - discs[i, 4] - discs[i, 5] * t
        nearest = min(nearest, away)
    return nearest
