"""Paths of a car: it turns no tighter than it can, fits everywhere, and reverses."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.car_planner import CarPlanner, rest_of
from gigabrain_zenoh.navigation.costmap import Costmap, costmap, inflation
from gigabrain_zenoh.navigation.global_planner import Path, Unreachable
from gigabrain_zenoh.navigation.path_planner import PathPlanner

CAR = BodyDescription(
    robot_type="car",
    drive_type="ackermann",
    footprint=((0.34, 0.125), (-0.08, 0.125), (-0.08, -0.125), (0.34, -0.125)),
    max_linear_speed=0.45,
    max_angular_speed=1.0,
    min_turning_radius=0.45,
)
CELL = 0.05
Wall = tuple[float, float, float, float]  # x from, to; y from, to [m]


def world(width: float, height: float, *walls: Wall) -> Costmap:
    """Return a walled rectangle from (0, 0) with `walls` in it."""
    cells = np.zeros((round(height / CELL), round(width / CELL)), np.int8)
    cells[[0, -1]] = 100
    cells[:, [0, -1]] = 100
    for left, right, low, high in walls:
        cells[round(low / CELL) : round(high / CELL), round(left / CELL) : round(right / CELL)] = (
            100
        )
    grid = OccupancyGrid(
        resolution=CELL, width=cells.shape[1], height=cells.shape[0], origin_x=0.0, origin_y=0.0,
        cells=cells.tobytes(),
    )  # fmt: skip
    return costmap(grid, inflation(CAR))


def path_of(costs: Costmap, start: Pose, goal: Goal) -> Path:
    found = CarPlanner().plan(costs, CAR, start, goal)
    assert isinstance(found, Path), found
    assert found.headings is not None
    return found


def assert_drivable(path: Path, costs: Costmap) -> None:
    """Check curvatures, and the whole footprint against each cell, without the planner."""
    assert path.headings is not None
    yaw, direction = path.headings.T
    steps, turns = np.diff(path.points, axis=0), np.diff(np.unwrap(yaw))
    lengths = np.hypot(*steps.T)
    assert (np.abs(turns) <= lengths / CAR.turning_radius + 1e-6).all()
    middle = yaw[:-1] + turns / 2
    ahead = steps[:, 0] * np.cos(middle) + steps[:, 1] * np.sin(middle)
    aside = steps[:, 1] * np.cos(middle) - steps[:, 0] * np.sin(middle)
    assert (ahead * direction[1:] >= -1e-6).all()
    assert np.abs(aside).max() < 1e-3
    rows, columns = np.nonzero(costs.cells >= 50)
    filled = costs.points(rows, columns)
    for (x, y), heading in zip(path.points, yaw, strict=True):
        dx, dy = filled[:, 0] - x, filled[:, 1] - y
        along = math.cos(heading) * dx + math.sin(heading) * dy
        across = math.cos(heading) * dy - math.sin(heading) * dx
        assert not ((along > -0.08) & (along < 0.34) & (np.abs(across) < 0.125)).any()


def switches(path: Path) -> int:
    assert path.headings is not None
    return int((np.diff(path.headings[:, 1]) != 0).sum())


@pytest.mark.parametrize("yaw", [0.0, 1.5, 3.1, -2.0])
def test_it_ends_at_the_goal_with_the_heading(yaw: float) -> None:
    costs = world(5.0, 5.0)
    path = path_of(costs, Pose(x=1.0, y=1.0, yaw=0.0), Goal(x=3.0, y=3.5, yaw=yaw))
    assert_drivable(path, costs)
    assert path.headings is not None
    assert path.points[-1] == pytest.approx((3.0, 3.5), abs=1e-6)
    assert math.remainder(path.headings[-1, 0] - yaw, math.tau) == pytest.approx(0.0, abs=1e-6)


def test_without_obstacles_it_drives_straight() -> None:
    path = path_of(world(6.0, 4.0), Pose(x=1.0, y=2.0, yaw=0.0), Goal(x=5.0, y=2.0))
    assert path.remaining[0] == pytest.approx(4.0, abs=0.05)
    assert switches(path) == 0


def test_a_goal_close_behind_is_reached_in_reverse() -> None:
    path = path_of(world(6.0, 4.0), Pose(x=3.0, y=2.0, yaw=0.0), Goal(x=2.2, y=2.0, yaw=0.0))
    assert path.remaining[0] == pytest.approx(0.8, abs=0.05)
    assert path.headings is not None
    assert (path.headings[:, 1] == -1.0).all()


def test_it_turns_round_in_a_dead_end() -> None:
    """A lane of 1.3 m that ends: too narrow for half a circle of 0.9 m and the body."""
    lane = world(5.0, 1.4)
    path = path_of(lane, Pose(x=4.0, y=0.7, yaw=0.0), Goal(x=1.0, y=0.7, yaw=math.pi))
    assert_drivable(path, lane)
    assert switches(path) >= 1


def test_it_reverses_out_of_a_lane_in_which_it_cannot_turn() -> None:
    """A lane of 0.6 m opens into a hall, in which the car turns."""
    costs = world(6.0, 4.0, (3.0, 6.0, 0.0, 1.7), (3.0, 6.0, 2.3, 4.0))
    path = path_of(costs, Pose(x=5.2, y=2.0, yaw=0.0), Goal(x=1.0, y=2.0, yaw=math.pi))
    assert_drivable(path, costs)
    assert path.headings is not None
    in_lane = path.points[:, 0] > 3.4
    assert (path.headings[in_lane, 1] == -1.0).all()


def test_unreachable_goals_are_refused_with_the_reason() -> None:
    costs = world(5.0, 5.0, (2.5, 2.6, 0.0, 5.0))
    planner = PathPlanner()
    here = Pose(x=1.0, y=1.0, yaw=0.0)
    for goal, fault in (
        (Goal(x=4.0, y=4.0, yaw=0.0), "no path leads to the goal"),
        (Goal(x=2.2, y=2.5, yaw=0.0), "the goal is too close to an obstacle for this heading"),
        (Goal(x=9.0, y=4.0), "the goal is outside the map"),
    ):
        found = planner.plan(costs, CAR, here, goal)
        assert isinstance(found, Unreachable)
        assert found.fault == fault


def test_a_path_is_kept_while_the_car_is_on_it() -> None:
    costs, planner, goal = world(5.0, 5.0), CarPlanner(), Goal(x=4.0, y=3.5, yaw=1.5)
    path = planner.plan(costs, CAR, Pose(x=1.0, y=1.0, yaw=0.0), goal)
    assert isinstance(path, Path)
    assert path.headings is not None
    half = len(path.points) // 2
    (x, y), (yaw, _) = path.points[half].tolist(), path.headings[half].tolist()
    rest = planner.replan(costs, CAR, Pose(x=x + 0.03, y=y, yaw=yaw), goal, path)
    assert isinstance(rest, Path)
    assert rest.remaining[0] == pytest.approx(path.remaining[half], abs=0.1)
    assert rest.points[-1] == pytest.approx(path.points[-1])
    strayed = planner.replan(costs, CAR, Pose(x=x, y=y + 0.5, yaw=yaw), goal, path)
    assert isinstance(strayed, Path)
    assert strayed.points[0] == pytest.approx((x, y + 0.5))


def test_a_car_that_has_missed_the_end_of_its_path_gets_a_new_one() -> None:
    costs = world(5.0, 5.0)
    path = path_of(costs, Pose(x=1.0, y=1.0, yaw=0.0), Goal(x=3.0, y=1.0, yaw=0.0))
    assert rest_of(path, Pose(x=3.0, y=1.02, yaw=0.0), 0.45) is not None
    assert rest_of(path, Pose(x=3.0, y=1.12, yaw=0.0), 0.45) is None


def test_a_slower_car_turns_no_tighter() -> None:
    slower = replace(CAR, max_linear_speed=0.2)
    assert slower.turning_radius == CAR.turning_radius
    assert replace(CAR, min_turning_radius=0.0, max_angular_speed=0.9).turning_radius == 0.5
