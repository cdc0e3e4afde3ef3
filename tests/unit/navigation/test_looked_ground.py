"""Unseen ground costs like a nearby obstacle until a camera has looked at it."""

import dataclasses
import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.navigator import close_up
from gigabrain_zenoh.geometry.sweep import depth, edges
from gigabrain_zenoh.navigation.footprint import MAX_DISTANCE_M, DistanceGrid
from gigabrain_zenoh.navigation.local_costmap import CELL_M, Pose2D
from gigabrain_zenoh.navigation.local_planner import LOOKING, LocalPlan, PlanRequest
from gigabrain_zenoh.navigation.looked_ground import MARGIN_M, LookedGround, floor_in_view
from tests.unit.navigation.drives import OMNI, WAFFLE, Drive

FRONT = Camera(
    name="front", width=320, height=240, rate_hz=10, field_of_view=1.047, depth=True, x=0.064,
    z=0.094,
)  # fmt: skip
BODY = replace(WAFFLE, cameras=(FRONT,), body_height=0.17)
SIDE = 200
HERE = Pose2D(0.0, 0.0, 0.0)
CORNER_M = -SIDE / 2 * CELL_M


def open_ground(x: float = CORNER_M, y: float = CORNER_M) -> DistanceGrid:
    return DistanceGrid(np.full((SIDE, SIDE), MAX_DISTANCE_M, np.float32), CELL_M, x, y)


def at(grid: DistanceGrid, x: float, y: float) -> float:
    return float(grid.distance[int((y - grid.y) / CELL_M), int((x - grid.x) / CELL_M)])


def looked(
    ground: LookedGround, place: Pose2D = HERE, outlines: tuple[Floats, ...] = ()
) -> DistanceGrid:
    return ground.limited(open_ground(), place, ("front",), outlines)


def test_without_a_trusted_camera_no_ground_costs_more() -> None:
    ground = LookedGround(BODY, SIDE)
    for names in ((), ("rear",)):
        assert ground.limited(open_ground(), HERE, names, ()).distance.min() == MAX_DISTANCE_M
    assert (
        LookedGround(WAFFLE, SIDE).limited(open_ground(), HERE, ("front",), ()).distance.min()
        == MAX_DISTANCE_M
    )


def test_the_body_may_turn_at_its_start() -> None:
    grid = looked(LookedGround(BODY, SIDE))
    for bearing in np.linspace(-math.pi, math.pi, 24):
        assert at(grid, 0.25 * math.cos(bearing), 0.25 * math.sin(bearing)) >= 0.1


def test_ground_beside_and_behind_is_costly_until_it_has_been_in_view() -> None:
    ground = LookedGround(BODY, SIDE)
    grid = looked(ground)
    assert at(grid, 0.45, 0.0) > 0.1
    assert at(grid, 0.0, 0.45) == at(grid, -0.45, 0.0) == pytest.approx(MARGIN_M)
    grid = looked(ground, Pose2D(0.0, 0.0, math.pi / 2))
    assert at(grid, 0.0, 0.45) > 0.1
    assert at(grid, -0.45, 0.0) == pytest.approx(MARGIN_M)
    assert at(looked(ground), 0.0, 0.45) > 0.1  # still seen


def test_ground_far_from_the_body_is_free() -> None:
    grid = looked(LookedGround(BODY, SIDE))
    assert at(grid, 0.0, 1.0) > 0.3
    assert at(grid, -1.0, 0.0) > 0.3


def test_an_outline_hides_the_ground_behind_it() -> None:
    box = np.array([(0.36, -0.1), (0.42, -0.1), (0.42, 0.1), (0.36, 0.1)])
    ground = LookedGround(BODY, SIDE)
    assert at(looked(ground, HERE, (box,)), 0.48, 0.0) == pytest.approx(MARGIN_M, abs=CELL_M)
    assert at(looked(ground), 0.48, 0.0) > 0.1


