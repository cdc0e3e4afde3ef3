"""Paths to goals: short, clear of walls, stable; and the reasons for unreachable goals."""

import math

import numpy as np
import pytest

from gigabrain_zenoh.navigation.costmap import NO_LANES, Costmap, Inflation, Unknown, costmap
from gigabrain_zenoh.navigation.global_planner import (
    GlobalPlanner,
    Path,
    Unreachable,
    is_valid,
    remaining_path,
)
from gigabrain_zenoh.navigation.grid_search import is_free
from tests.unit.navigation.grids import drawn, empty, grid_of

NAN, INF = float("nan"), float("inf")


def seen(cells: np.ndarray, unknown: Unknown = "avoid", fits: float = 0.15) -> Costmap:
    return costmap(grid_of(cells), Inflation(fits=fits, turns=fits + 0.1, unknown=unknown))


def path(made: Costmap, start: tuple[float, float], goal: tuple[float, float]) -> Path:
    found = GlobalPlanner().plan(made, start, goal)
    assert isinstance(found, Path), found
    return found


def refused(made: Costmap, start: tuple[float, float], goal: tuple[float, float]) -> Unreachable:
    found = GlobalPlanner().plan(made, start, goal)
    assert isinstance(found, Unreachable)
    return found


def rooms(door: int = 8) -> np.ndarray:
    """Two rooms of 3 x 3 m; in the wall between them, at x = 3.0 to 3.1 m, a door at the bottom."""
    cells = empty(6.1, 3.0)
    cells[:, 30] = 100
    cells[5 : 5 + door, 30] = 0
    return cells


def test_without_obstacles_the_path_is_straight() -> None:
    found = path(seen(empty(10, 10)), (0.52, 0.53), (8.31, 3.77))
    straight = math.hypot(8.31 - 0.52, 3.77 - 0.53)
    assert tuple(found.points[0]) == (0.52, 0.53)
    assert tuple(found.points[-1]) == (8.31, 3.77)
    assert found.remaining[0] == pytest.approx(straight)
    assert found.cost[0] == pytest.approx(straight)
    assert found.remaining[-1] == found.cost[-1] == 0.0
    steps = np.hypot(*np.diff(found.points, axis=0).T)
    assert steps.max() <= 0.1 + 1e-9
    assert (np.diff(found.remaining) < 0).all()


def test_the_path_leads_through_the_door_and_keeps_off_its_posts() -> None:
    made = seen(rooms())
    found = path(made, (0.5, 2.5), (5.5, 2.5))
    at_door = found.points[np.abs(found.points[:, 0] - 3.05).argmin()]
    assert 0.8 <= at_door[1] <= 1.0  # it is open from 0.5 to 1.3 m
    walls = made.points(*np.nonzero(made.cells == 100))
    gaps = np.hypot(*(found.points[:, None] - walls[None]).transpose(2, 0, 1)).min(axis=1)
    assert gaps.min() > 0.3


def test_a_smoothed_path_costs_no_more_than_its_cells() -> None:
    rng = np.random.default_rng(5)
    cells = np.where(rng.random((80, 80)) < 0.03, 100, 0)
    cells[:4, :4] = cells[-4:, -4:] = 0
    made, planner = seen(cells, fits=0.1), GlobalPlanner()
    found = planner.plan(made, (0.05, 0.05), (7.95, 7.95))
    assert isinstance(found, Path)
    field = planner.field(made, (7.95, 7.95))
    assert field is not None
    assert found.cost[0] <= field[0, 0] * (1 + 1e-6)
    assert is_valid(found, made)


@pytest.mark.parametrize(("door", "passes"), [(2, False), (3, True)])
def test_a_door_is_passed_if_the_body_fits(door: int, passes: bool) -> None:
    """It needs 0.15 m to each side, and the cells are 0.1 m."""
    found = GlobalPlanner().plan(seen(rooms(door)), (0.5, 2.5), (5.5, 2.5))
    assert isinstance(found, Path) is passes


