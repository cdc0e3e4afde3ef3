"""Costs of cells for a body: footprint, unknown space, extra obstacles, maps that change."""

import tracemalloc

import msgspec
import numpy as np
import pytest

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.kernels.images import squared_distance
from gigabrain_zenoh.navigation.costmap import (
    Inflation,
    Unknown,
    costmap,
    inflation,
)
from tests.unit.navigation.grids import drawn, empty, grid_of

RULES = Inflation(fits=0.25, turns=0.45)


def body(half_width: float, ahead: float, behind: float) -> BodyDescription:
    return BodyDescription(
        robot_type="tried",
        drive_type="differential",
        footprint=(
            (ahead, half_width),
            (-behind, half_width),
            (-behind, -half_width),
            (ahead, -half_width),
        ),
        max_linear_speed=1.0,
        max_angular_speed=1.0,
    )


def wall() -> np.ndarray:
    cells = empty(4.0, 2.0)
    cells[:, 0] = 100
    return cells


def test_distances_are_exact_up_to_the_cap() -> None:
    rng = np.random.default_rng(2)
    cells = np.where(rng.random((40, 50)) < 0.02, 100, 0).astype(np.int8)
    rows, columns = np.nonzero(cells)
    y, x = np.mgrid[:40, :50]
    exact = ((y[..., None] - rows) ** 2 + (x[..., None] - columns) ** 2).min(axis=-1)
    np.testing.assert_array_equal(squared_distance(cells, 9), np.minimum(exact, 81))
    np.testing.assert_array_equal(
        squared_distance(np.zeros((3, 4), np.int8), 5), np.full((3, 4), 25)
    )


def test_the_body_fits_from_its_half_width_on_and_cost_falls_from_there() -> None:
    cost = costmap(grid_of(wall()), RULES).cost[10]
    # the wall's cell ends 0.05 m from its centre: clear by 0.05, 0.15, 0.25, 0.35 m
    assert cost[:6] == pytest.approx([200, 180, 140, 13.0, 1 + 12 * np.exp(-0.5), 1 + 12 / np.e])
    assert (np.diff(cost) <= 0).all()
    assert cost[-1] == 1.0


def test_cells_from_fifty_percent_on_are_obstacles() -> None:
    cells = empty(4.0, 2.0)
    cells[10, 10], cells[10, 30] = 50, 49
    cost = costmap(grid_of(cells), RULES).cost
    assert cost[10, 10] == 200.0
    assert cost[10, 30] == 1.0


def test_a_long_body_fits_by_its_width_and_turns_by_its_length() -> None:
    rules = inflation(body(half_width=0.2, ahead=0.9, behind=0.3))
    margin = 0.03
    assert rules.fits == pytest.approx(0.2 + margin)
    assert rules.turns == pytest.approx(0.9219544 + margin)
    short = inflation(body(half_width=0.2, ahead=0.2, behind=0.2))
    cells = wall()
    long_cost, short_cost = (costmap(grid_of(cells), one).cost[10] for one in (rules, short))
    assert (long_cost >= 100).sum() == (short_cost >= 100).sum() == 3
    assert long_cost[8] > 2 * short_cost[8]  # it keeps farther off where there is room


def test_a_body_beside_its_own_centre_needs_its_wider_side() -> None:
    aside = msgspec.structs.replace(
        body(0.2, 0.2, 0.2), footprint=((0.2, 0.1), (-0.2, 0.1), (-0.2, -0.3), (0.2, -0.3))
    )
    assert inflation(aside).fits == pytest.approx(0.33)


def test_a_body_that_can_go_sideways_fits_by_its_shorter_side_and_a_car_does_not() -> None:
    wide = msgspec.structs.replace(body(0.3, 0.12, 0.12), max_lateral_speed=0.5)
    omni = msgspec.structs.replace(wide, drive_type="omni")
    car = msgspec.structs.replace(wide, drive_type="ackermann")
    assert inflation(omni).fits == pytest.approx(0.12 + 0.03)
    assert inflation(car).fits == pytest.approx(0.3 + 0.03)


