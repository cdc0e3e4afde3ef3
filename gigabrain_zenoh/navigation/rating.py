"""What places, motions and ends of a plan cost, in units of which a second is worth 8."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import lean_kernel
from gigabrain_zenoh.navigation.footprint import ROOM, Grid, Outline, distance_at, free_ahead
from gigabrain_zenoh.navigation.models import Model

Floats = NDArray[np.float64]

SECOND = 8.0  # what a second costs
LOOK_AHEAD = 0.25  # [m], from where the last pose's heading is judged
NEAR_GOAL = 0.2  # [m], nearer the field is too coarse
SLOW = 0.05  # [m/s], slower than this it always stops in time
NO_DISC = 1e3  # [m], where nothing moves
DISC_ROOM = 1.5  # [m], what moves farther away makes no difference
TOO_FAST = 16.0  # per second at full speed where it cannot stop in time, by the square of the share


class Scene(NamedTuple):
    """All that is round the body."""

    grid: Grid  # distances to what stands still
    field: Grid  # cost to go [m]
    discs: Floats  # (m, 6): x, y [m], velocity x, y [m/s], radius [m] and its growth [m/s]
    goal_x: float  # [m]
    goal_y: float
    goal_yaw: float  # [rad]; nan where any will do
    tolerance: float  # [m]
    yaw_tolerance: float  # [rad]


class Weights(NamedTuple):
    """What is preferred, by how much."""

    margin: float = 0.03  # [m], nearer than this is a contact
    near: float = 3.0  # of having obstacles near, per second
    near_over: float = 0.08  # [m], over which that decays
    tight: float = 1.5  # of speed in tight places, per second
    tight_speed: float = 0.45  # [m/s], always allowed
    tight_rate: float = 4.0  # [1/s], more speed per metre of room
    turning: float = 0.02  # per (rad/s)2 and second
    backwards: float = 1.0  # per m
    heading: float = 0.8  # of facing away from the goal, in units of the time it takes to turn
    disc: float = 3.0  # of having moving things near, per second
    disc_over: float = 0.3  # [m]
    disc_margin: float = 0.02  # [m]
    disc_lead: float = 0.0  # [s], so much farther per m/s of a thing's speed
    trust: float = 0.0  # [s], over which what is foreseen of them fades; 0 where it does not


@lean_kernel
def of_place(
    weights: Weights, scene: Scene, room: float, away: float, x: float, y: float, yaw: float
) -> float:
    """What it costs to be here for a second, with obstacles and moving things so far away [m]."""
    cost = 0.0
    if room < ROOM:
        cost += weights.near * exponential((weights.margin - room) / weights.near_over)
    if away < NO_DISC and weights.trust == 0.0:
        cost += weights.disc * math.exp(-away / weights.disc_over)
    return cost + of_time(scene, x, y, yaw)


@lean_kernel
def exponential(x: float) -> float:
    """The exponential function, to eight digits from -5 to 5: a call of math.exp takes longer."""
    y = x * (1.0 / 32.0)
    square = y * y
    power = (
        1.0
        + y
        + square * (0.5 + y * (1.0 / 6.0))
        + square * square * (1.0 / 24.0 + y * (1.0 / 120.0) + square * (1.0 / 720.0))
    )
    for _ in range(5):
        power *= power
    return power


@lean_kernel
def of_time(scene: Scene, x: float, y: float, yaw: float) -> float:
    """What a second costs wherever it is; or it would put off the last turn for ever."""
    return 0.0 if _arrived(scene, x, y, yaw) else 0.5 * SECOND


@lean_kernel
def _arrived(scene: Scene, x: float, y: float, yaw: float) -> bool:
    dx, dy = x - scene.goal_x, y - scene.goal_y
    if dx * dx + dy * dy > scene.tolerance * scene.tolerance:
        return False
    any_yaw = math.isnan(scene.goal_yaw)
    return any_yaw or _turn_between(yaw, scene.goal_yaw) <= scene.yaw_tolerance


@lean_kernel
def of_motion(weights: Weights, room: float, vx: float, vy: float, w: float) -> float:
    """What it costs to move so for a second."""
    cost = weights.turning * w * w
    over = math.sqrt(vx * vx + vy * vy) - (
        weights.tight_speed + weights.tight_rate * (room - weights.margin)
    )
    if over > 0.0:
        cost += weights.tight * over * over
    if vx < 0.0:
        cost -= weights.backwards * vx
    return cost


@lean_kernel
def of_braking(
    model: Model, outline: Outline, scene: Scene, room: float, x: float, y: float,
    cosine: float, sine: float, vx: float, vy: float,
) -> float:  # fmt: skip
    """What it costs to be faster for a second than what is ahead allows: safety would step in."""
    speed = math.sqrt(vx * vx + vy * vy)
    brake, t = model.deceleration, model.reaction_time
    needs = speed * t + speed * speed / (2.0 * brake) + model.margin
    if speed < SLOW or room >= needs:
        return 0.0
    sign = 1.0 if vx >= 0.0 else -1.0
    free = free_ahead(scene.grid, outline, x, y, cosine, sine, sign, model.side_margin, needs)
    allowed = math.sqrt((brake * t) ** 2 + 2.0 * brake * max(0.0, free - model.margin)) - brake * t
    over = max(0.0, speed - allowed) / model.forward
    return TOO_FAST * over * over


@lean_kernel
def rest(model: Model, scene: Scene, x: float, y: float) -> float:
    """The cost of the way from (x, y) to the goal."""
    away = math.hypot(x - scene.goal_x, y - scene.goal_y)
    way = away if away < NEAR_GOAL else distance_in(scene.field, x, y)
    return SECOND * way / model.forward


@lean_kernel
def distance_in(field: Grid, x: float, y: float) -> float:
    """The cost to go from (x, y) [m]; beyond the rim that of the rim."""
    rows, columns = field.distance.shape
    cell = field.cell
    inner_x = min(max(x, field.x + cell), field.x + (columns - 1) * cell)
    inner_y = min(max(y, field.y + cell), field.y + (rows - 1) * cell)
    return distance_at(field, inner_x, inner_y)


@lean_kernel
def of_end(
    model: Model, weights: Weights, scene: Scene, x: float, y: float, yaw: float,
    cosine: float, sine: float, vx: float, vy: float,
) -> float:  # fmt: skip
    """What is left to do after the last step: to turn to the way, to drive it, to turn at its end.

    A body that has all but arrived only has to stand, with the right yaw.
    """
    cost = rest(model, scene, x, y)
    dx, dy = scene.goal_x - x, scene.goal_y - y
    near = math.hypot(dx, dy) < NEAR_GOAL
    if not math.isnan(scene.goal_yaw):
        arrives = yaw if near else math.atan2(dy, dx)
        cost += SECOND * _turn_between(arrives, scene.goal_yaw) / model.turning
    if near:
        return cost + 0.5 * SECOND * math.hypot(vx, vy) / model.forward
    here = distance_in(scene.field, x, y)
    ahead = distance_in(scene.field, x + LOOK_AHEAD * cosine, y + LOOK_AHEAD * sine)
    rise = max(-1.0, min(1.0, (ahead - here) / LOOK_AHEAD))
    turn = 0.5 * math.pi * (1.0 + rise)
    return cost + SECOND * weights.heading * turn / model.turning


@lean_kernel
def _turn_between(one: float, other: float) -> float:
    """The angle between two directions [rad], 0 to pi."""
    turn = one - other
    return abs(turn - math.tau * math.floor(turn / math.tau + 0.5))