def test_ground_on_which_the_body_stood_is_seen() -> None:
    ground = LookedGround(BODY, SIDE)
    for x in np.arange(0.0, 1.01, 0.1):
        grid = looked(ground, Pose2D(x, 0.0, 0.0))
    assert at(grid, 0.5, 0.0) > 0.1
    assert at(grid, 0.6, 0.12) > 0.1


def test_the_window_moves_without_forgetting() -> None:
    ground = LookedGround(BODY, SIDE)
    looked(ground)
    moved = open_ground(CORNER_M + 8 * CELL_M, CORNER_M - 4 * CELL_M)
    grid = ground.limited(moved, HERE, (), ())
    assert at(grid, 0.45, 0.0) > 0.1
    assert at(grid, 0.0, 0.45) == pytest.approx(MARGIN_M)
    far = ground.limited(open_ground(50.0, 50.0), Pose2D(52.0, 52.0, 0.0), (), ())
    assert at(far, 52.4, 52.0) == pytest.approx(MARGIN_M)


def test_a_camera_sees_the_floor_from_where_its_lowest_row_meets_it() -> None:
    near, far, half = floor_in_view(FRONT)
    assert (near, far) == (0.25, 1.5)
    assert half == pytest.approx(math.radians(30.0 - 1.5), abs=0.01)
    near, far, _ = floor_in_view(replace(FRONT, z=0.5))
    assert near == pytest.approx(0.5 / math.tan(math.radians(23.4)), rel=0.01)
    near, far, _ = floor_in_view(replace(FRONT, z=0.5, pitch=math.radians(40.0)))
    assert near == pytest.approx(0.5 / math.tan(math.radians(63.4)), rel=0.01)
    assert far == pytest.approx(1.5, abs=0.1)
    assert floor_in_view(replace(FRONT, pitch=-1.0))[0] == math.inf


def deepest_in_unknown(names: tuple[str, ...], goal: Goal) -> float:
    """Drive to a goal, and return how deep the body entered unseen ground [m].

    It is negative if the body kept away.
    """

    class SeeingDrive(Drive):
        def request(self) -> PlanRequest:
            return dataclasses.replace(super().request(), cameras=names)

    drive, axis = SeeingDrive(BODY, goal, np.empty((0, 2))), np.arange(-1.5, 1.5, 0.03)
    cells = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    known, deepest, counted = np.hypot(*cells.T) < 0.353, -1.0, 0
    while not drive.go(0.1).arrived:
        assert drive.tick < 2000
        for pose in drive.poses[counted:]:
            cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
            here = (cells - (pose.x, pose.y)) @ np.array(((cosine, -sine), (sine, cosine)))
            inside, ahead = -depth(edges(BODY.footprint), here), here[:, 0] - FRONT.x
            deepest = max(deepest, float(inside[~known].max()))
            in_view = (ahead >= 0.25) & (np.abs(here[:, 1]) <= math.tan(0.52) * ahead)
            known |= (in_view & (ahead < 1.5)) | (inside >= 0)
        counted = len(drive.poses)
    return deepest


@pytest.mark.long
def test_it_keeps_away_from_ground_that_was_never_in_view() -> None:
    goal = Goal(x=1.2, y=0.9)
    assert deepest_in_unknown((), goal) > 0.0
    assert deepest_in_unknown(("front",), goal) < 0.0


@pytest.mark.long
@pytest.mark.parametrize("begins", [(-1.0, 0.3, 2.0), (-0.4, -0.9, -1.5), (-0.9, -0.2, 0.1)])
def test_a_strafing_body_reaches_an_object_at_any_heading(
    begins: tuple[float, float, float],
) -> None:
    body = load_robot("lekiwi").description()
    can = np.array([(0.265 + 0.0345 * math.cos(a), 0.0345 * math.sin(a)) for a in range(7)])

    class SeeingDrive(Drive):
        def request(self) -> PlanRequest:
            seen = dataclasses.replace(super().request(), cameras=("front",), contours=(can,))
            return close_up(seen, body)

    drive = SeeingDrive(body, Goal(x=0.0, y=0.0, yaw=0.0), np.empty((0, 2)))
    x, y, yaw = begins
    drive.pose = Pose(x=x, y=y, yaw=yaw)
    assert drive.go(20.0).arrived


