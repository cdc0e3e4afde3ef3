"""The behaviour avoid: its twists, reasons, expected trajectories and progress."""

import math
from dataclasses import replace

import pytest

from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.decision.behaviours import Inputs
from gigabrain_zenoh.decision.behaviours.avoid import Avoid, AvoidConfig, expected_trajectory
from gigabrain_zenoh.errors import UnknownName

CONFIG = AvoidConfig()


def free(*sectors: float | None) -> WorldModel:
    return WorldModel(scan_ok=True, obstacle_ahead=False, sectors=sectors)


def blocked(distance: float | None, *sectors: float | None) -> WorldModel:
    return WorldModel(scan_ok=True, obstacle_ahead=True, distance_ahead=distance, sectors=sectors)


def at(world: WorldModel | None, x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Inputs:
    return Inputs(world=world, pose=Pose(x=x, y=y, yaw=yaw))


def test_it_drives_straight_while_nothing_is_ahead() -> None:
    intent = Avoid(CONFIG).step(at(free()))[0]
    assert intent.twist == Velocity(linear_x=0.2)
    assert (intent.behaviour, intent.reason) == ("avoid", "forward 0.20 m/s")


def test_it_turns_right_on_the_spot_while_something_is_ahead() -> None:
    avoid = Avoid(CONFIG)
    intent = avoid.step(at(blocked(0.83)))[0]
    assert intent.twist == Velocity(angular_z=-0.5)
    assert intent.reason == "turning right: obstacle 0.83 m ahead"
    assert avoid.step(at(free()))[0].twist == Velocity(linear_x=0.2)


def test_an_obstacle_at_an_unknown_distance_is_named_without_one() -> None:
    assert Avoid(CONFIG).step(at(blocked(None)))[0].reason == "turning right: obstacle"


def test_it_rests_with_a_reason_while_the_battery_is_nearly_empty() -> None:
    avoid = Avoid(CONFIG)
    for world in (free(), blocked(0.5), None):
        intent = avoid.step(replace(at(world), must_charge=True))[0]
        assert intent.twist == Velocity()
        assert intent.reason == "resting: the battery is nearly empty; charge it"
    assert avoid.step(at(free()))[0].twist == Velocity(linear_x=0.2)


def test_speeds_come_from_the_deployment_file() -> None:
    slow = Avoid(AvoidConfig(max_linear_speed=0.15, max_angular_speed=0.3, turn="left"))
    assert slow.step(at(free()))[0].twist == Velocity(linear_x=0.15)
    intent = slow.step(at(blocked(0.5)))[0]
    assert intent.twist == Velocity(angular_z=0.3)
    assert intent.reason == "turning left: obstacle 0.50 m ahead"


LEFT_CLEAR = (0.8, 3.0, 3.0, 1.0, 1.0, 1.0)  # counter-clockwise: ahead, two left, behind, two right


@pytest.mark.parametrize(
    ("sectors", "reason"),
    [
        (LEFT_CLEAR, "turning left"),
        ((0.8, 1.0, 1.0, 1.0, 3.0, 3.0), "turning right"),
        ((0.8, 1.0, 1.0, 3.0, 1.0, 1.0), "turning right"),  # no difference: the default
        ((0.8, None, 1.0, 1.0, 2.0, 1.0), "turning left"),  # nothing in sight is clearer
        ((0.8, None, None, 1.0, 2.5, 3.4), "turning right"),  # beyond 2.5 m all is open
        ((0.8, 1.0, 2.0, 1.0, 1.0), "turning left"),  # an odd number has no sector behind
        ((), "turning right"),
    ],
)
def test_turning_to_the_clearer_side(sectors: tuple[float | None, ...], reason: str) -> None:
    intent = Avoid(AvoidConfig(turn="clearer")).step(at(blocked(0.8, *sectors)))[0]
    assert intent.reason.startswith(reason)


def test_a_turn_in_progress_keeps_its_side() -> None:
    avoid = Avoid(AvoidConfig(turn="clearer"))
    avoid.step(at(blocked(0.8, *LEFT_CLEAR)))[0]
    later = avoid.step(at(blocked(0.9, 0.9, 1.0, 1.0, 1.0, 3.0, 3.0), yaw=0.4))[0]
    assert later.reason == "turning left: obstacle 0.90 m ahead"


def test_it_waits_while_perception_is_silent_or_blind() -> None:
    avoid = Avoid(CONFIG)
    avoid.step(at(free()))[0]
    silent = avoid.step(at(None))[0]
    unsure = WorldModel(
        scan_ok=False, scan_problem="the lidar sees nothing at all", obstacle_ahead=True
    )
    blind = avoid.step(at(unsure))[0]
    for intent, reason in (
        (silent, "waiting: perception is silent"),
        (blind, "waiting: the lidar sees nothing at all"),
    ):
        assert intent == Intent(twist=Velocity(), behaviour="avoid", reason=reason)


def test_the_expected_trajectory_of_a_straight_leg_is_a_line() -> None:
    points = Avoid(CONFIG).step(at(free()))[0].trajectory
    assert [point.t for point in points] == [0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0]
    assert [point.x for point in points] == pytest.approx(
        [0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4]
    )
    assert {(point.y, point.yaw) for point in points} == {(0.0, 0.0)}


def test_the_expected_trajectory_of_a_turn_stays_on_the_spot() -> None:
    points = Avoid(CONFIG).step(at(blocked(0.8)))[0].trajectory
    assert {(point.x, point.y) for point in points} == {(0.0, 0.0)}
    assert points[-1].yaw == pytest.approx(-1.0)


def test_the_expected_trajectory_of_a_bend_is_an_arc_of_radius_v_over_w() -> None:
    points = expected_trajectory(Velocity(linear_x=0.2, angular_z=0.5))
    for point in points:
        from_centre = (point.x, point.y - 0.4)  # 0.2 / 0.5 = 0.4 m to the left
        assert math.hypot(*from_centre) == pytest.approx(0.4)
        assert math.atan2(from_centre[0], -from_centre[1]) == pytest.approx(point.yaw)
    assert points[-1].yaw == pytest.approx(1.0)
    nearly_straight = expected_trajectory(Velocity(linear_x=0.2, angular_z=1e-7))[-1]
    assert nearly_straight.x == pytest.approx(0.4)
    assert nearly_straight.y == 0.0


def test_progress_of_a_leg_is_the_driven_share_of_the_free_distance() -> None:
    avoid = Avoid(CONFIG)
    at_x = [avoid.step(at(free(2.0), x=x))[0].progress for x in (0.0, 0.5, 1.0, 2.0, 3.0)]
    assert at_x == [0.0, 0.25, 0.5, 1.0, 1.0]


def test_a_leg_without_obstacles_in_sight_is_expected_to_be_2_5_m_long() -> None:
    for world in (free(), free(None, 1.0, 1.0, 1.0)):
        avoid = Avoid(CONFIG)
        avoid.step(at(world))[0]
        assert avoid.step(at(world, y=1.25))[0].progress == pytest.approx(0.5)


def test_progress_of_a_turn_is_a_share_of_a_right_angle() -> None:
    avoid = Avoid(CONFIG)
    yaws = [0.0, -math.pi / 4, -math.pi / 2, -3.0, 3.0, 0.0]  # a full turn, through ±pi
    found = [avoid.step(at(blocked(0.8), yaw=yaw))[0].progress for yaw in yaws]
    assert found == [0.0, pytest.approx(0.5), 1.0, 1.0, 1.0, 1.0]


def test_progress_never_decreases_within_a_step_and_restarts_with_the_next() -> None:
    avoid = Avoid(CONFIG)
    pushed = [avoid.step(at(free(1.0), x=x))[0].progress for x in (0.0, 0.5, 0.4, 0.6)]
    assert pushed == [0.0, 0.5, 0.5, pytest.approx(0.6)]
    assert avoid.step(at(blocked(0.8), x=0.6))[0].progress == 0.0
    assert avoid.step(at(free(1.0), x=0.6))[0].progress == 0.0


def test_an_unknown_behaviour_suggests_a_similar_name() -> None:
    with pytest.raises(UnknownName, match=r"no behaviour 'aviod'; did you mean 'avoid'\? known"):
        behaviours.load("aviod")
    assert behaviours.load("avoid") is Avoid