@pytest.mark.parametrize(
    ("goal", "why"),
    [
        ((3.05, 2.05), "the goal is inside an obstacle"),
        ((2.95, 2.05), "the goal is too close to an obstacle: the body needs 0.15 m"),
        ((6.35, 2.05), "the goal is outside the map"),
        ((-0.25, 2.05), "the goal is outside the map"),
    ],
)
def test_a_goal_where_the_body_does_not_fit_is_refused_with_the_nearest_place(
    goal: tuple[float, float], why: str
) -> None:
    found = refused(seen(rooms()), (0.55, 2.05), goal)
    assert found.reason.startswith(why + "; nearest reachable point is ")
    assert found.nearest is not None
    assert found.distance == pytest.approx({3.05: 0.2, 2.95: 0.1, 6.35: 0.3, -0.25: 0.3}[goal[0]])
    assert isinstance(GlobalPlanner().plan(seen(rooms()), (0.55, 2.05), found.nearest), Path)


def test_the_refusal_has_a_text() -> None:
    found = refused(seen(rooms()), (5.55, 2.05), (3.05, 2.05))
    assert found.reason == (
        "the goal is inside an obstacle; nearest reachable point is 0.20 m away at (2.85, 2.05)"
    )


def test_without_a_path_the_nearest_point_is_on_this_side() -> None:
    found = refused(seen(rooms(door=0)), (0.55, 1.05), (4.05, 1.05))
    assert found.reason == (
        "no path leads to the goal; nearest reachable point is 1.20 m away at (2.85, 1.05)"
    )
    assert found.nearest == pytest.approx((2.85, 1.05))


@pytest.mark.parametrize("wrong", [NAN, INF, -INF])
def test_a_goal_that_is_not_a_number_is_refused(wrong: float) -> None:
    for start, goal in (
        ((1.0, 1.0), (wrong, 1.0)),
        ((1.0, 1.0), (1.0, wrong)),
        ((wrong, 1), (1, 1)),
    ):
        found = refused(seen(rooms()), start, goal)
        assert found == Unreachable(fault="the goal and the robot's place must be finite numbers")


def test_a_robot_outside_the_map_cannot_plan() -> None:
    assert refused(seen(rooms()), (-1.0, 1.0), (1.0, 1.0)).reason == "the robot is outside the map"


def test_an_enclosed_robot_gets_the_reason() -> None:
    cells = empty(3.0, 3.0)
    cells[14:17, 14:17] = 100
    cells[15, 15] = 0
    found = refused(seen(cells), (1.55, 1.55), (0.5, 0.5))
    assert found.reason == (
        "no path leads to the goal; the robot has no room to move from its place"
    )
    assert found.nearest is None


def test_a_robot_too_close_to_a_wall_plans_away_from_it() -> None:
    made = seen(rooms())
    found = path(made, (2.95, 2.05), (0.5, 2.05))
    assert tuple(found.points[0]) == (2.95, 2.05)
    assert (np.diff(found.points[:5, 0]) < 0).all()
    assert is_valid(found, made)


def test_a_robot_too_close_to_a_wall_does_not_plan_through_it() -> None:
    found = path(seen(rooms()), (2.95, 2.05), (5.5, 2.05))
    assert found.remaining[0] > 4.0


def test_unknown_space_is_crossed_avoided_or_forbidden() -> None:
    cells = drawn("....... ..???.. ..???.. ..???.. .......", times=10)
    start, goal = (0.55, 2.55), (6.45, 2.55)
    assert path(seen(cells, "allow"), start, goal).remaining[0] == pytest.approx(5.9)
    for policy in ("avoid", "forbid"):
        found = path(seen(cells, policy), start, goal)
        assert found.remaining[0] > 6.5
        assert all(cells[int(y * 10), int(x * 10)] == 0 for x, y in found.points)
    inside = (3.55, 2.55)
    assert path(seen(cells, "avoid"), start, inside).remaining[0] == pytest.approx(3.0)
    why = refused(seen(cells, "forbid"), start, inside).reason
    assert why.startswith("the goal is in unknown space, which is forbidden; nearest reachable")
    out = path(seen(cells, "forbid"), inside, start)  # by the shortest path out, then round
    assert 4.0 < out.remaining[0] < 5.5


def test_avoided_unknown_space_is_crossed_if_there_is_no_other_path() -> None:
    cells = drawn("..???..", times=10)
    assert path(seen(cells, "avoid"), (0.5, 0.5), (6.5, 0.5)).remaining[0] == pytest.approx(6.0)
    assert refused(seen(cells, "forbid"), (0.5, 0.5), (6.5, 0.5)).nearest == pytest.approx(
        (1.95, 0.55)
    )


def test_a_path_is_valid_until_an_obstacle_is_on_it() -> None:
    cells = rooms()
    found = path(seen(cells), (0.5, 2.5), (5.5, 2.5))
    assert is_valid(found, seen(cells))
    cells[5:13, 30] = 100
    assert not is_valid(found, seen(cells))


