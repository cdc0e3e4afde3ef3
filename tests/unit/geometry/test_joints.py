"""Joints move within their speed, acceleration and range, and stop at their targets."""

import itertools
import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.body import JointDescription, JointGains
from gigabrain_zenoh.geometry.joints import (
    JointMotion,
    accelerated,
    approach,
    braked,
    frozen,
    joints_at_rest,
    stopped,
)

DT = 0.02
JOINT = JointDescription(name="elbow", lower=-1.5, upper=1.5, max_speed=3.0, max_acceleration=20.0)
LATE = replace(JOINT, gains=JointGains(feed_forward=0.08))  # a servo with this time constant [s]
positions = st.floats(-1.5, 1.5)
speeds = st.floats(-100.0, 100.0)


def moved(start: float, target: float, ticks: int) -> list[JointMotion]:
    path = [JointMotion(start)]
    for _ in range(ticks):
        path.append(approach(path[-1], JointMotion(target), JOINT, DT))
    return path


@given(positions, positions)
def test_a_far_target_is_reached_within_all_limits_and_not_overshot(
    start: float, target: float
) -> None:
    path = moved(start, target, 120)
    low, high = min(start, target), max(start, target)
    for before, after in itertools.pairwise(path):
        assert low - 1e-9 <= after.position <= high + 1e-9
        assert abs(after.velocity) <= JOINT.max_speed + 1e-9
        assert abs(after.velocity - before.velocity) <= JOINT.max_acceleration * DT + 1e-9
        assert after.position - before.position == pytest.approx(after.velocity * DT, abs=1e-9)
    assert path[-1].position == pytest.approx(target, abs=1e-6)
    assert path[-1].velocity == pytest.approx(0.0, abs=1e-4)


@given(positions, st.lists(st.tuples(st.floats(-5, 5), speeds), min_size=1, max_size=200))
def test_no_command_moves_a_joint_out_of_its_range(
    start: float, targets: list[tuple[float, float]]
) -> None:
    now = JointMotion(start)
    for position, velocity in targets:
        after = approach(now, JointMotion(position, velocity), JOINT, DT)
        assert JOINT.lower <= after.position <= JOINT.upper
        assert abs(after.velocity) <= JOINT.max_speed + 1e-9
        now = accelerated(after, velocity, JOINT, DT)
        assert JOINT.lower <= now.position <= JOINT.upper


@given(positions, speeds)
def test_a_braked_joint_comes_to_rest_within_its_range(start: float, velocity: float) -> None:
    now = accelerated(JointMotion(start), velocity, JOINT, DT)
    for _ in range(20):
        now = braked(now, JOINT, DT)
    assert now.velocity == 0.0 or abs(now.velocity) < 1e-9
    assert JOINT.lower <= now.position <= JOINT.upper


def test_a_braked_joint_takes_back_most_of_its_servos_lag() -> None:
    now = before = JointMotion(0.5, 1.0, lag=LATE.gains.feed_forward)
    for _ in range(2):
        now = braked(now, LATE, DT)
    assert now.velocity == 0.0
    assert 0.5 - 0.6 * before.lag < now.position < 0.5 - 0.4 * before.lag


def test_a_stream_within_the_limits_is_followed_exactly() -> None:
    def reference(k: int) -> JointMotion:
        t = k * DT
        return JointMotion(0.5 * math.sin(math.pi * t), 0.5 * math.pi * math.cos(math.pi * t))

    now = reference(0)
    for k in range(1, 200):
        now = approach(now, reference(k), JOINT, DT)
        assert now.position == pytest.approx(reference(k).position, abs=1e-3)


def test_a_joint_outside_its_range_moves_inwards_only() -> None:
    now = JointMotion(1.7)
    assert accelerated(now, 1.0, JOINT, DT).position == 1.7
    assert accelerated(now, -1.0, JOINT, DT).position < 1.7


def test_joints_are_at_rest_only_if_all_are_and_none_is_nan() -> None:
    still, moving = JointMotion(1.0, 0.01), JointMotion(0.0, 0.2)
    assert joints_at_rest([still])
    assert not joints_at_rest([still, moving])
    assert not joints_at_rest([JointMotion(0.0, math.nan)])
    assert frozen(moving) == JointMotion(0.0)


def test_a_stopped_joint_takes_back_most_of_its_servos_lag() -> None:
    late, prompt = JointMotion(-1.0), JointMotion(-1.0)
    for _ in range(40):
        late, prompt = accelerated(late, 2.0, LATE, DT), accelerated(prompt, 2.0, JOINT, DT)
    assert late.lag == pytest.approx(2.0 * LATE.gains.feed_forward, rel=1e-2)
    assert stopped(late) == JointMotion(late.position - 0.6 * late.lag)
    assert stopped(prompt) == JointMotion(prompt.position)
    assert stopped(stopped(late)) == stopped(late)


@pytest.mark.parametrize("stop", [lambda now: stopped(now), lambda now: braked(now, LATE, DT)])
@given(speed=st.floats(-3.0, 3.0), ticks=st.integers(1, 12))
def test_a_joint_that_has_just_started_is_not_sent_back_behind_its_start(
    stop: Callable[[JointMotion], JointMotion], speed: float, ticks: int
) -> None:
    now = JointMotion(0.0)
    for _ in range(ticks):
        now = accelerated(now, speed, LATE, DT)
    for _ in range(5):
        now = stop(now)
        assert now.position * speed >= -1e-9
