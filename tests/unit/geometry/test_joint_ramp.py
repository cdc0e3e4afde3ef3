"""Joints move smoothly: to a posture, onto a path, and at a speed that ends in time."""

import itertools
import math
import sys

import pytest

from gigabrain_schemas.body import JointDescription
from gigabrain_zenoh.errors import ConfigError
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
STEP_CHANGE = 20.0 * DT * 1.03  # [rad/s], of speed in a step


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
    assert max(abs(b - a) for a, b in itertools.pairwise(speeds)) <= STEP_CHANGE


def test_a_lower_speed_can_be_asked_for() -> None:
    points = moved(JointGoal(1.0, max_speed=0.5), 30)
    assert max(point.velocity for point in points) == pytest.approx(0.5)


def test_a_joint_comes_to_rest_from_any_speed() -> None:
    point = ramp([JointPoint(0.0, 2.0, 5.0)], [REST], [ELBOW], 1.0)[0]
    assert (point.velocity, point.acceleration) == pytest.approx((0.0, 0.0))
    assert 0.0 < point.position < 0.5


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
        before, after = (0.8 * math.sin(math.pi * DT * k) for k in (step, step + 1))
        new = along([point], [before], [after], [ELBOW], DT)[0]
        assert abs(new.velocity - point.velocity) <= STEP_CHANGE
        point = new
        off.append(abs(point.position - after))
    assert max(off[20:]) < 1e-9


def test_a_path_that_is_too_fast_is_followed_as_fast_as_the_joint_can() -> None:
    point = JointPoint(-1.9)
    for step in range(40):
        at = -1.9 + step * DT * 6.0
        point = along([point], [at], [at + DT * 6.0], [ELBOW], DT)[0]
        assert point.velocity <= 3.0 * 1.03
    assert point.position > -0.5


def test_without_ruckig_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    with pytest.raises(ConfigError, match=r"needs ruckig; pip install 'gigabrain-zenoh\[arm\]'"):
        ramp([JointPoint(0.0)], [REST], [ELBOW], DT)
    with pytest.raises(ConfigError, match="needs ruckig"):
        prepare(31)
