"""Joints move smoothly to a posture, onto a path, and at a speed until their range ends."""

import itertools
import math
import sys

import pytest
import ruckig
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry import joint_ramp
from gigabrain_zenoh.geometry.joint_ramp import (
    REST,
    JointGoal,
    JointPoint,
    along,
    prepare,
    ramp,
)

DT = 0.02
ELBOW = JointDescription(name="elbow", lower=-2.0, upper=2.0, max_speed=3.0, max_acceleration=20.0)
tiny = st.builds(lambda sign, power: sign * 10.0**power, st.sampled_from((-1.0, 0.0, 1.0)),
                 st.floats(-19.0, -3.0))  # fmt: skip
MAX_SPEED_CHANGE = 20.0 * DT * 1.03  # [rad/s], per step


def moved(goal: JointGoal, steps: int, start: float = 0.0) -> list[JointPoint]:
    points = [JointPoint(start)]
    for _ in range(steps):
        points += ramp(points[-1:], [goal], [ELBOW], DT)
    return points


def test_a_posture_is_reached_within_the_limits_and_without_overshoot() -> None:
    points = moved(JointGoal(1.0), 60)
    assert points[-1].position == pytest.approx(1.0, abs=1e-6)
    assert max(point.position for point in points) <= 1.0 + 1e-6
    speeds = [point.velocity for point in points]
    assert 2.5 < max(speeds) <= 3.0
    assert max(abs(b - a) for a, b in itertools.pairwise(speeds)) <= MAX_SPEED_CHANGE


def test_a_lower_speed_can_be_requested() -> None:
    points = moved(JointGoal(1.0, max_speed=0.5), 30)
    assert max(point.velocity for point in points) == pytest.approx(0.5)


def test_a_joint_comes_to_rest_from_any_speed() -> None:
    point = ramp([JointPoint(0.0, 2.0, 5.0)], [REST], [ELBOW], 1.0)[0]
    assert (point.velocity, point.acceleration) == pytest.approx((0.0, 0.0))
    assert 0.0 < point.position < 0.5


def test_a_joint_that_brakes_does_not_wait_for_one_with_a_long_way() -> None:
    alone = ramp([JointPoint(0.0, 0.3, 1.0)], [REST], [ELBOW], 0.1)[0]
    moving = [JointPoint(0.0, 0.3, 1.0), JointPoint(-1.5)]
    beside = ramp(moving, [REST, JointGoal(1.5)], [ELBOW, ELBOW], 0.1)[0]
    assert (beside.position, beside.velocity) == pytest.approx((alone.position, alone.velocity))


@pytest.mark.parametrize("speed", [3.0, -3.0, 99.0])
def test_a_joint_that_keeps_moving_comes_to_rest_at_the_end_of_its_range(speed: float) -> None:
    points = moved(JointGoal(velocity=speed), 150)
    assert abs(points[-1].position) == pytest.approx(2.0, abs=0.01)
    assert all(-2.0 <= point.position <= 2.0 for point in points)
    assert max(abs(point.velocity) for point in points) <= 3.0


def test_a_posture_out_of_range_ends_at_the_limit() -> None:
    assert moved(JointGoal(9.0), 100)[-1].position == pytest.approx(2.0)


def test_a_joint_gets_onto_a_moving_path_and_stays_on_it() -> None:
    point, off = JointPoint(0.3), []
    for step in range(60):
        path = [[0.8 * math.sin(math.pi * DT * (step + k))] for k in range(3)]
        new = along([point], path, [ELBOW], DT)[0]
        assert abs(new.velocity - point.velocity) <= MAX_SPEED_CHANGE
        point = new
        off.append(abs(point.position - path[1][0]))
    assert max(off[20:]) < 1e-9


def test_a_joint_that_is_behind_does_not_overshoot_the_end_of_a_braking_path() -> None:
    braking = 0.5 * ELBOW.max_acceleration
    point, end_s = JointPoint(-0.15, 1.5), 1.5 / braking
    for step in range(40):
        times = [min(end_s, (step + k) * DT) for k in range(3)]
        path = [[1.5 * t - 0.5 * braking * t * t] for t in times]
        point = along([point], path, [ELBOW], DT)[0]
        assert point.position < path[2][0] + 0.002
    assert point.position == pytest.approx(path[2][0], abs=1e-6)


def test_a_path_that_is_too_fast_is_followed_as_fast_as_the_joint_can() -> None:
    point = JointPoint(-1.9)
    for step in range(40):
        path = [[-1.9 + (step + k) * DT * 6.0] for k in range(3)]
        point = along([point], path, [ELBOW], DT)[0]
        assert point.velocity <= 3.0 * 1.03
    assert point.position > -0.5


def test_without_ruckig_the_error_names_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(ConfigError, match=r"needs ruckig; pip install 'gigabrain-zenoh\[arm\]'"):
        ramp([JointPoint(0.0)], [REST], [ELBOW], DT)
    with pytest.raises(ConfigError, match="needs ruckig"):
        prepare(31)


def test_joints_at_rest_except_for_rounding_are_held() -> None:
    """Ruckig found no motion from these speeds and accelerations, which occurred on a robot."""
    places = (-0.5943974399396441, -0.2666303726565727, 0.08470855106320617, 0.3707360604093174)
    speeds = (0.0, 6.23416249179165e-19, -7.589415207398531e-19, 1.301042606982605e-18)
    accelerations = (0.0, -1.165734175856414e-15, -1.332267629550188e-15, -1.110223024625157e-15)
    now = [JointPoint(*point) for point in zip(places, speeds, accelerations, strict=True)]
    found = ramp(now, [JointGoal(place) for place in places], [ELBOW] * 4, DT)
    assert [point.position for point in found] == pytest.approx(places, abs=1e-9)


@given(st.lists(st.tuples(tiny, tiny, tiny), min_size=6, max_size=6))
def test_a_motion_is_found_for_tiny_speeds_and_distances(
    joints: list[tuple[float, float, float]],
) -> None:
    now = [JointPoint(0.5, speed, acceleration) for speed, acceleration, _ in joints]
    goals = [JointGoal(0.5 + way) for _, _, way in joints]
    found = ramp(now, goals, [ELBOW] * len(joints), DT)
    assert [point.position for point in found] == pytest.approx([0.5] * len(joints), abs=0.01)
    path = [[0.5 + k * way for _, _, way in joints] for k in range(3)]
    along(now, path, [ELBOW] * len(joints), DT)


def test_joints_brake_if_ruckig_finds_no_motion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class NoMotion:
        def calculate(self, given: object, path: object) -> None:
            raise ruckig.RuckigError("no way")

    monkeypatch.setattr(joint_ramp, "_solver", lambda joints: NoMotion())
    (point,) = ramp([JointPoint(0.0, 1.0)], [JointGoal(1.0)], [ELBOW], DT)
    assert point.velocity == pytest.approx(1.0 - 20.0 * DT)
    assert point.position == pytest.approx(0.6 * DT)
