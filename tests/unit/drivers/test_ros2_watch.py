"""Odometry of a ROS 2 robot: faults are named, and the pose never jumps."""

import math

import numpy as np
import pytest

from gigabrain_drivers.bodies.ros2.watch import SETTLE_NS, OdometrySample, OdometryWatch
from gigabrain_schemas.base import Velocity

MS = 1_000_000
PERIOD_NS = 50 * MS


class Robot:
    """Drives at 0.2 m/s and reports at 20 Hz."""

    def __init__(self) -> None:
        self.watch = OdometryWatch("odom", 20.0, 0.2, 2.6)
        self.now_ns, self.x, self.yaw = 0, 0.0, 0.0
        self.stamp_ns = 1_700_000_000_000 * MS

    def report(self, times: int = 1, **velocity: float) -> None:
        for _ in range(times):
            self.now_ns += PERIOD_NS
            self.stamp_ns += PERIOD_NS
            self.x += 0.01
            moves = Velocity(**({"linear_x": 0.2} | velocity))
            pose = np.array((self.x, 0.0, self.yaw))
            self.watch.add(OdometrySample(self.stamp_ns, pose, moves), self.now_ns)

    @property
    def problem(self) -> str:
        return self.watch.problem(self.now_ns)


@pytest.fixture
def robot() -> Robot:
    robot = Robot()
    robot.report(4)
    return robot


def test_good_odometry_has_no_problem(robot: Robot) -> None:
    assert robot.problem == ""
    assert robot.watch.pose.x == pytest.approx(0.04)
    assert robot.watch.velocity.linear_x == 0.2


def test_no_message_yet_is_a_problem() -> None:
    assert Robot().problem == "odom: no message yet"


def test_silence_is_a_problem_after_two_and_a_half_periods(robot: Robot) -> None:
    robot.now_ns += 125 * MS
    assert robot.problem == ""
    robot.now_ns += MS
    assert robot.problem == "odom: no message for 126 ms"
    robot.report()
    assert robot.problem == ""


@pytest.mark.parametrize("field", ["linear_x", "angular_z"])
def test_nan_is_a_problem_until_odometry_was_valid_for_a_while(robot: Robot, field: str) -> None:
    robot.report(**{field: math.nan})
    assert "NaN" in robot.problem
    assert robot.watch.velocity.linear_x == 0.2
    robot.report(5)
    assert "NaN" in robot.problem
    robot.report(2)
    assert robot.problem == ""
    assert robot.watch.errors == 1


def test_stamps_that_go_back_are_a_problem(robot: Robot) -> None:
    robot.stamp_ns -= 5_000 * MS
    robot.report()
    assert "stamps went back by 4.95 s" in robot.problem
    robot.report(7)
    assert robot.problem == ""


def test_stamps_that_go_back_a_little_are_accepted(robot: Robot) -> None:
    robot.stamp_ns -= 60 * MS
    robot.report()
    assert robot.problem == ""


def test_a_constantly_repeated_message_is_a_problem(robot: Robot) -> None:
    for _ in range(5):
        robot.stamp_ns -= PERIOD_NS
        robot.report()
    assert "stand still" in robot.problem


def test_after_a_restart_of_the_robot_the_pose_continues_without_a_jump(robot: Robot) -> None:
    robot.report(100)
    before = robot.watch.pose.x
    assert before == pytest.approx(1.04)
    robot.x = 0.0
    robot.report()
    assert "jumped by 1.03 m" in robot.problem
    assert robot.watch.pose.x == before
    robot.report(SETTLE_NS // PERIOD_NS)
    assert robot.problem == ""
    assert robot.watch.pose.x == pytest.approx(before + 0.06)


def test_a_body_that_is_pushed_or_late_has_not_jumped(robot: Robot) -> None:
    robot.x += 0.08
    robot.report()
    assert robot.problem == ""
    robot.now_ns += 950 * MS
    robot.stamp_ns += 950 * MS
    robot.x += 0.3
    robot.report()
    assert robot.problem == ""


def test_an_impossible_turn_rate_is_replaced_by_that_of_the_poses(robot: Robot) -> None:
    robot.yaw = math.pi - 0.01
    robot.report(20)
    robot.yaw = -math.pi + 0.04  # 0.05 rad more
    robot.report(angular_z=-124.7)
    assert robot.watch.velocity.angular_z == pytest.approx(1.0)
    assert robot.watch.velocity.linear_x == 0.2


def test_with_a_new_transport_old_messages_do_not_count(robot: Robot) -> None:
    robot.watch.restart()
    assert robot.problem == "odom: no message yet"
    robot.report()
    assert robot.problem == ""


@pytest.mark.parametrize("new_transport", [False, True])
def test_a_restart_within_reach_of_the_gap_does_not_jump_either(
    robot: Robot, new_transport: bool
) -> None:
    robot.report(46)
    before = robot.watch.pose.x
    assert before == pytest.approx(0.5)
    robot.now_ns += 2_000 * MS
    robot.stamp_ns += 2_000 * MS
    robot.x = -0.01
    if new_transport:
        robot.watch.restart()
    robot.report()
    assert robot.watch.pose.x == before
    assert "jumped by 0.50 m" in robot.problem
    robot.report(SETTLE_NS // PERIOD_NS)
    assert robot.problem == ""
    assert robot.watch.pose.x == pytest.approx(before + 0.06)


def test_a_body_that_comes_back_during_a_gap_has_not_jumped(robot: Robot) -> None:
    robot.report(46)
    robot.now_ns += 2_000 * MS
    robot.stamp_ns += 2_000 * MS
    robot.x = 0.1
    robot.report()
    assert robot.problem == ""
    assert robot.watch.pose.x == pytest.approx(0.11)