@pytest.mark.parametrize(
    ("unknown", "expected"), [("allow", 1.0), ("avoid", 5.0), ("forbid", 100.0)]
)
def test_unknown_space_costs_what_the_policy_says(unknown: Unknown, expected: float) -> None:
    cells = drawn("??....", times=10)
    rules = Inflation(fits=0.25, turns=0.45, unknown=unknown)
    cost = costmap(grid_of(cells), rules).cost
    assert cost[5, 5] == expected
    assert cost[5, 40] == 1.0


def test_additional_points_are_obstacles() -> None:
    grid, points = grid_of(empty(4.0, 2.0)), np.array([[1.05, 1.05], [9.0, 1.0], [-0.01, 1.0]])
    made = costmap(grid, RULES, points)
    assert made.cost[10, 10] == 200.0
    assert (made.cells == 100).sum() == 1
    assert (costmap(grid, RULES).cost == 1.0).all()


@pytest.mark.parametrize("seed", range(8))
def test_a_partial_update_equals_a_full_computation(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.choice(np.array([0, 0, 0, 0, 0, 0, 0, 0, 0, 100, -1], np.int8), (150, 200))
    before = costmap(grid_of(cells), RULES)
    row, column = rng.integers(0, 140), rng.integers(0, 190)
    cells[row : row + 7, column : column + 5] = rng.choice(np.array([0, 100, -1]), (1,))
    grid = grid_of(cells)
    kept = before.cost.copy()
    np.testing.assert_array_equal(
        costmap(grid, RULES, None, before).cost, costmap(grid, RULES).cost
    )
    np.testing.assert_array_equal(before.cost, kept)


def test_reused_costs_are_updated_in_place() -> None:
    cells = empty(8.0, 8.0)
    before = costmap(grid_of(cells), RULES)
    cells[10, 20] = 100
    after = costmap(grid_of(cells), RULES, None, before, reuse=True)
    assert after.cost is before.cost
    np.testing.assert_array_equal(after.cost, costmap(grid_of(cells), RULES).cost)


def test_an_unchanged_map_has_the_same_costs() -> None:
    grid = grid_of(wall())
    before = costmap(grid, RULES)
    assert costmap(grid, RULES, None, before).cost is before.cost


def test_a_map_that_has_grown_or_moved_is_computed_again() -> None:
    before = costmap(grid_of(wall()), RULES)
    grown = grid_of(np.pad(wall(), 5, constant_values=-1))
    moved = msgspec.structs.replace(grid_of(wall()), origin_x=1.0)
    for grid in (grown, moved):
        after = costmap(grid, RULES, None, before)
        np.testing.assert_array_equal(after.cost, costmap(grid, RULES).cost)
        assert after.origin_x == grid.origin_x


def test_places_and_cells() -> None:
    made = costmap(msgspec.structs.replace(grid_of(wall()), origin_x=-1.0, origin_y=2.0), RULES)
    assert made.cell(-0.95, 2.05) == (0, 0)
    assert made.cell(2.99, 3.99) == (19, 39)
    assert made.cell(3.0, 3.0) is None
    assert made.cell(-1.01, 3.0) is None
    assert made.cell(float("nan"), 3.0) is None
    assert made.cell(float("inf"), 3.0) is None
    assert made.points(np.array([0]), np.array([39])) == pytest.approx(np.array([[2.95, 2.05]]))


def test_an_empty_map_has_no_cells() -> None:
    made = costmap(grid_of(np.zeros((0, 0), np.int8)), RULES)
    assert made.cell(0.0, 0.0) is None


def test_a_large_body_in_tiny_cells_needs_bounded_memory() -> None:
    grid = grid_of(empty(0.06, 0.06, 0.001), 0.001)
    tracemalloc.start()
    try:
        costmap(grid, inflation(body(10.0, 10.0, 10.0)), np.array([(0.03, 0.03)]))
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 64_000_000
