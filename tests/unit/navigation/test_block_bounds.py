"""Bounds of the cost to a goal: never above the cost, and close to it."""

import numpy as np
import pytest

from gigabrain_zenoh.navigation.block_bounds import (
    block_bounds,
    bound_after_changes,
    bound_at,
    towards,
)
from gigabrain_zenoh.navigation.grid_search import GridSearch
from tests.unit.navigation.grids import Cell


def bounds_of(cost: np.ndarray, start: Cell, goal: Cell) -> np.ndarray:
    bound = towards(goal, start, cost, block_bounds(cost.shape))
    return np.array([bound_at(bound, cost, *cell) for cell in np.ndindex(cost.shape)]).reshape(
        cost.shape
    )


def rooms(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Return patches of random cost, some lethal, with noise in single cells."""
    rng = np.random.default_rng(seed)
    cost = rng.uniform(1, 6, shape)
    for _ in range(12):
        row, column = (int(rng.integers(0, side)) for side in shape)
        height, width = rng.integers(2, 12, 2)
        cost[row : row + height, column : column + width] = rng.choice([1, 3, 13, 150])
    return cost.astype(np.float32)


@pytest.mark.parametrize("shape", [(40, 33), (1, 30), (37, 4), (32, 32)])
@pytest.mark.parametrize("seed", range(4))
def test_no_path_costs_less_than_its_bound(seed: int, shape: tuple[int, int]) -> None:
    cost, rng = rooms(seed, shape), np.random.default_rng(seed)
    for _ in range(4):
        start, goal = (tuple(int(rng.integers(0, side)) for side in shape) for _ in range(2))
        cheapest = GridSearch().field(cost, goal, "to")
        assert (bounds_of(cost, start, goal) <= cheapest).all()


@pytest.mark.parametrize("seed", range(8))
def test_the_bound_falls_by_at_most_the_cost_of_a_step(seed: int) -> None:
    cost = rooms(seed, (40, 33))
    bounds = bounds_of(cost, (2, 3), (35, 28))
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        rows, columns = np.mgrid[0 : 40 - down, max(-right, 0) : 33 - max(right, 0)]
        one, other = (rows, columns), (rows + down, columns + right)
        step = np.hypot(down, right) * (cost[one].astype(float) + cost[other]) / 2
        assert (np.abs(bounds[one] - bounds[other]) <= step * (1 + 1e-5)).all()


def test_the_bound_is_tight_around_a_wall() -> None:
    cost = np.ones((80, 80), np.float32)
    cost[30:40, :70] = 200.0
    cheapest = GridSearch().field(cost, (10, 10), "to")
    bound = bounds_of(cost, (70, 10), (10, 10))[70, 10]
    assert 0.9 * cheapest[70, 10] < bound <= cheapest[70, 10]


@pytest.mark.parametrize("seed", range(6))
def test_no_path_costs_less_than_its_bound_after_changes(seed: int) -> None:
    cost, rng, goal = rooms(seed, (60, 50)), np.random.default_rng(seed), (55, 40)
    bound = towards(goal, (5, 5), cost, block_bounds(cost.shape))
    for _ in range(20):
        row, column = (int(value) for value in rng.integers(0, 45, 2))
        cost[row : row + 5, column : column + 5] = rng.choice([1.0, 2.0, 150.0])
        cheapest = GridSearch().field(cost, goal, "to")
        for start in ((5, 5), (20, 10), (40, 45)):
            assert bound_after_changes(bound, cost, start) <= cheapest[start]


def test_a_cheaper_block_far_aside_does_not_change_the_bound() -> None:
    cost = np.full((100, 100), 2.0, np.float32)
    bound = towards((10, 90), (10, 10), cost, block_bounds(cost.shape))
    before = bound_after_changes(bound, cost, (10, 10))
    cost[90:, 50:60] = 1.0
    assert bound_after_changes(bound, cost, (10, 10)) == before > 150
    cost[10, 50:60] = 1.0  # as cheap as the bound assumes for the straight line to there
    assert 100 < bound_after_changes(bound, cost, (10, 10)) < 120
