"""Lower bounds of a plan's cost from its last pose, which rule out most plans."""

import math
from typing import NamedTuple

import numpy as np

from gigabrain_zenoh.kernels.jit import lean_kernel
from gigabrain_zenoh.navigation.cost import (
    COST_PER_S,
    NEAR_GOAL_M,
    contact_cost,
    disc_contact_cost,
    remaining_cost,
    terminal_cost,
)
from gigabrain_zenoh.navigation.footprint import Singles
from gigabrain_zenoh.navigation.motion_model import InitialState
from gigabrain_zenoh.navigation.planning_problem import MotionState, Problem

SLACK = 0.01  # cost, above rounding errors


class PlanBounds(NamedTuple):
    """Lower bounds for all plans of a cycle."""

    touching: float  # the cost of a plan with a contact
    spent: float  # the cost of a plan without a contact, and without its terminal cost


@lean_kernel
def bounds_of(problem: Problem, start: InitialState, steps: int) -> PlanBounds:
    """Return the bounds of plans of `steps` steps.

    They assume that the body can be anywhere within reach of its speed, and count time only.
    """
    model, _, weights, scene, dt = problem
    speed, field = _fastest(problem, start), scene.field
    away = math.hypot(scene.goal_x - start.x, scene.goal_y - start.y)
    rows, columns = field.distance.shape
    row = max(0, min(rows - 1, int((start.y - field.y) / field.cell)))
    column = max(0, min(columns - 1, int((start.x - field.x) / field.cell)))
    touching, spent, way, ring = math.inf, 0.0, math.inf, 0
    for t in range(1, steps + 1):
        reach = speed * t * dt
        while ring < reach / field.cell + 3.0:  # and the cells used in interpolation
            way = min(way, _least_on_ring(field.distance, row, column, ring))
            ring += 1
        left = way if away - reach >= NEAR_GOAL_M else min(way, max(0.0, away - reach))
        if len(scene.track) > 0:
            left = scene.track[-1, 3]
        contact = contact_cost(t / steps)
        if len(scene.discs) > 0:
            contact = min(contact, disc_contact_cost(weights, t * dt, t / steps))
        touching = min(touching, spent + COST_PER_S * left / model.forward + contact)
        spent += 0.5 * COST_PER_S * dt if away - reach > scene.tolerance else 0.0
    return PlanBounds(touching - SLACK, spent - SLACK)


@lean_kernel
def may_cost_less(problem: Problem, bounds: PlanBounds, end: MotionState, limit: float) -> bool:
    """Return whether a plan that leads to `end` may cost less than `limit`."""
    if bounds.touching < limit:
        return True
    left = limit - bounds.spent
    way = remaining_cost(problem.model, problem.scene, end.at.x, end.at.y, end.yaw)
    return way < left and terminal_cost(problem, end) < left


@lean_kernel
def _fastest(problem: Problem, start: InitialState) -> float:
    """Return the speed [m/s] that no plan exceeds."""
    model = problem.model
    ahead = max(model.forward, model.backward, abs(start.vx), abs(start.before[0]))
    aside = max(model.lateral, abs(start.vy), abs(start.before[1]))
    for n in range(len(start.past)):
        ahead, aside = max(ahead, abs(start.past[n, 0])), max(aside, abs(start.past[n, 1]))
    return math.hypot(ahead, aside)


@lean_kernel
def _least_on_ring(field: Singles, row: int, column: int, ring: int) -> float:
    """Return the least of the cells `ring` rows or columns away, limited to the grid."""
    rows, columns = field.shape
    top, bottom = max(0, row - ring), min(rows - 1, row + ring)
    left, right = max(0, column - ring), min(columns - 1, column + ring)
    above = below = before = beyond = np.float32(math.inf)
    for j in range(left, right + 1):
        above, below = min(above, field[top, j]), min(below, field[bottom, j])
    for i in range(top, bottom + 1):
        before, beyond = min(before, field[i, left]), min(beyond, field[i, right])
    return float(min(min(above, below), min(before, beyond)))
