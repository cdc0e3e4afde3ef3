"""A quick body among things that move quickly: how it looks ahead, and how far it keeps off them.

They may turn at any moment, so that it keeps the farther off what is faster, and what is foreseen
counts less the later it is. Slow bodies, and those among what is slow, plan as if nothing were.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import lean_kernel
from gigabrain_zenoh.navigation.footprint import Outline
from gigabrain_zenoh.navigation.models import Model
from gigabrain_zenoh.navigation.rating import DISC_ROOM, NO_DISC, Weights, exponential
from gigabrain_zenoh.navigation.rollout import AWAY, CLOSE, COSINE, LANES, SINE, X, Y

Floats = NDArray[np.float64]

QUICK = 1.0  # [m/s], a body that can go faster is quick
MOVES_QUICKLY = 0.3  # [m/s]
HORIZON_S = 2.0  # of its plans
LOOKS_S = 0.6  # before it first drives off: so long it takes to tell what moves
SIZES_UP_S = 4.0  # instead, where there is traffic: so long it takes to tell where
AWAY_M = 1.25  # what comes nearer meanwhile it makes way for
GROWS_S = 0.5  # how long what is known of a thing fades
TOUCHED_DISC = 200.0  # what a contact with a moving thing costs
DECAYS = 4.0  # times the way over which the cost of being near decays; farther off is nothing
WEIGHTS = Weights(disc=9.0, disc_lead=0.1, trust=0.7)


def is_quick(model: Model) -> bool:
    """Whether a body looks out for what moves quickly."""
    return model.forward > QUICK


def moving_quickly(discs: Floats) -> Floats:
    """Those of the `discs` (m, 6), their velocity x, y [m/s] third and fourth, that are quick."""
    found: Floats = discs[np.hypot(discs[:, 2], discs[:, 3]) > MOVES_QUICKLY]
    return found


def keep_away(discs: Floats, x: float, y: float) -> bool:
    """Whether none of the `discs` (m, 6) comes near (x, y) [m] while somebody there looks round."""
    dx, dy, vx, vy = discs[:, 0] - x, discs[:, 1] - y, discs[:, 2], discs[:, 3]
    nearest = -(dx * vx + dy * vy) / np.maximum(vx * vx + vy * vy, 1e-9)
    when = np.clip(nearest, 0.0, HORIZON_S)
    away = np.hypot(dx + vx * when, dy + vy * when) - discs[:, 4]
    return bool((away > AWAY_M).all())


@lean_kernel
def of_contact(weights: Weights, seconds: float, share: float) -> float:
    """What a contact with a moving thing costs, so late and after such a share of the plan."""
    if weights.trust > 0.0:
        return TOUCHED_DISC * math.exp(-seconds / weights.trust)
    return TOUCHED_DISC * (1.0 - 0.6 * share)


@lean_kernel
def near_discs(
    weights: Weights, discs: Floats, outline: Outline, seconds: float, state: Floats
) -> None:
    """How near the bodies of a `state` are to `discs` (m, 6), so many `seconds` from now.

    AWAY takes how far each body's box is from the nearest [m], CLOSE, where that is counted, what
    it costs for a second to be so near to them all.
    """
    for lane in range(LANES):
        state[AWAY + lane], state[CLOSE + lane] = NO_DISC, 0.0
    fades = weights.trust > 0.0
    for disc in discs:
        vx, vy = disc[2], disc[3]
        x, y = disc[0] + vx * seconds, disc[1] + vy * seconds
        radius = disc[4] + disc[5] * (min(seconds, GROWS_S) if fades else seconds)
        over = weights.disc_over + weights.disc_lead * math.sqrt(vx * vx + vy * vy)
        room = DECAYS * over if fades else DISC_ROOM
        if _any_near(state, x, y, outline.far + radius + room):
            _add_disc(outline, x, y, radius, room, 1.0 / over if fades else 0.0, state)
    if fades:
        for lane in range(LANES):
            state[CLOSE + lane] *= weights.disc


@lean_kernel
def _any_near(state: Floats, x: float, y: float, reach: float) -> bool:
    near = False
    for lane in range(LANES):
        dx, dy = x - state[X + lane], y - state[Y + lane]
        near |= dx * dx + dy * dy < reach * reach
    return near


@lean_kernel
def _add_disc(
    outline: Outline, x: float, y: float, radius: float, room: float, decay: float, state: Floats
) -> None:
    """One disc more. What is farther from it than `room` [m] takes no notice."""
    reach = outline.far + radius + room
    for lane in range(LANES):
        dx, dy = x - state[X + lane], y - state[Y + lane]
        cosine, sine = state[COSINE + lane], state[SINE + lane]
        ahead, aside = cosine * dx + sine * dy, cosine * dy - sine * dx
        out_x = max(outline.rear - ahead, 0.0, ahead - outline.front)
        out_y = max(outline.right - aside, 0.0, aside - outline.left)
        away = math.sqrt(out_x * out_x + out_y * out_y) - radius
        near = dx * dx + dy * dy < reach * reach
        cost = exponential(-decay * max(0.0, away)) if near and decay > 0.0 else 0.0
        state[AWAY + lane] = min(state[AWAY + lane], away if near else NO_DISC)
        state[CLOSE + lane] += cost
