"""A quick body among things that move quickly: how it looks ahead, and how far it keeps off them.

They may turn at any moment, so that it keeps the farther off what is faster, and what is foreseen
counts less the later it is. Slow bodies, and those among what is slow, plan as if nothing were.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels import lean_kernel
from gigabrain_zenoh.navigation.footprint import Outline
from gigabrain_zenoh.navigation.models import Model
from gigabrain_zenoh.navigation.rating import NO_DISC, Weights, from_discs

Floats = NDArray[np.float64]

QUICK = 1.0  # [m/s], a body that can go faster is quick
MOVES_QUICKLY = 0.3  # [m/s]
HORIZON_S = 2.0  # of its plans
LOOKS_S = 0.6  # before it first drives off: so long it takes to tell what moves
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


@lean_kernel
def of_contact(weights: Weights, seconds: float, share: float) -> float:
    """What a contact with a moving thing costs, so late and after such a share of the plan."""
    if weights.trust > 0.0:
        return TOUCHED_DISC * math.exp(-seconds / weights.trust)
    return TOUCHED_DISC * (1.0 - 0.6 * share)


@lean_kernel
def of_discs(
    weights: Weights, discs: Floats, outline: Outline, x: float, y: float, cosine: float,
    sine: float, t: float,
) -> tuple[float, float]:  # fmt: skip
    """How far the body's box is from the nearest of `discs` (m, 6) `t` [s] from now [m].

    And what it costs for a second to be so near to each of them, where that is counted.
    """
    if weights.trust > 0.0:
        return near_discs(weights, discs, outline, x, y, cosine, sine, t)
    return from_discs(discs, outline, x, y, cosine, sine, t), 0.0


@lean_kernel
def near_discs(
    weights: Weights, discs: Floats, outline: Outline, x: float, y: float, cosine: float,
    sine: float, t: float,
) -> tuple[float, float]:  # fmt: skip
    """How far it is from the nearest [m], and what it costs for a second to be near to them all."""
    nearest, cost = NO_DISC, 0.0
    for i in range(discs.shape[0]):
        vx, vy = discs[i, 2], discs[i, 3]
        dx, dy = discs[i, 0] + vx * t - x, discs[i, 1] + vy * t - y
        radius = discs[i, 4] + discs[i, 5] * min(t, GROWS_S)
        over = weights.disc_over + weights.disc_lead * math.sqrt(vx * vx + vy * vy)
        reach = outline.far + radius + DECAYS * over
        if dx * dx + dy * dy >= reach * reach:
            continue
        ahead, aside = cosine * dx + sine * dy, cosine * dy - sine * dx
        out_x = max(outline.rear - ahead, 0.0, ahead - outline.front)
        out_y = max(outline.right - aside, 0.0, aside - outline.left)
        away = math.sqrt(out_x * out_x + out_y * out_y) - radius
        nearest = min(nearest, away)
        cost += math.exp(-max(0.0, away) / over)
    return nearest, weights.disc * cost
