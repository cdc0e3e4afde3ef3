"""The local planner drives a body with delay and lag, on a simulated clock."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import ActuationModel, Obstacle
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.navigation.local_planner import LocalPlanner, PlanRequest, SentCommand
from tests.unit.navigation.drives import CAR, OMNI, QUICK, WAFFLE, Drive, wall

NO_POINTS = np.empty((0, 2))
LATE = ActuationModel(delay=0.1, lag=0.15)
TRIKE = replace(CAR, drive_type="differential", robot_type="trike")
DOOR = np.concatenate(
    [wall((0.8, 0.225), (0.8, 1.5)), wall((0.8, -0.225), (0.8, -1.5))]
)  # 45 cm wide, for a body of 31 cm


@pytest.mark.long
def test_a_goal_is_reached_with_its_yaw() -> None:
    drive = Drive(WAFFLE, Goal(x=0.8, y=0.4, yaw=-1.0), NO_POINTS, response=LATE)
    assert drive.go(20.0).arrived
    assert math.hypot(drive.pose.x - 0.8, drive.pose.y - 0.4) < 0.12
    assert abs(drive.pose.yaw + 1.0) < 0.15
    assert drive.plans[-1].twist == Velocity()


@pytest.mark.parametrize("body", [WAFFLE, TRIKE, OMNI])
@pytest.mark.parametrize("yaw", [-0.4, 3.0])
def test_a_body_at_the_goal_with_the_wrong_yaw_turns_at_once(
    body: BodyDescription, yaw: float
) -> None:
    drive = Drive(body, Goal(x=0.0, y=0.05, yaw=yaw), NO_POINTS, response=LATE)
    assert drive.go(6.0).arrived
    assert abs(math.remainder(drive.pose.yaw - yaw, math.tau)) < 0.13
    assert math.hypot(drive.pose.x, drive.pose.y - 0.05) < 0.13
    assert "turning in place: at the goal" in {plan.reason for plan in drive.plans}


def test_a_body_at_a_goal_without_yaw_stops_turning() -> None:
    request = PlanRequest(
        tick=1,
        pose=Pose(x=0.05, y=0.0, yaw=2.0),
        velocity=Velocity(angular_z=0.8),
        goal=Goal(x=0.0, y=0.0),
        hits=wall((0.3, -0.5), (0.3, 0.5)),
    )
    plan = LocalPlanner(WAFFLE).plan(request)
    assert (plan.twist, plan.reason, plan.arrived) == (Velocity(), "waiting: at the goal", False)


def test_an_omnidirectional_body_goes_sideways_through_a_gap_too_narrow_for_its_front() -> None:
    gap = np.concatenate([wall((0.2, 0.9), (1.6, 0.9)), wall((-0.2, 0.9), (-1.6, 0.9))])
    drive = Drive(OMNI, Goal(x=0.0, y=1.8, yaw=0.0), gap, response=LATE)
    assert drive.go(12.0).arrived
    assert drive.least > 0.0
    assert max(plan.twist.linear_y for plan in drive.plans) > 0.4
    assert max(abs(pose.yaw) for pose in drive.poses if 0.6 < pose.y < 1.2) < 0.5
    assert math.hypot(drive.pose.x, drive.pose.y - 1.8) < 0.13
    assert abs(drive.pose.yaw) < 0.13


def test_a_narrow_door_is_passed() -> None:
    drive = Drive(WAFFLE, Goal(x=1.6, y=0.0), DOOR, response=LATE)
    assert drive.go(25.0).arrived
    assert drive.least > 0.0


@pytest.mark.parametrize("may_back", [True, False])
def test_a_body_that_may_not_reverse_plans_no_reversing(may_back: bool) -> None:
    planner = LocalPlanner(WAFFLE)
    ahead = wall((0.35, -0.5), (0.35, 0.5))
    request = PlanRequest(
        tick=1,
        pose=Pose(x=0.0, y=0.0, yaw=0.0),
        velocity=Velocity(),
        goal=Goal(x=-0.6, y=0.0, yaw=0.0),
        hits=ahead,
        response=LATE,
        may_back=may_back,
    )
    plan = planner.plan(request)
    backwards = [point.linear_x for point in plan.trajectory if point.linear_x < -0.02]
    assert bool(backwards) == may_back


def test_a_dead_end_is_left_in_reverse_or_by_turning() -> None:
    pocket = np.concatenate(
        [wall((0.3, -0.26), (0.3, 0.26)), wall((-0.5, 0.26), (0.3, 0.26)),
         wall((-0.5, -0.26), (0.3, -0.26))]
    )  # fmt: skip
    drive = Drive(WAFFLE, Goal(x=-1.2, y=0.0), pocket, response=LATE)
    drive.go(25.0)
    assert drive.poses[-1].x < -0.8
    assert drive.least > 0.0
    assert "backing out" in {plan.kind for plan in drive.plans}


def test_a_body_with_a_goal_far_behind_turns_round() -> None:
    drive = Drive(WAFFLE, Goal(x=-2.0, y=0.0), NO_POINTS, response=LATE)
    assert drive.go(15.0).arrived
    assert min(pose.x for pose in drive.poses if abs(pose.yaw) < 1.5) > -0.5


@pytest.mark.parametrize("speed", [0.3, 0.6])
def test_the_body_avoids_a_disc_that_comes_head_on(speed: float) -> None:
    def someone(now: float) -> tuple[Obstacle, ...]:
        return (Obstacle(id=1, x=2.5 - speed * now, y=0.05, velocity_x=-speed, radius=0.25),)

    drive = Drive(TRIKE, Goal(x=3.0, y=0.0), NO_POINTS, response=LATE, someone=someone)
    drive.go(20.0)
    assert drive.least > 0.0
    assert math.hypot(drive.pose.x - 3.0, drive.pose.y) < 0.15
    said = {plan.reason.partition(":")[0] for plan in drive.plans}
    assert said & {"going round", "waiting", "backing out"}
    assert any("a moving obstacle" in plan.reason for plan in drive.plans)


def test_an_enclosed_body_reports_that_it_is_blocked() -> None:
    cell = np.concatenate(
        [wall((0.4, -0.4), (0.4, 0.4)), wall((-0.5, -0.4), (-0.5, 0.4)),
         wall((-0.5, 0.4), (0.4, 0.4)), wall((-0.5, -0.4), (0.4, -0.4))]
    )  # fmt: skip
    drive = Drive(WAFFLE, Goal(x=2.0, y=0.0), cell)
    plan = drive.go(14.0)
    assert plan.blocked
    assert not plan.arrived
    assert drive.least > 0.0


def test_a_car_never_turns_on_the_spot() -> None:
    drive = Drive(CAR, Goal(x=-1.5, y=0.5), NO_POINTS, response=LATE)
    drive.go(15.0)
    assert math.hypot(drive.pose.x + 1.5, drive.pose.y - 0.5) < 0.2
    for plan in drive.plans:
        assert abs(plan.twist.angular_z) <= abs(plan.twist.linear_x) / 0.5 + 1e-9


def test_a_delayed_body_follows_its_expected_trajectory() -> None:
    drive = Drive(TRIKE, Goal(x=4.0, y=0.0), NO_POINTS, response=LATE)
    drive.go(1.0)
    request, start = drive.request(), drive.pose
    plan = drive.planner.plan(request)
    # 0.1 s later; earlier commands alone decide the motion until then
    for _ in range(5):
        drive._tick(Velocity(linear_x=-9.9))
    dx, dy = drive.pose.x - start.x, drive.pose.y - start.y
    ahead = math.cos(start.yaw) * dx + math.sin(start.yaw) * dy
    expected = next(p for p in plan.trajectory if p.t == pytest.approx(0.1))
    assert ahead == pytest.approx(expected.x, abs=1e-4)
    assert drive.velocity.linear_x == pytest.approx(expected.linear_x, abs=1e-3)
    assert drive.velocity.angular_z == pytest.approx(expected.angular_z, abs=1e-3)


def test_the_same_requests_get_the_same_plans() -> None:
    runs = []
    for _ in range(2):
        drive = Drive(WAFFLE, Goal(x=1.6, y=0.0), DOOR)
        drive.go(2.0)
        runs.append([(plan.twist, plan.reason) for plan in drive.plans])
    assert runs[0] == runs[1]


@pytest.mark.parametrize(
    "goal", [Goal(x=math.nan, y=0.0), Goal(x=0.0, y=math.inf), Goal(x=0.0, y=0.0, yaw=math.nan)]
)
def test_a_goal_that_is_not_finite_is_refused(goal: Goal) -> None:
    planner = LocalPlanner(WAFFLE, QUICK)
    request = PlanRequest(
        tick=1, pose=Pose(x=0.0, y=0.0, yaw=0.0), velocity=Velocity(), goal=goal, hits=NO_POINTS,
        sent=(SentCommand(0, Velocity()),),
    )  # fmt: skip
    with pytest.raises(ValueError, match="a goal has finite numbers"):
        planner.plan(request)
