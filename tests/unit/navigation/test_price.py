"""Costs of plans with a limit: only plans that reach the limit may be dropped."""

import math

import cv2
import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel
from gigabrain_zenoh.navigation.cost import evaluate_surroundings, fill_clearances, plan_cost
from gigabrain_zenoh.navigation.dynamic_obstacles import WEIGHTS
from gigabrain_zenoh.navigation.footprint import DistanceGrid, Outline, outline_of
from gigabrain_zenoh.navigation.motion_model import (
    LANES,
    STATE,
    InitialState,
    MotionModel,
    first_order_lag,
    make_feasible,
    model_of,
    simulate,
)
from gigabrain_zenoh.navigation.plan_bounds import bounds_of, may_cost_less
from gigabrain_zenoh.navigation.planning_problem import (
    Problem,
    Scene,
    Weights,
    motion_of,
)
from gigabrain_zenoh.qa.bench.barn_course import JACKAL

STEPS, DT, BLOCKS = 30, 0.05, 25
START = InitialState(
    0.0, 0.0, 0.2, 0.8, 0.0, 0.3, (0.8, 0.0, 0.3), np.tile((0.8, 0.0, 0.3), (3, 1)), 0.4,
    first_order_lag(0.15, DT), 1.0,
)  # fmt: skip
NO_DISCS = np.empty((0, 6))
DISCS = np.array([(1.2, 0.6, 0.0, -0.8, 0.3, 0.05), (1.0, -1.5, 0.5, 1.0, 0.3, 0.05)])


@kernel
def prices(
    model: MotionModel, outline: Outline, weights: Weights, scene: Scene, start: InitialState,
    dt: float, plans: Floats, states: Floats, limits: Floats, costs: Floats,
) -> None:  # fmt: skip
    """Fill `costs` (limits, blocks, LANES)."""
    rooms = np.empty(len(start.past))
    for block in range(len(plans)):
        make_feasible(model, start, dt, plans[block])
        simulate(model, outline.far, start, dt, plans[block], states)
        problem = Problem(model, outline, weights, scene, dt)
        evaluate_surroundings(problem, states)
        fill_clearances(scene, outline, states, rooms)
        for n in range(len(limits)):
            for lane in range(LANES):
                costs[n, block, lane] = plan_cost(problem, rooms, states, lane, limits[n])


def scene(discs: Floats) -> Scene:
    """Return posts in 8 x 8 m, some too close together for a body to pass."""
    random = np.random.default_rng(3)
    free = np.ones((320, 320), dtype=np.uint8)
    for x, y in random.uniform(-4.0, 4.0, (60, 2)):
        if math.hypot(x, y) > 0.6:
            cv2.circle(free, (round((x + 4) / 0.025), round((y + 4) / 0.025)), 4, 0, cv2.FILLED)
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5) * np.float32(0.025)
    x, y = np.meshgrid(np.arange(160) * 0.05 - 4.0, np.arange(160) * 0.05 - 4.0)
    to_go = (np.hypot(x - 3.0, y) * np.where(distance[::2, ::2] < 0.2, 20.0, 1.0)).astype(
        np.float32
    )
    field = DistanceGrid(to_go, 0.05, -4.0, -4.0)
    return Scene(
        DistanceGrid(distance, 0.025, -4.0, -4.0), field, discs, 3.0, 0.0, math.nan, 0.1, 0.1
    )


def random_plans() -> Floats:
    """Return plans (BLOCKS, STEPS, 3, LANES), many of which run into posts."""
    random = np.random.default_rng(1)
    plans: Floats = np.cumsum(random.normal(0.0, 0.5, (BLOCKS, STEPS, 3, LANES)), axis=1)
    plans[:, :, 0] += random.uniform(-0.5, 2.0, (BLOCKS, 1, LANES))
    return plans


@pytest.mark.long
@pytest.mark.parametrize(("weights", "discs"), [(Weights(), NO_DISCS), (WEIGHTS, DISCS)])
def test_a_cost_is_inf_only_if_it_reaches_the_limit(weights: Weights, discs: Floats) -> None:
    plans = random_plans()
    limits = np.array([math.inf, 40.0, 60.0, 100.0, 150.0])
    costs = np.empty((len(limits), BLOCKS, LANES))
    given = model_of(JACKAL), outline_of(JACKAL.footprint), weights, scene(discs), START, DT
    prices(*given, plans, np.empty((STEPS + 1, STATE)), limits, costs)
    whole = costs[0]
    assert np.isfinite(whole).all()
    for limit, found in zip(limits[1:], costs[1:], strict=True):
        matters = whole < limit
        assert 0 < matters.sum() < whole.size
        assert found[matters].tolist() == whole[matters].tolist()
        assert np.isinf(found[~matters]).any()


@kernel
def not_worth_pricing(
    problem: Problem, start: InitialState, plans: Floats, states: Floats, limits: Floats,
    dropped: Floats,
) -> None:  # fmt: skip
    """Fill `dropped` (blocks, LANES): 1 where a plan cannot cost less than its limit."""
    bounds = bounds_of(problem, start, plans.shape[1])
    for block in range(len(plans)):
        simulate(problem.model, problem.outline.far, start, problem.dt, plans[block], states)
        for lane in range(LANES):
            limit, end = limits[block, lane], motion_of(states[-1], lane)
            dropped[block, lane] = not may_cost_less(problem, bounds, end, limit)


@pytest.mark.long
@pytest.mark.parametrize("goal", [(3.0, 0.0), (0.4, 0.1)])
@pytest.mark.parametrize(("weights", "discs"), [(Weights(), NO_DISCS), (WEIGHTS, DISCS)])
def test_a_plan_is_dropped_by_its_end_only_if_it_reaches_the_limit(
    weights: Weights, discs: Floats, goal: tuple[float, float]
) -> None:
    plans, states = random_plans(), np.empty((STEPS + 1, STATE))
    around = scene(discs)._replace(goal_x=goal[0], goal_y=goal[1])
    given = model_of(JACKAL), outline_of(JACKAL.footprint), weights, around
    costs, dropped = np.empty((1, BLOCKS, LANES)), np.empty((BLOCKS, LANES))
    prices(*given, START, DT, plans, states, np.array([math.inf]), costs)
    arguments = Problem(*given, DT), START, plans, states
    not_worth_pricing(*arguments, np.nextafter(costs[0], math.inf), dropped)
    assert not dropped.any()
    not_worth_pricing(*arguments, np.full_like(costs[0], costs.min() + 4.0), dropped)
    assert 0.0 < dropped.mean() < 1.0
