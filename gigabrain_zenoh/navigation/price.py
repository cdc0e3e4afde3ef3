"""What a plan costs, as far as it matters, from where it leads. A second is worth 8.

To look at the whole outline of a body in each of its places is what takes the time. So all that can
be had without comes first, for all lanes at once: what a plan costs at least tells whether to look.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import NONE, lean_kernel
from gigabrain_zenoh.navigation.among import near_discs, of_contact
from gigabrain_zenoh.navigation.footprint import (
    ROOM,
    STRETCH,
    UNSURE,
    Outline,
    between,
    clearance_of,
)
from gigabrain_zenoh.navigation.models import Model
from gigabrain_zenoh.navigation.rating import (
    Scene,
    Weights,
    exponential,
    of_braking,
    of_end,
    of_motion,
    of_place,
    of_time,
    rest,
)
from gigabrain_zenoh.navigation.rollout import (
    AWAY,
    CLOSE,
    COSINE,
    LANES,
    MIDDLE,
    MOVED,
    SINE,
    SURE,
    VX,
    VY,
    YAW,
    W,
    X,
    Y,
)

Floats = NDArray[np.float64]

TOUCHED = 300.0  # what a contact costs
IMPACT = 50.0  # per m/s of a contact
BRAKE_EVERY = 3  # steps
AT_EASE = 0.25  # [m], room of more than that is not looked at anew before it can have gone
SPARE = 0.003  # [m], less room than at the start is a contact only from here on


@lean_kernel
def look_round(weights: Weights, outline: Outline, scene: Scene, dt: float, states: Floats) -> None:
    """Fill in what is round the bodies in `states` (T + 1, STATE), and what that costs at least.

    MIDDLE takes how far an obstacle is from the body's middle [m], SURE what a second there costs
    without anything that moves, AWAY and CLOSE what `near_discs` says.
    """
    grid, per_cell = scene.grid, 1.0 / scene.grid.cell
    for t in range(states.shape[0]):
        state = states[t]
        for lane in range(LANES):  # where the middle is, in cells
            x, y = state[X + lane] - grid.x, state[Y + lane] - grid.y
            cosine, sine = state[COSINE + lane], state[SINE + lane]
            x += cosine * outline.center_x - sine * outline.center_y
            y += sine * outline.center_x + cosine * outline.center_y
            state[MIDDLE + lane], state[SURE + lane] = x * per_cell - 0.5, y * per_cell - 0.5
        for lane in range(LANES):
            column, row = state[MIDDLE + lane], state[SURE + lane]
            state[MIDDLE + lane] = between(grid.distance, column, row)
        for lane in range(LANES):
            room = state[MIDDLE + lane] - outline.inner  # it is no more than that
            room = room if room < AT_EASE else ROOM
            near = weights.near * exponential((weights.margin - room) / weights.near_over)
            motion = of_motion(weights, room, state[VX + lane], state[VY + lane], state[W + lane])
            time = of_time(scene, state[X + lane], state[Y + lane], state[YAW + lane])
            state[SURE + lane] = time + motion + (near if room < AT_EASE else 0.0)
        near_discs(weights, scene.discs, outline, t * dt, state)


@lean_kernel
def rooms_of(scene: Scene, outline: Outline, states: Floats, rooms: Floats) -> None:
    """Fill `rooms` (n,) with the clearances [m] in the first `states`, which all lanes share."""
    for t in range(len(rooms)):
        one = states[t]
        found = clearance_of(
            scene.grid, outline, one[X], one[Y], one[COSINE], one[SINE], one[MIDDLE], int(NONE)
        )
        rooms[t] = found[0]


@lean_kernel
def price(
    model: Model, outline: Outline, weights: Weights, scene: Scene, dt: float, rooms: Floats,
    states: Floats, lane: int, limit: float,
) -> float:  # fmt: skip
    """The cost of going through a lane's `states`, or inf as soon as it is clear that it reaches
    `limit`. `rooms` are those of `rooms_of`.
    """
    least = min(weights.margin, rooms[0] - SPARE)
    least_disc = min(weights.disc_margin, states[0, AWAY + lane] - SPARE)
    last = states[-1]
    end = of_end(
        model, weights, scene, last[X + lane], last[Y + lane], last[YAW + lane],
        last[COSINE + lane], last[SINE + lane], last[VX + lane], last[VY + lane],
    )  # fmt: skip
    to_come = -math.inf
    if limit < math.inf:
        touching, passing = _at_least(
            model, outline, weights, scene, dt, states, lane, (least, least_disc)
        )
        to_come = passing + end if touching >= limit else -math.inf
        if min(touching, passing + end) >= limit:
            return math.inf
    cost: float = 0.0
    room, slack, touches, looked = ROOM, 0.0, int(NONE), False
    steps = states.shape[0] - 1
    for t in range(1, steps + 1):
        if cost + to_come >= limit:
            return math.inf
        one = states[t]
        x, y, vx, vy = one[X + lane], one[Y + lane], one[VX + lane], one[VY + lane]
        cosine, sine = one[COSINE + lane], one[SINE + lane]
        slack -= one[MOVED + lane]
        looked = slack < 0.0 and not (looked and room - one[MOVED + lane] > least)
        if looked:
            if t < len(rooms):
                room = rooms[t]
            else:
                room, touches = clearance_of(
                    scene.grid, outline, x, y, cosine, sine, one[MIDDLE + lane], touches
                )
            slack = room - AT_EASE
        away = one[AWAY + lane]
        if room < least:
            cost += _of_touch(t / steps) + rest(model, scene, x, y)
            return cost + IMPACT * math.hypot(vx, vy)
        if away < least_disc:
            return cost + of_contact(weights, t * dt, t / steps) + rest(model, scene, x, y)
        cost += dt * one[CLOSE + lane]
        cost += dt * of_place(weights, scene, room, away, x, y, one[YAW + lane])
        cost += dt * of_motion(weights, room, vx, vy, one[W + lane])
        to_come -= dt * (one[SURE + lane] + one[CLOSE + lane])
        if t % BRAKE_EVERY == 1:
            braking = of_braking(model, outline, scene, room, x, y, cosine, sine, vx, vy)
            cost += dt * BRAKE_EVERY * braking
    return cost + end


@lean_kernel
def _of_touch(share: float) -> float:
    """What a contact costs after such a share of the plan."""
    return TOUCHED * (1.0 - 0.7 * share)


@lean_kernel
def _at_least(
    model: Model, outline: Outline, weights: Weights, scene: Scene, dt: float, states: Floats,
    lane: int, least: tuple[float, float],
) -> tuple[float, float]:  # fmt: skip
    """What a lane costs at least with a contact, and without one but for its end; inf for never.

    A contact is possible where the middle of the body is so near to an obstacle that it may, and
    comes at the latest where it is well inside: what the plan would be worth behind says nothing.
    """
    may = least[0] + STRETCH * outline.outer + UNSURE * scene.grid.cell
    must = outline.inner + min(0.0, least[0])
    steps = states.shape[0] - 1
    touching, spent = math.inf, 0.0
    for t in range(1, steps + 1):
        one = states[t]
        middle, struck = one[MIDDLE + lane], one[AWAY + lane] < least[1]
        if middle < may or struck:
            left = spent + rest(model, scene, one[X + lane], one[Y + lane])
            if middle < may:
                touching = min(touching, left + _of_touch(t / steps))
            if struck:
                touching = min(touching, left + of_contact(weights, t * dt, t / steps))
        if middle < must or struck:
            return touching, math.inf
        spent += dt * (one[SURE + lane] + one[CLOSE + lane])
    return touching, spent
