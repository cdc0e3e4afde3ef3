"""Parts of the local planner, each compared with an independent result."""

import itertools
import math
import threading

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription
from gigabrain_zenoh.kernels.jit import NONE
from gigabrain_zenoh.navigation.cost_to_go import CostToGo
from gigabrain_zenoh.navigation.footprint import (
    DistanceGrid,
    Outline,
    Placement,
    clearance_of,
    free_ahead,
    middle_of,
    outline_of,
)
from gigabrain_zenoh.navigation.local_costmap import Chamfer, LocalCostmap, Pose2D, fill_disc
from gigabrain_zenoh.navigation.motion_model import (
    LANES,
    InitialState,
    delayed_model,
    feasible,
    first_order_lag,
    lagged_step,
    make_feasible,
    model_of,
)
from gigabrain_zenoh.navigation.mppi import mean_past_commands
from tests.unit.navigation.drives import CAR, OMNI, WAFFLE, wall

NO_DISCS = np.empty((0, 6))
NO_POINTS = np.empty((0, 2))


def clearance(grid: DistanceGrid, outline: Outline, at: Placement) -> float:
    return clearance_of(grid, outline, at, middle_of(grid, outline, at), int(NONE))[0]


@pytest.mark.long
def test_a_car_turns_no_more_tightly_than_at_full_speed_and_lock() -> None:
    model = model_of(CAR)
    assert model.radius == 0.5
    assert feasible(model, (0.0, 0.0, 0.0), (0.0, 0.0, 2.0), 0.1) == (0.0, 0.0, 0.0)
    vx, _, w = feasible(model, (0.4, 0.0, 0.0), (0.4, 0.0, 2.0), 1.0)
    assert (vx, w) == (0.4, 0.8)


def test_commands_respect_the_acceleration_limits() -> None:
    model = model_of(WAFFLE)
    vx, vy, w = feasible(model, (0.0, 0.0, 0.0), (1.0, 1.0, 9.0), 0.1)
    assert (vx, vy, w) == pytest.approx((0.09, 0.0, 0.27))
    assert feasible(model, (0.1, 0.0, 0.0), (-1.0, 0.0, 0.0), 0.1)[0] == pytest.approx(0.01)
    assert feasible(model, (0.0, 0.0, 0.0), (-1.0, 0.0, 0.0), 9.0)[0] == -0.13


def test_planned_wheel_speeds_respect_their_limit() -> None:
    model = model_of(replace(WAFFLE, wheel_separation=0.28, max_rim_speed=0.26))
    vx, _, w = feasible(model, (0.0, 0.0, 0.0), (0.26, 0.0, 1.82), 9.0)
    assert vx + 0.14 * w == pytest.approx(0.26)
    assert w / vx == pytest.approx(7.0)
    assert feasible(model, (0.0, 0.0, 0.0), (0.26, 0.0, 0.0), 9.0) == (0.26, 0.0, 0.0)


def test_planned_slanted_speeds_respect_the_ellipse() -> None:
    still, plans = (0.0, 0.0, 0.0), np.full((2, 3, LANES), 0.6)
    lag = first_order_lag(0.0, 9.0)
    start = InitialState(*still, *still, still, np.zeros((1, 3)), 0.0, lag, 1.0)
    make_feasible(model_of(OMNI), start, 9.0, plans)
    assert np.hypot(plans[:, 0], plans[:, 1]) == pytest.approx(0.6)
    assert plans[:, 0] == pytest.approx(plans[:, 1])


def test_a_slower_speed_can_be_requested() -> None:
    assert model_of(WAFFLE, 0.1).forward == 0.1
    assert model_of(WAFFLE, 9.0).forward == 0.26


@pytest.mark.parametrize("late", [0.02, 0.1, 0.5])
def test_a_delayed_body_keeps_its_stopping_distance(late: float) -> None:
    model = model_of(WAFFLE)
    slow = delayed_model(model, late)

    def way(speed: float, reaction: float) -> float:
        return speed * reaction + speed**2 / (2 * 0.9)

    assert way(slow.forward, 0.22 + late) == pytest.approx(way(0.26, 0.22))
    assert slow.forward / model.forward == pytest.approx(slow.turning / model.turning)
    assert slow.forward < model.forward
    assert delayed_model(model, 0.0) is model


def test_a_lag_closes_the_gap_by_the_same_share_in_each_step() -> None:
    velocity, way = lagged_step(0.0, 1.0, first_order_lag(0.15, 0.05), 0.05)
    assert velocity == pytest.approx(0.2834687)
    assert way == pytest.approx(0.0074797, abs=1e-6)
    assert lagged_step(0.0, 1.0, first_order_lag(0.0, 0.05), 0.05) == (1.0, 0.05)