def with_gap(wide: float) -> LookedGround:
    """Return seen ground with an unseen gap 0.2 m ahead."""
    ground = LookedGround(BODY, SIDE)
    looked(ground)
    ground._looked[:] = 1
    rows = slice(SIDE // 2 - 12, SIDE // 2 + 12)
    begin = SIDE // 2 + round(0.2 / CELL_M)
    ground._looked[rows, begin : begin + round(wide / CELL_M)] = 0
    return ground


@pytest.mark.parametrize(("wide", "filled"), [(0.1, True), (0.2, False)])
def test_a_narrow_gap_is_filled_and_a_wide_one_stays(wide: float, filled: bool) -> None:
    ground, place = with_gap(wide), (0.2 + wide / 2, 0.0)
    assert at(ground.limited(open_ground(), HERE, (), ()), *place) == pytest.approx(MARGIN_M)
    ground.fill_gaps(Pose2D(2.0, 2.0, 0.0))
    assert at(ground.limited(open_ground(), HERE, (), ()), *place) == pytest.approx(MARGIN_M)
    ground.fill_gaps(HERE)
    found = at(ground.limited(open_ground(), HERE, (), ()), *place)
    assert found == MAX_DISTANCE_M if filled else found == pytest.approx(MARGIN_M)


class StandingDrive(Drive):
    """A body that does not move."""

    def request(self) -> PlanRequest:
        return dataclasses.replace(super().request(), pose=Pose(x=0.0, y=0.0, yaw=0.0))


def plan_after(
    seconds: float, goal: Goal, *, body: BodyDescription = BODY, gap: float = 0.2
) -> LocalPlan:
    """Return the plan of a body that stands for `seconds` in front of an unseen gap."""
    drive = StandingDrive(body, goal, np.empty((0, 2)))
    drive.planner._ground = with_gap(gap)
    return drive.go(seconds)


def test_a_stuck_body_turns_to_look_at_the_ground_ahead() -> None:
    aside = Goal(x=0.5, y=0.5)
    assert plan_after(1.9, aside).reason != LOOKING
    plan = plan_after(2.3, aside)
    assert plan.reason == LOOKING
    assert plan.trajectory[-1].yaw > 0.5
    assert max(abs(point.x) for point in plan.trajectory) < 0.1


def test_it_backs_off_from_ground_that_is_too_near_to_be_in_view() -> None:
    plan = plan_after(2.3, Goal(x=1.2, y=0.0))
    assert plan.reason == LOOKING
    assert plan.trajectory[-1].x < -0.1


@pytest.mark.long
def test_it_looks_for_a_few_seconds_and_at_unseen_ground_only() -> None:
    assert plan_after(8.3, Goal(x=1.2, y=0.0)).reason != LOOKING
    assert plan_after(14.3, Goal(x=1.2, y=0.0)).reason == LOOKING  # and again
    assert plan_after(2.3, Goal(x=1.2, y=0.0), gap=0.0).reason != LOOKING


def test_a_body_larger_than_its_window_has_no_unseen_ground_beyond_it() -> None:
    ground = LookedGround(BODY, 8)  # 0.2 m to each side
    ground.look(HERE, ("front",), (), -4 * CELL_M, -4 * CELL_M)
    assert not any(ground.is_unseen_ahead(HERE, turn, 0.15) for turn in np.linspace(-3, 3, 7))


def test_a_strafing_body_need_not_look() -> None:
    assert (
        plan_after(2.3, Goal(x=1.2, y=0.0), body=replace(OMNI, cameras=(FRONT,))).reason != LOOKING
    )


def test_a_stuck_body_fills_the_gap_ahead() -> None:
    drive = StandingDrive(BODY, Goal(x=1.2, y=0.0), np.empty((0, 2)))
    ground = drive.planner._ground = with_gap(0.1)
    unseen = int((ground._looked == 0).sum())
    drive.go(4.9)
    assert (ground._looked == 0).sum() == unseen
    drive.go(0.4)
    assert (ground._looked == 0).sum() == 0