def test_a_path_whose_points_are_at_the_edges_of_cells_is_blocked_as_well() -> None:
    points = np.column_stack((np.arange(5.0, 56.0), np.full(51, 30.0)))
    cells = empty(6.0, 6.0)
    assert is_free(seen(cells).cost, points, NO_LANES)
    cells[28:33, 30:35] = 100
    assert not is_free(seen(cells).cost, points, NO_LANES)


def test_a_path_beyond_a_map_that_shrank_is_not_valid() -> None:
    found = path(seen(empty(5, 5)), (0.5, 0.5), (4.5, 4.5))
    assert not is_valid(found, seen(empty(3, 3)))


def test_of_two_equal_paths_the_present_one_is_kept() -> None:
    cells = empty(6.1, 6.1)
    cells[25:36, 25:36] = 100
    made, planner = seen(cells), GlobalPlanner()
    goal = (5.55, 3.05)
    right_round = path(made, (0.55, 3.05), goal)
    below = right_round.points[:, 1].min() < 2.5
    cells[30, 36] = 0  # a change beside both paths
    for shift in (0.1, -0.1, 0.2, -0.2):
        again = planner.replan(seen(cells), (0.75, 3.05 + shift), goal, right_round)
        assert isinstance(again, Path)
        assert (again.points[:, 1].min() < 2.5) is below
        assert tuple(again.points[0]) == (0.75, 3.05 + shift)


def test_the_robot_switches_to_a_much_better_path_only() -> None:
    cells = empty(6.1, 3.0)
    cells[:27, 30] = 100
    cells[0:5, 30] = 100
    start, goal = (0.55, 0.55), (5.55, 0.55)
    over = path(seen(cells, fits=0.1), start, goal)
    cells[5:12, 30] = 0
    opened = GlobalPlanner().replan(seen(cells, fits=0.1), start, goal, over)
    assert isinstance(opened, Path)
    assert opened.remaining[0] < 0.9 * over.remaining[0]
    cells[5:12, 30] = 100
    cells[21:26, 30] = 0  # not much lower
    kept = GlobalPlanner().replan(seen(cells, fits=0.1), start, goal, over)
    assert isinstance(kept, Path)
    np.testing.assert_allclose(kept.points[-20:], over.points[-20:])


def test_a_change_elsewhere_keeps_the_path_without_a_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cells, planner, goal = empty(18.0, 4.0), GlobalPlanner(), (17.55, 0.55)
    cells[12:30, 40] = 100
    old = path(seen(cells), (0.55, 0.55), goal)
    cells[32:35, 10:14] = 100
    monkeypatch.setattr(planner, "plan", None)
    kept = planner.replan(seen(cells), (1.05, 0.55), goal, old)
    assert isinstance(kept, Path)
    assert kept.remaining[0] == pytest.approx(16.5)


@pytest.mark.parametrize("seed", range(6))
def test_a_kept_path_is_the_one_that_a_search_would_keep(seed: int) -> None:
    rng, planner, goal = np.random.default_rng(seed), GlobalPlanner(), (7.55, 7.55)
    cells = empty(8.1, 8.1)
    old = path(seen(cells, fits=0.1), (0.55, 0.55), goal)
    for _ in range(25):
        row, column = rng.integers(10, 65, 2)
        height, width = rng.integers(1, 20, 2)
        cells[row : row + height, column : column + width] = rng.choice([0, 100])
        made = seen(cells, fits=0.1)
        found = GlobalPlanner().plan(made, (0.6, 0.6), goal)
        again = planner.replan(made, (0.6, 0.6), goal, old)
        rest = remaining_path(old, made, (0.6, 0.6))
        assert rest is not None
        cheaper = isinstance(found, Path) and found.cost[0] < 0.85 * rest.cost[0]
        expected = found if cheaper or not is_valid(rest, made) else rest
        if not isinstance(expected, Path):
            assert again == expected
            continue
        assert isinstance(again, Path)
        np.testing.assert_array_equal(again.points, expected.points)
        old = again