def test_past_commands_are_averaged_over_each_step() -> None:
    sent = np.array([(-0.10, 1.0, 0.0, 0.0), (-0.06, 2.0, 0.0, 0.5)])
    past, share = mean_past_commands(sent, (0.0, 0.0, 0.0), 0.12, 0.05)
    assert share == pytest.approx(0.4)
    # -0.15 to -0.10, -0.10 to -0.05, -0.05 to 0
    assert past[:, 0] == pytest.approx([0.0, 1.2, 2.0])
    assert past[:, 2] == pytest.approx([0.0, 0.1, 0.5])


def test_clearance_is_the_outlines_distance_to_the_nearest_obstacle() -> None:
    window = LocalCostmap(4.0, 10.0)
    random = np.random.default_rng(3)
    points = random.uniform(-1.5, 1.5, (25, 2))
    points = points[np.hypot(points[:, 0], points[:, 1]) > 0.5]
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), points)
    grid, outline = window.grid(1, NO_POINTS, NO_DISCS), outline_of(WAFFLE.footprint)
    for x, y, yaw in random.uniform((-0.3, -0.3, -3.0), (0.3, 0.3, 3.0), (50, 3)).tolist():
        got = clearance(grid, outline, Placement(x, y, math.cos(yaw), math.sin(yaw)))
        want = min(0.4, _exact(points, x, y, yaw))
        assert got == pytest.approx(want, abs=0.04)


def _exact(points: np.ndarray, x: float, y: float, yaw: float) -> float:
    """Return the clearance of the waffle's box."""
    off = points - (x, y)
    ahead = math.cos(yaw) * off[:, 0] + math.sin(yaw) * off[:, 1]
    aside = math.cos(yaw) * off[:, 1] - math.sin(yaw) * off[:, 0]
    out = np.hypot(
        np.maximum(np.maximum(-0.2 - ahead, ahead - 0.075), 0.0),
        np.maximum(np.abs(aside) - 0.155, 0.0),
    )
    return float(out.min())


def test_distances_equal_those_of_opencv_up_to_the_limit() -> None:
    random = np.random.default_rng(4)
    for share, side in itertools.product((1.0, 0.5, 0.01, 0.001, 0.0), (90, 64)):
        chamfer = Chamfer(side, 0.025, 0.8)
        free = (random.random((side, side)) >= share).astype(np.uint8)
        want = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5) * 0.025
        np.testing.assert_allclose(chamfer.distance(free), np.minimum(want, 0.8), atol=1e-5)


@pytest.mark.parametrize("body", [WAFFLE, CAR])
def test_skipped_points_of_the_outline_are_never_nearer(
    body: BodyDescription,
) -> None:
    random = np.random.default_rng(5)
    free = (random.random((120, 120)) > 0.003).astype(np.uint8)
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_5) * np.float32(0.025)
    grid, outline = DistanceGrid(distance, 0.025, -1.5, -1.5), outline_of(body.footprint)
    points = np.stack([outline.groups[:, :3].ravel(), outline.groups[:, 3:6].ravel()])
    group = 0
    for x, y, yaw in random.uniform((-1.0, -1.0, -3.0), (1.0, 1.0, 3.0), (2000, 3)).tolist():
        cosine, sine = math.cos(yaw), math.sin(yaw)
        placed = Placement(x, y, cosine, sine)
        near = middle_of(grid, outline, placed)
        room, group = clearance_of(grid, outline, placed, near, group)
        center = np.array([(outline.center_x,), (outline.center_y,)], dtype=np.float32)
        turn = np.array([(cosine, -sine), (sine, cosine)])
        at = turn @ np.hstack([points, center]) + np.array([(x + 1.5,), (y + 1.5,)])
        *around, middle = _bilinear(distance, at).tolist()
        inside = middle - outline.inner if middle < outline.inner else math.inf
        assert room == pytest.approx(min(0.4, *around, inside), abs=1e-5)


