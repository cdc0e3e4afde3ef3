"""Planar poses, and the history of odometry poses."""

import math

import pytest

from gigabrain_schemas.base import Pose
from gigabrain_zenoh.geometry.pose import PoseHistory, compose, inverse, relative
from gigabrain_zenoh.testing.samples import BOOT, state


def of(*poses: tuple[int, tuple[float, float, float]]) -> PoseHistory:
    history = PoseHistory()
    for tick, pose in poses:
        history = history.then(state(tick, pose=pose))
    return history


def parts(pose: Pose | None) -> tuple[float, float, float]:
    assert pose
    return pose.x, pose.y, pose.yaw


def test_a_pose_ahead_of_a_robot_that_faces_left_is_to_the_left() -> None:
    robot = Pose(x=1.0, y=2.0, yaw=math.pi / 2)
    found = compose(robot, Pose(x=3.0, y=1.0, yaw=3.0))
    assert parts(found) == pytest.approx((0.0, 5.0, 3.0 - 1.5 * math.pi))
    assert parts(relative(robot, found)) == pytest.approx((3.0, 1.0, 3.0))
    assert parts(compose(robot, inverse(robot))) == pytest.approx((0.0, 0.0, 0.0))


def test_each_state_is_found_by_its_tick() -> None:
    history = of((1, (0.0, 0.0, 0.0)), (2, (0.1, 0.0, 0.2)), (3, (0.2, 0.1, 0.4)))
    assert parts(history.at(BOOT, 2)) == (0.1, 0.0, 0.2)
    assert history.newest_tick == 3


def test_between_two_states_yaw_is_interpolated_in_the_shorter_direction() -> None:
    history = of((10, (1.0, 0.0, 3.1)), (14, (2.0, 4.0, -3.1)))
    x, y, yaw = parts(history.at(BOOT, 11))
    assert (x, y) == pytest.approx((1.25, 1.0))
    assert yaw == pytest.approx(3.1 + (2 * math.pi - 6.2) / 4)


@pytest.mark.parametrize("tick", [0, 9, 15, 1000])
def test_before_the_first_and_after_the_last_state_there_is_no_pose(tick: int) -> None:
    assert of((10, (0.0, 0.0, 0.0)), (14, (1.0, 0.0, 0.0))).at(BOOT, tick) is None


def test_over_a_long_gap_no_pose_is_interpolated() -> None:
    assert of((10, (0.0, 0.0, 0.0)), (21, (1.0, 0.0, 0.0))).at(BOOT, 15) is None


def test_a_restart_of_the_driver_clears_the_history() -> None:
    history = of((10, (5.0, 0.0, 0.0))).then(state(2, pose=(0.0, 0.0, 0.0), boot=8))
    assert history.at(BOOT, 10) is None
    assert history.at(BOOT, 2) is None
    assert parts(history.at(8, 2)) == (0.0, 0.0, 0.0)


def test_late_and_repeated_states_change_nothing() -> None:
    history = of((10, (1.0, 0.0, 0.0)))
    assert history.then(state(10, pose=(9.0, 0.0, 0.0))) == history
    assert history.then(state(9, pose=(9.0, 0.0, 0.0))) == history


def test_the_history_keeps_two_seconds() -> None:
    history = of(*((tick, (tick / 100, 0.0, 0.0)) for tick in range(1, 301)))
    assert history.at(BOOT, 200) is None
    assert parts(history.at(BOOT, 201))[0] == 2.01