def test_a_blocked_long_path_gets_a_detour_without_a_full_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cells, planner, goal = empty(100.0, 6.0), GlobalPlanner(), (99.5, 3.0)
    old = path(seen(cells), (0.5, 3.0), goal)
    cells[28:33, 180:185] = 100
    best = path(seen(cells), (1.5, 3.0), goal)
    monkeypatch.setattr(planner, "plan", None)
    led = planner.replan(seen(cells), (1.5, 3.0), goal, old)
    assert isinstance(led, Path)
    assert is_valid(led, seen(cells))
    assert led.cost[0] < 1.02 * best.cost[0]
    np.testing.assert_allclose(led.points[led.points[:, 0] > 22.0, 1], 3.0)


def test_a_long_path_whose_corridor_is_closed_leads_elsewhere() -> None:
    cells, goal = empty(36.0, 8.0), (35.5, 2.0)
    cells[39:41, 20:340] = 100
    old = path(seen(cells), (0.5, 2.0), goal)
    assert old.points[:, 1].max() < 4.0
    cells[:40, 180] = 100
    led = GlobalPlanner().replan(seen(cells), (0.5, 2.0), goal, old)
    assert isinstance(led, Path)
    assert led.points[:, 1].max() > 4.0


@pytest.mark.parametrize("seed", range(4))
def test_a_path_with_a_detour_costs_little_more_than_the_cheapest(seed: int) -> None:
    rng, planner, goal = np.random.default_rng(seed), GlobalPlanner(), (35.5, 35.5)
    cells = empty(36.0, 36.0)
    for row, column in rng.integers(20, 330, (60, 2)):
        cells[row : row + 12, column : column + 12] = 100
    cells[:20, :20] = cells[-20:, -20:] = 0
    old, blocked = path(seen(cells), (0.5, 0.5), goal), 0
    for _ in range(12):
        x, y = old.points[rng.integers(40, len(old.points) - 40)]
        cells[int(y * 10) : int(y * 10) + 5, int(x * 10) : int(x * 10) + 5] = 100
        made = seen(cells)
        blocked += not is_valid(old, made)
        led, best = planner.replan(made, (0.5, 0.5), goal, old), path(made, (0.5, 0.5), goal)
        assert isinstance(led, Path)
        assert is_valid(led, made)
        assert tuple(led.points[0]) == (0.5, 0.5)
        assert tuple(led.points[-1]) == goal
        assert led.cost[0] <= best.cost[0] / 0.85
        old = led
    assert blocked >= 6


def test_a_robot_off_its_path_or_with_another_goal_gets_a_new_path() -> None:
    made = seen(empty(6, 6))
    old = path(made, (0.5, 0.5), (5.5, 0.5))
    assert remaining_path(old, made, (2.0, 1.2)) is None
    strayed = GlobalPlanner().replan(made, (2.0, 1.2), (5.5, 0.5), old)
    assert isinstance(strayed, Path)
    assert strayed.remaining[0] == pytest.approx(math.hypot(3.5, 0.7))
    other = GlobalPlanner().replan(made, (0.5, 0.5), (5.5, 5.5), old)
    assert isinstance(other, Path)
    assert tuple(other.points[-1]) == (5.5, 5.5)


def test_the_rest_of_a_path_begins_at_the_robot() -> None:
    made = seen(empty(6, 6))
    rest = remaining_path(path(made, (0.5, 0.5), (5.5, 0.5)), made, (3.02, 0.6))
    assert rest is not None
    assert tuple(rest.points[0]) == (3.02, 0.6)
    assert rest.remaining[0] == pytest.approx(2.5, abs=0.1)


def test_a_path_to_the_robots_own_place_ends_there() -> None:
    found = path(seen(empty(3, 3)), (1.0, 1.0), (1.0, 1.0))
    assert found.remaining[0] == found.cost[0] == 0.0


def test_the_same_request_has_the_same_path() -> None:
    made = seen(rooms())
    one, other = (path(made, (0.5, 2.5), (5.5, 2.5)) for _ in range(2))
    np.testing.assert_array_equal(one.points, other.points)


def test_the_cost_to_go_falls_along_the_path_and_is_inf_if_unreachable() -> None:
    cells = rooms()
    cells[20:25, 50:55] = 100
    cells[22, 52] = 0
    made, planner = seen(cells), GlobalPlanner()
    field = planner.field(made, (5.5, 0.5))
    assert field is not None
    found = path(made, (0.5, 2.5), (5.5, 0.5))
    along = [field[made.cell(x, y)] for x, y in found.points]
    assert (np.diff(along) <= 1e-9).all()
    assert field[22, 52] == np.inf
    assert planner.field(made, (9.0, 0.5)) is None