def _bilinear(distance: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Interpolate cells of 25 mm at points (2, n) [m] from their corner, limited to the grid."""
    v, u = np.clip(at[::-1] / 0.025 - 0.5, 0.0, np.array(distance.shape)[:, None] - 2.0)
    i, j = v.astype(int), u.astype(int)
    low = distance[i, j] + (u - j) * (distance[i, j + 1] - distance[i, j])
    high = distance[i + 1, j] + (u - j) * (distance[i + 1, j + 1] - distance[i + 1, j])
    return np.asarray(low + (v - i) * (high - low))


def test_an_obstacle_inside_the_body_leaves_no_clearance() -> None:
    distance = np.full((80, 80), 3.0, dtype=np.float32)
    distance[30:50, 30:50] = 0.0
    grid = DistanceGrid(distance, 0.025, -1.0, -1.0)
    assert clearance(grid, outline_of(WAFFLE.footprint), Placement(0.06, 0.0, 1.0, 0.0)) < 0.0


def test_the_free_distance_ahead_ends_at_a_wall() -> None:
    window = LocalCostmap(4.0, 10.0)
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), wall((0.9, -0.5), (0.9, 0.5)))
    grid, outline = window.grid(1, NO_POINTS, NO_DISCS), outline_of(WAFFLE.footprint)
    free = free_ahead(grid, outline, Placement(0.0, 0.0, 1.0, 0.0), 1.0, 0.03, 2.0)
    assert free == pytest.approx(0.8, abs=0.05)
    assert free_ahead(grid, outline, Placement(0.0, 0.0, 1.0, 0.0), -1.0, 0.03, 2.0) == 2.0


def test_a_moved_obstacle_leaves_no_marks() -> None:
    window, here = LocalCostmap(4.0, 10.0), Pose2D(0.0, 0.0, 0.0)
    behind = wall((1.5, -0.5), (1.5, 0.5))
    window.add_scan(1, here, (0.0, 0.0), np.array([(0.8, 0.0)]))
    assert window.grid(1, NO_POINTS, NO_DISCS).distance[80, 112] < 0.03
    window.add_scan(6, here, (0.0, 0.0), behind)
    assert window.grid(6, NO_POINTS, NO_DISCS).distance[80, 112] < 0.03  # one beam may be wrong
    window.add_scan(11, here, (0.0, 0.0), behind)
    assert window.grid(11, NO_POINTS, NO_DISCS).distance[80, 112] == pytest.approx(0.7, abs=0.03)


def test_marks_that_no_beam_can_check_expire() -> None:
    window, here = LocalCostmap(4.0, 1.0), Pose2D(0.0, 0.0, 0.0)
    window.add_scan(1, here, (0.0, 0.0), np.array([(-0.8, 0.0)]))
    window.add_scan(50, here, (0.0, 0.0), np.array([(0.8, 0.0)]))
    assert window.grid(50, NO_POINTS, NO_DISCS).distance[80, 48] < 0.03
    window.add_scan(52, here, (0.0, 0.0), np.array([(0.8, 0.0)]))
    assert window.grid(52, NO_POINTS, NO_DISCS).distance[80, 48] > 1.0


def test_the_window_moves_with_the_robot_and_keeps_its_marks() -> None:
    window = LocalCostmap(4.0, 10.0)
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), np.array([(1.0, 0.5)]))
    window.add_scan(2, Pose2D(0.5, 0.0, math.pi / 2), (0.0, 0.0), np.array([(0.0, 1.2)]))
    grid = window.grid(2, NO_POINTS, NO_DISCS)
    for x, y in ((1.0, 0.5), (-0.7, 0.0)):
        row, column = int((y - grid.y) / 0.025), int((x - grid.x) / 0.025)
        assert grid.distance[row, column] < 0.03


@pytest.mark.parametrize(("x", "y"), [(3.5, 0.0), (0.0, -3.5), (-2.5, 2.0), (9.0, 0.0)])
def test_marks_outside_the_window_are_forgotten(x: float, y: float) -> None:
    window, around = LocalCostmap(4.0, 10.0), np.random.default_rng(6).uniform(-1.9, 1.9, (200, 2))
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), around)
    there = _occupied(window.grid(1, NO_POINTS, NO_DISCS))
    window.add_scan(2, Pose2D(x, y, 0.0), (0.0, 0.0), NO_POINTS)
    kept = {(a, b) for a, b in there if abs(a - 40 * x) <= 80 and abs(b - 40 * y) <= 80}
    assert _occupied(window.grid(2, NO_POINTS, NO_DISCS)) == kept
    window.add_scan(3, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), NO_POINTS)
    assert _occupied(window.grid(3, NO_POINTS, NO_DISCS)) == kept < there


def _occupied(grid: DistanceGrid) -> set[tuple[float, float]]:
    """Return the middles of the occupied cells, in cells from the frame's origin."""
    rows, columns = np.nonzero(grid.distance == 0.0)
    x, y = round(grid.x / 0.025), round(grid.y / 0.025)
    return {
        (c + x + 0.5, r + y + 0.5) for r, c in zip(rows.tolist(), columns.tolist(), strict=True)
    }


def test_known_points_of_the_map_count_and_are_not_remembered() -> None:
    window = LocalCostmap(4.0, 10.0)
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), NO_POINTS)
    known = np.array([(0.5, 0.0), (99.0, 0.0)])
    assert window.grid(1, known, NO_DISCS).distance[80, 100] < 0.03
    assert window.grid(1, NO_POINTS, NO_DISCS).distance[80, 100] == 3.0


