"""Kinematics in both directions: from the body to its wheels or its gait, and back."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.kinematics.legs import Walker
from gigabrain_drivers.kinematics.wheels import (
    Ackermann,
    AckermannAxles,
    Base,
    Differential,
    Mecanum,
    Omni,
    SkidSteer,
    Twist,
    wheels_of,
)

speeds = st.floats(-3.0, 3.0, allow_subnormal=False)
twists = st.builds(Twist, speeds, speeds, speeds)
lengths = st.floats(0.02, 1.0)


def close(a: Twist, b: Twist, within: float = 1e-9) -> bool:
    return all(abs(x - y) <= within for x, y in zip(a, b, strict=True))


@given(twists, lengths, lengths)
def test_differential_round_trip(twist: Twist, radius: float, separation: float) -> None:
    base = Differential(radius, separation)
    assert close(base.to_body(base.to_wheels(twist)), twist._replace(linear_y=0.0))


@given(twists, lengths, lengths, lengths)
def test_mecanum_round_trip(
    twist: Twist, radius: float, separation: float, wheel_base: float
) -> None:
    base = Mecanum(radius, separation, wheel_base)
    assert close(base.to_body(base.to_wheels(twist)), twist)


@given(twists, lengths, lengths)
def test_omni_round_trip(twist: Twist, radius: float, circle: float) -> None:
    base = Omni(radius, circle)
    assert close(base.to_body(base.to_wheels(twist)), twist)


@given(speeds, st.floats(-0.75, 0.75), lengths, lengths)
def test_ackermann_round_trip(
    forward: float, steering: float, radius: float, wheel_base: float
) -> None:
    base = Ackermann(radius, wheel_base)
    twist = Twist(forward, 0.0, forward * math.tan(steering) / wheel_base)
    assert close(base.to_body(base.to_wheels(twist)), twist)


@given(speeds, st.floats(-0.75, 0.75), lengths, lengths, st.floats(0.02, 0.5))
def test_four_wheels_of_a_car_round_trip(
    forward: float, steering: float, radius: float, wheel_base: float, share: float
) -> None:
    base = AckermannAxles(Ackermann(radius, wheel_base), share * wheel_base)
    twist = Twist(forward, 0.0, forward * math.tan(steering) / wheel_base)
    assert close(base.to_body(base.to_wheels(twist)), twist)


def test_the_inner_front_wheel_of_a_car_steers_more_and_its_rear_wheel_rolls_slower() -> None:
    base = AckermannAxles(Ackermann(0.05, 0.26), 0.2)
    rear_left, rear_right, left, right = base.to_wheels(Twist(0.45, 0.0, 1.0))
    assert (rear_left, rear_right) == pytest.approx((7.0, 11.0))
    assert (left, right) == pytest.approx((math.atan(0.26 / 0.35), math.atan(0.26 / 0.55)))


@given(twists, lengths, lengths)
def test_skid_steer_round_trip(twist: Twist, radius: float, track: float) -> None:
    base = SkidSteer(radius, track)
    assert close(base.to_body(base.to_wheels(twist)), twist._replace(linear_y=0.0))


@given(twists)
def test_gait_round_trip(twist: Twist) -> None:
    walker = Walker(max_frequency=30.0)
    assert close(walker.to_body(walker.to_gait(twist)), twist)


@pytest.mark.parametrize(
    "base", [Differential(0.033, 0.287), Mecanum(0.05, 0.3, 0.4), Omni(0.05, 0.125)]
)
@given(st.data())
def test_wheel_speeds_round_trip(base: Base, data: st.DataObject) -> None:
    twist = data.draw(twists)
    wheels = base.to_wheels(twist)
    again = base.to_wheels(base.to_body(wheels))
    assert all(abs(a - b) <= 1e-9 * 100 for a, b in zip(wheels, again, strict=True))


def test_wheel_speeds_of_a_waffle() -> None:
    left, right = Differential(0.033, 0.287).to_wheels(Twist(0.1, 0.0, 0.5))
    assert (left, right) == pytest.approx((0.8560606, 5.2045455), abs=1e-6)


def test_wheel_speeds_of_mycustombot_driving_straight() -> None:
    assert Differential(0.08, 0.5).to_wheels(Twist(0.4, 0.0, 0.0)) == pytest.approx((5.0, 5.0))


def test_mecanum_sideways_to_the_left_turns_the_front_left_wheel_backwards() -> None:
    wheels = Mecanum(0.05, 0.3, 0.4).to_wheels(Twist(0.0, 0.1, 0.0))
    assert wheels == pytest.approx((-2.0, 2.0, 2.0, -2.0))


def test_omni_wheels_turn_as_those_of_lekiwi() -> None:
    # angles 240, 0 and 120 degrees minus 90; v = cos(a) x + sin(a) y + 0.125 w; radius 0.05
    left, back, right = Omni(0.05, 0.125).to_wheels(Twist(0.1, 0.0, 0.2))
    assert (left, back, right) == pytest.approx((-1.2320508, 0.5, 2.2320508), abs=1e-6)


def test_ackermann_steers_to_the_left_of_a_left_turn_also_backwards() -> None:
    base = Ackermann(0.1, 0.5)
    assert base.to_wheels(Twist(1.0, 0.0, 0.4)) == pytest.approx((10.0, math.atan(0.2)))
    assert base.to_wheels(Twist(-1.0, 0.0, 0.4)) == pytest.approx((-10.0, -math.atan(0.2)))


def test_ackermann_cannot_turn_on_the_spot() -> None:
    base = Ackermann(0.1, 0.5)
    assert base.to_body(base.to_wheels(Twist(0.0, 0.0, 1.0))) == (0.0, 0.0, 0.0)


def test_ackermann_limits_its_steering_angle() -> None:
    assert Ackermann(0.1, 0.5, max_steering=0.6).to_wheels(Twist(0.1, 0.0, 9.0))[1] == 0.6


def test_with_the_speed_of_a_trot_first_strides_grow_then_their_frequency() -> None:
    walker = Walker()
    slow, fast = walker.to_gait(Twist(0.3, 0.0, 0.0)), walker.to_gait(Twist(0.6, 0.0, 0.0))
    assert (slow.stride_x, slow.frequency) == pytest.approx((0.12, 2.5))
    assert (fast.stride_x, fast.frequency) == pytest.approx((0.2, 3.0))


def test_a_velocity_too_fast_for_a_trot_is_scaled_down() -> None:
    walker = Walker()
    assert walker.to_body(walker.to_gait(Twist(1.6, 0.0, 1.0))) == pytest.approx((0.8, 0.0, 0.5))


def test_a_robot_without_its_wheel_radius_has_no_wheels() -> None:
    waffle = catalog.load_robot("turtlebot3_waffle")
    assert wheels_of(waffle) == Differential(0.033, 0.287)
    assert wheels_of(replace(waffle, wheel_radius=0.0)) is None
