"""Wheel odometry, and encoder counters that wrap."""

import math

import pytest

from gigabrain_drivers.kinematics.wheels import (
    Differential,
    Encoders,
    Mecanum,
    Twist,
    WheelOdometry,
)

WAFFLE = Differential(radius=0.033, separation=0.287)


def test_driving_straight_covers_the_distance_that_the_wheels_roll() -> None:
    odometry = WheelOdometry(WAFFLE)
    odometry.add((math.tau, math.tau))
    assert (odometry.pose.x, odometry.pose.y) == pytest.approx((0.20735, 0.0), abs=1e-5)


def test_a_circle_in_small_steps_ends_at_its_start() -> None:
    odometry = WheelOdometry(WAFFLE)
    steps, radius = 1000, 0.5
    for _ in range(steps):
        turn = math.tau / steps
        odometry.add(WAFFLE.to_wheels(Twist(turn * radius, 0.0, turn)))
    assert (odometry.pose.x, odometry.pose.y) == pytest.approx((0, 0), abs=1e-9)
    assert odometry.pose.yaw == pytest.approx(0, abs=1e-9)


def test_a_body_that_faces_left_and_slides_left_moves_backward() -> None:
    base = Mecanum(radius=0.05, separation=0.3, wheel_base=0.3)
    odometry = WheelOdometry(base)
    for twist in (Twist(0.0, 0.0, math.pi / 2), Twist(0.0, 1.0, 0.0)):
        odometry.add(base.to_wheels(twist))
    assert (odometry.pose.x, odometry.pose.y) == pytest.approx((-1, 0), abs=1e-9)
    assert odometry.pose.yaw == pytest.approx(math.pi / 2)


def test_counters_start_at_any_value_and_wrap() -> None:
    encoders = Encoders(per_turn=4096, bits=32)
    assert encoders.turned((2**31 - 100, -5)) == (0.0, 0.0)
    assert encoders.turned((-(2**31) + 100, 5)) == pytest.approx((0.306796, 0.01534), abs=1e-6)
    assert encoders.turned((-(2**31) + 100, 5)) == (0.0, 0.0)


def test_reset_counters_are_no_motion() -> None:
    encoders = Encoders(per_turn=4096, bits=16)
    encoders.turned((1000, 1000))
    encoders.restart()
    assert encoders.turned((0, 0)) == (0.0, 0.0)
