"""Cheapest paths over a grid of costs, compared with a plain Dijkstra."""

import math

import numpy as np
import pytest

from gigabrain_zenoh.navigation.grid_search import GridSearch
from tests.unit.navigation.grids import cheapest

OPEN = np.ones((9, 9), np.float32)


def random_costs(seed: int, shape: tuple[int, int] = (31, 23)) -> np.ndarray:
    """Return random costs; a third of the cells are lethal, to different degrees."""
    rng = np.random.default_rng(seed)
    cost = rng.uniform(1, 13, shape)
    lethal = rng.random(shape) < 0.3
    cost[lethal] = 100 + rng.integers(0, 5, int(lethal.sum())) * 25
    return cost.astype(np.float32)


def spent(cost: np.ndarray, cells: np.ndarray) -> float:
    steps = np.hypot(*np.diff(cells, axis=0).T)
    on = cost[cells[:, 0], cells[:, 1]].astype(float)
    return float((steps * (on[1:] + on[:-1]) / 2).sum())


@pytest.mark.long
@pytest.mark.parametrize("seed", range(20))
def test_no_way_is_cheaper_on_random_grids(seed: int) -> None:
    cost, search = random_costs(seed), GridSearch()
    rng = np.random.default_rng(seed)
    for _ in range(10):
        start, goal = (tuple(int(v) for v in rng.integers(0, cost.shape)) for _ in range(2))
        best = cheapest(cost, start).get(goal)
        cells = search.path(cost, start, goal)
        if best is None:
            assert cells is None
        else:
            assert cells is not None
            assert tuple(cells[0]) == start
            assert tuple(cells[-1]) == goal
            assert np.abs(np.diff(cells, axis=0)).max(initial=0) <= 1
            assert spent(cost, cells) == pytest.approx(best, rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_the_field_from_a_cell_equals_dijkstras(seed: int) -> None:
    cost = random_costs(seed)
    field = GridSearch().field(cost, (15, 11), "from")
    expected = np.full(cost.shape, np.inf)
    for cell, value in cheapest(cost, (15, 11)).items():
        expected[cell] = value
    np.testing.assert_allclose(field, expected, rtol=1e-9)


def test_the_field_to_a_cell_is_the_cost_of_the_path_from_each() -> None:
    cost, search = random_costs(3, (12, 10)), GridSearch()
    goal = (5, 5)
    cost[goal] = 1.0
    field = search.field(cost, goal, "to")
    for row in range(12):
        for column in range(10):
            best = cheapest(cost, (row, column)).get(goal, math.inf)
            assert field[row, column] == pytest.approx(best, rel=1e-9)


def test_a_free_path_has_straight_and_diagonal_steps() -> None:
    cells = GridSearch().path(OPEN, (0, 0), (2, 5))
    assert cells is not None
    assert spent(OPEN, cells) == pytest.approx(3 + 2 * 1.4142135623730951)


def test_corners_are_not_cut() -> None:
    cost = OPEN.copy()
    cost[4, :4] = cost[5, 5:] = 200.0  # the walls touch at a corner, between (4, 3) and (5, 5)
    cells = GridSearch().path(cost, (3, 3), (5, 4))
    assert cells is not None
    assert spent(cost, cells) == 3.0  # one aside, two on: 1 + sqrt(2) would pass the corner


def test_a_diagonal_gap_is_no_gap() -> None:
    cost = OPEN.copy()
    cost[4, :5] = cost[5, 5:] = 200.0
    assert GridSearch().path(cost, (0, 0), (8, 8)) is None


def test_a_door_of_one_cell_is_found() -> None:
    cost = OPEN.copy()
    cost[4] = 200.0
    cost[4, 7] = 1.0
    cells = GridSearch().path(cost, (0, 0), (8, 0))
    assert cells is not None
    assert [4, 7] in cells.tolist()


def test_lethal_cells_may_be_left_but_not_entered() -> None:
    cost = OPEN.copy()
    cost[:3] = np.array([200.0, 150.0, 120.0], np.float32)[:, np.newaxis]
    out = GridSearch().path(cost, (0, 4), (8, 4))
    assert out is not None
    assert out[:, 0].tolist() == [0, 1, 2, 3, 4, 5, 6, 7, 8]
    assert GridSearch().path(cost, (8, 4), (2, 4)) is None


def test_lethal_cells_are_not_left_through_more_expensive_ones() -> None:
    cost = OPEN.copy()
    cost[3:6] = np.array([150.0, 180.0, 150.0], np.float32)[:, np.newaxis]
    cost[:3] = 200.0
    assert GridSearch().path(cost, (3, 4), (8, 4)) is None


@pytest.mark.parametrize("seed", range(5))
def test_bounds_never_exceed_the_cost_of_a_path_when_costs_change(seed: int) -> None:
    cost, rng, search = random_costs(seed, (60, 50)), np.random.default_rng(seed), GridSearch()
    for _ in range(30):
        row, column = (int(value) for value in rng.integers(0, 45, 2))
        cost[row : row + 6, column : column + 6] = rng.choice([1.0, 5.0, 150.0])
        start = (int(rng.integers(0, 60)), 3)
        cells = GridSearch().path(cost, start, (30, 45))
        if cells is not None:
            paid = spent(cost, cells)
            assert not search.costs_at_least(1.001 * paid, cost, start, (30, 45))
            assert search.costs_at_least(36.0, cost, start, (30, 45))


def test_the_same_memory_serves_many_searches_and_sizes() -> None:
    search = GridSearch()
    for size in (9, 30, 9, 12):
        cost = np.ones((size, size), np.float32)
        for _ in range(3):
            cells = search.path(cost, (0, 0), (size - 1, size - 1))
            assert cells is not None
            assert len(cells) == size


def test_a_path_to_its_own_start_is_one_cell() -> None:
    cells = GridSearch().path(OPEN, (4, 4), (4, 4))
    assert cells is not None
    assert cells.tolist() == [[4, 4]]


def test_the_entries_grow_when_they_run_out() -> None:
    cost, search = random_costs(7, (60, 60)), GridSearch()
    search.path(cost, (0, 0), (59, 59))
    search._memory = search._memory._replace(entries=np.empty((3, 16), np.int32))
    field = search.field(cost, (30, 30), "from")
    assert search._memory.entries.shape[1] > 16
    np.testing.assert_array_equal(field, GridSearch().field(cost, (30, 30), "from"))


@pytest.mark.slow
def test_marks_are_reset_before_they_overflow() -> None:
    search, cost = GridSearch(), np.ones((20, 30))
    expected = search.path(cost, (1, 1), (15, 22))
    search._run_number = np.iinfo(np.int32).max // 32 - 3  # 6.7e7 searches later
    for _ in range(6):
        path = search.path(cost, (1, 1), (15, 22))
        assert path is not None
        assert np.array_equal(path, expected)
    assert search._run_number < 10
