"""Reachable goals of the tool are found; others are explained."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_zenoh.manipulation.inverse_kinematics import OutOfReach, Reachable, ToolGoal
from tests.unit.manipulation.arms import arm, inverse, postures

DOWN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def test_every_possible_pose_is_found() -> None:
    for posture, start in zip(postures(200), postures(200, seed=1), strict=True):
        frame = arm().forward(posture)
        found = inverse().solve(ToolGoal(position=frame.position, axes=frame.axes), start)
        assert isinstance(found, Reachable), found
        assert arm().inside(found.posture)
        reached = arm().forward(found.posture)
        assert np.linalg.norm(reached.position - frame.position) < 1e-4
        assert math.acos(min(1.0, (np.trace(reached.axes.T @ frame.axes) - 1) / 2)) < 0.011


def test_nearly_every_possible_direction_is_found() -> None:
    found = 0
    for posture in postures(200):
        frame = arm().forward(posture)
        goal = ToolGoal(position=frame.position, approach=frame.axes[:, 0])
        found += isinstance(inverse().solve(goal), Reachable)
    assert found >= 190  # the rest end in local minima


@pytest.mark.parametrize("radius", [0.08, 0.14, 0.20, 0.26])
@pytest.mark.parametrize("azimuth", [-90, -30, 0, 60])
def test_the_tool_can_point_down_over_the_table(radius: float, azimuth: float) -> None:
    angle = math.radians(azimuth)
    place = [0.0388 + radius * math.cos(angle), radius * math.sin(angle), 0.02]
    found = inverse().solve(ToolGoal(position=np.array(place), approach=np.array([0.0, 0, -1])))
    assert isinstance(found, Reachable)


def test_solving_is_deterministic() -> None:
    goal = ToolGoal(position=np.array([0.2, 0.1, 0.05]), axes=DOWN)
    first, second = inverse().solve(goal), inverse().solve(goal)
    assert isinstance(first, Reachable)
    assert isinstance(second, Reachable)
    assert np.array_equal(first.posture, second.posture)


def test_the_posture_is_near_a_start_that_is_near_the_goal() -> None:
    for posture in postures(50):
        near = np.clip(posture + 0.02, arm().lower, arm().upper)
        frame = arm().forward(posture)
        found = inverse().solve(ToolGoal(position=frame.position, axes=frame.axes), near)
        assert isinstance(found, Reachable)
        assert np.abs(found.posture - posture).max() < 0.1


def test_the_reason_for_a_far_goal_names_the_distance() -> None:
    found = inverse().solve(ToolGoal(position=np.array([1.0388, 0.0, 0.1166])))
    assert isinstance(found, OutOfReach)
    assert found.posture is not None
    missing = 1.0388 - np.linalg.norm(arm().forward(found.posture).position * [1, 0, 0])
    assert found.position_error == pytest.approx(missing, abs=0.01)
    assert f"too far by {found.position_error * 100:.1f} cm" in found.reason


def test_a_goal_behind_the_arm_names_the_joint_at_its_limit() -> None:
    found = inverse().solve(ToolGoal(position=np.array([-0.6, 0.0, 0.02])))
    assert isinstance(found, OutOfReach)
    assert found.cause == "joint_limit"
    assert "is at its limit of" in found.reason


def test_the_reason_for_an_impossible_orientation_names_the_angle() -> None:
    goal = ToolGoal(position=np.array([0.25, 0.0, 0.1]), approach=np.array([0.0, 1.0, 0.0]))
    found = inverse().solve(goal)
    assert isinstance(found, OutOfReach)
    assert found.cause == "orientation"
    assert found.posture is not None
    assert np.linalg.norm(arm().forward(found.posture).position - goal.position) < 1e-4
    off = math.acos(arm().forward(found.posture).axes[1, 0])
    assert found.orientation_error == pytest.approx(off, abs=1e-3)
    assert f"off by {math.degrees(off):.0f}°" in found.reason


def test_with_an_impossible_orientation_the_position_is_reached() -> None:
    random = np.random.default_rng(2)
    for posture in postures(100):
        approach = random.normal(size=3)
        place = arm().forward(posture).position
        found = inverse().solve(
            ToolGoal(position=place, approach=approach / np.linalg.norm(approach))
        )
        assert found.posture is not None
        assert np.linalg.norm(arm().forward(found.posture).position - place) < 1e-3


@pytest.mark.parametrize("tolerance", [0.2, math.pi])
def test_a_goal_is_reached_within_its_orientation_tolerance(tolerance: float) -> None:
    random, turned, found = np.random.default_rng(3), 0, 0
    for posture in postures(60):
        frame = arm().forward(posture)
        off = random.normal(size=3)
        off -= off @ frame.axes[:, 0] * frame.axes[:, 0]
        approach = frame.axes[:, 0] + 0.9 * min(1.0, tolerance) * off / np.linalg.norm(off)
        goal = ToolGoal(
            position=frame.position,
            approach=approach / np.linalg.norm(approach),
            orientation_tolerance=tolerance,
        )
        one = inverse().solve(goal, posture)
        found += isinstance(one, Reachable)
        turned += isinstance(one, Reachable) and one.orientation_error > 0.05
    assert found == 60
    assert turned > 10  # most are impossible without the tolerance


def test_a_posture_that_collides_is_not_returned() -> None:
    goal = ToolGoal(position=np.array([0.2, 0.0, 0.1]))
    found = inverse().solve(goal, collides=lambda posture: "palm and shelf")
    assert isinstance(found, OutOfReach)
    assert found.cause == "collision"
    assert found.reason == "collides: palm and shelf"


@pytest.mark.parametrize(
    "goal",
    [
        ToolGoal(position=np.array([math.nan, 0.0, 0.0])),
        ToolGoal(position=np.zeros(3), axes=np.zeros((3, 3))),
        ToolGoal(position=np.zeros(3), axes=-np.eye(3)),
        ToolGoal(position=np.zeros(3), approach=np.array([2.0, 0.0, 0.0])),
    ],
)
def test_an_invalid_goal_is_refused(goal: ToolGoal) -> None:
    found = inverse().solve(goal)
    assert isinstance(found, OutOfReach)
    assert (found.cause, found.posture) == ("invalid", None)


@given(st.tuples(*(st.floats(-1.0, 1.0) for _ in range(3))))
def test_every_result_is_within_the_limits_and_has_the_true_error(
    place: tuple[float, float, float],
) -> None:
    goal = ToolGoal(position=np.array(place))
    found = inverse().solve(goal)
    assert found.posture is not None
    assert arm().inside(found.posture)
    off = np.linalg.norm(arm().forward(found.posture).position - goal.position)
    assert found.position_error == pytest.approx(off, abs=1e-9)
    assert isinstance(found, OutOfReach) == (off >= 1e-4)