def test_a_post_that_seems_to_move_is_static_where_it_was_before() -> None:
    window, here = LocalCostmap(4.0, 10.0), Pose2D(0.0, 0.0, 0.0)
    claimed = np.array([(1.0, 0.0, 0.8, 0.0, 0.1, 0.1)])
    for tick in range(1, 32, 5):
        window.add_scan(tick, here, (0.0, 0.0), np.array([(0.95, 0.0)]))
    assert len(window.moving(31, claimed)) == 0
    window.add_scan(36, here, (0.0, 0.0), np.array([(1.05, 0.05)]))
    assert len(window.moving(36, claimed)) == 1


def test_the_way_to_the_goal_goes_round_a_wall() -> None:
    window = LocalCostmap(4.0, 10.0)
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), wall((0.8, -1.0), (0.8, 1.0)))
    grid = window.grid(1, NO_POINTS, NO_DISCS)
    field = CostToGo(window.cells).field(grid, 0.155, (1.6, 0.0), None)
    middle = field.distance.shape[0] // 2
    here = float(field.distance[middle, middle])
    assert here > 2.0 * math.hypot(0.8, 1.0)  # not through it
    assert field.distance[middle, middle + 32] == 0.0


def test_a_path_is_followed_to_where_it_leaves_the_window() -> None:
    window = LocalCostmap(4.0, 10.0)
    window.add_scan(1, Pose2D(0.0, 0.0, 0.0), (0.0, 0.0), NO_POINTS)
    grid = window.grid(1, NO_POINTS, NO_DISCS)
    path = np.array([(0.0, 0.1 * i) for i in range(60)])
    field = CostToGo(window.cells).field(grid, 0.155, (5.0, 5.0), path)
    row, column = np.unravel_index(int(np.argmin(field.distance)), field.distance.shape)
    assert (grid.x + (column + 0.5) * 0.05, grid.y + (row + 0.5) * 0.05) == pytest.approx(
        (0.0, 1.9), abs=0.06
    )


def test_the_free_distance_ahead_is_searched_within_the_window_only() -> None:
    window = LocalCostmap(4.0, 10.0)
    grid, outline = window.grid(1, NO_POINTS, NO_DISCS), outline_of(WAFFLE.footprint)
    found = list[float]()
    ways = (grid, outline, Placement(0.0, 0.0, 1.0, 0.0), 1.0, 0.03, 1e18)
    asking = threading.Thread(target=lambda: found.append(free_ahead(*ways)), daemon=True)
    asking.start()
    asking.join(60.0)  # it includes the compilation
    assert found == [1e18]


def test_the_outline_of_a_large_or_jagged_body_has_a_bounded_number_of_points() -> None:
    jagged = [((-10.0, 10.0)[n % 2], -10.0 + 0.3 * n) for n in range(63)]
    outline = outline_of((*jagged, (-10.0, 10.0)))
    assert 3 * len(outline.groups) < 600


def test_the_cost_to_a_goal_at_a_hundred_kilometres_is_limited() -> None:
    grid = LocalCostmap(4.0, 10.0).grid(1, NO_POINTS, NO_DISCS)
    field = CostToGo(160).field(grid, 0.15, (1e5, -1e5), None).distance
    assert 9_990.0 < field.min() <= field.max() <= 10_010.0


@pytest.mark.parametrize("row", [-20, -3, 0, 20, 39, 60])
@pytest.mark.parametrize("radius", [0, 1, 5, 30, 80])
def test_filled_discs_equal_those_of_opencv(row: int, radius: int) -> None:
    mine, theirs = np.zeros((40, 30), np.uint8), np.zeros((40, 30), np.uint8)
    fill_disc(mine, row, 7, radius)
    cv2.circle(theirs, (7, row), radius, 1, cv2.FILLED)
    np.testing.assert_array_equal(mine, theirs)
