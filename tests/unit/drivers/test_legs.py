"""Legs: kinematics and gaits in both directions, and odometry from a robot's sensors."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_drivers.kinematics import Vector
from gigabrain_drivers.kinematics.legs import (
    JOINT_NAMES,
    WALKER,
    Gait,
    LegGeometry,
    LegOdometry,
    Senses,
    is_valid_gait,
)
from gigabrain_drivers.kinematics.wheels import Twist

GEOMETRY = LegGeometry()
LEVEL = (0.0, 0.0, 0.0, 1.0)
UP = (0.0, 0.0, 9.81)
legs = st.integers(0, 3)
twists = st.builds(Twist, st.floats(-0.5, 0.5), st.floats(-0.2, 0.2), st.floats(-1.0, 1.0))


def angles_of(leg: int) -> st.SearchStrategy[Vector]:
    """Draw joint angles with the foot below the hip; above it, the solution is not unique."""
    knee_sign = GEOMETRY.legs[leg].knee_sign
    hips, knees = st.floats(-0.3, 1.2), st.floats(0.6, 2.5)
    return st.tuples(st.floats(-0.6, 0.6), hips, knees).map(
        lambda a: (a[0], -knee_sign * a[1], knee_sign * a[2])
    )


@given(st.data(), legs)
def test_joint_angles_round_trip(data: st.DataObject, number: int) -> None:
    leg, angles = GEOMETRY.legs[number], data.draw(angles_of(number))
    assert leg.joints(leg.foot(angles)) == pytest.approx(angles, abs=1e-9)


@given(st.data(), legs)
def test_the_jacobian_matches_finite_differences(data: st.DataObject, number: int) -> None:
    leg, angles, step = GEOMETRY.legs[number], data.draw(angles_of(number)), 1e-6
    for joint, column in enumerate(leg.jacobian(angles)):
        more, less = list(angles), list(angles)
        more[joint] += step
        less[joint] -= step
        ends = zip(leg.foot(tuple(more)), leg.foot(tuple(less)), strict=True)  # type: ignore[arg-type]
        assert [(a - b) / (2 * step) for a, b in ends] == pytest.approx(column, abs=1e-8)


@given(twists)
def test_velocity_round_trip(twist: Twist) -> None:
    gait = WALKER.to_gait(twist)
    assert is_valid_gait(gait)
    assert WALKER.to_body(gait) == pytest.approx(twist, abs=1e-9)


@given(twists)
def test_gait_round_trip(twist: Twist) -> None:
    gait = WALKER.to_gait(twist)
    again = WALKER.to_gait(WALKER.to_body(gait))
    for mine, its in zip(gait, again, strict=True):
        assert mine == pytest.approx(its, abs=1e-9)


def test_gait_of_alpha_for_a_velocity() -> None:
    gait = WALKER.to_gait(Twist(0.36, 0.072, -0.9))
    assert gait == Gait(
        stride_x=pytest.approx(0.1),
        stride_y=pytest.approx(0.02),
        turn=pytest.approx(-0.25),
        frequency=3.6,
        duty=0.6,
        phases=(0.0, 0.5, 0.5, 0.0),
        height=0.29,
    )


def test_a_standing_body_has_feet_below_its_hips_and_knees_that_face_each_other() -> None:
    stand = GEOMETRY.standing(0.29)
    feet = [leg.foot(angles) for leg, angles in zip(GEOMETRY.legs, stand, strict=True)]
    assert feet[0] == pytest.approx((0.19, 0.135, -0.29))
    assert feet[3] == pytest.approx((-0.19, -0.135, -0.29))
    assert [knee > 0 for _, _, knee in stand] == [False, False, True, True]
    assert JOINT_NAMES[:4] == (
        "front_left_abduction", "front_left_hip", "front_left_knee", "front_right_abduction",
    )  # fmt: skip


def test_a_foot_position_out_of_reach_is_approached_with_a_straight_leg() -> None:
    leg = GEOMETRY.legs[0]
    x, y, z = leg.foot(leg.joints((0.19, 0.135, -1.0)))
    assert (x, y) == pytest.approx((0.19, 0.135), abs=0.05)
    assert z == pytest.approx(-0.4196, abs=0.001)


@pytest.mark.parametrize(
    "wrong",
    [
        {"stride_x": math.nan},
        {"frequency": 0.0},
        {"frequency": math.inf},
        {"stride_x": 0.2, "stride_y": 0.2},
        {"turn": -0.7},
        {"duty": 0.95},
        {"height": 0.5},
        {"phases": (0.0, 0.5, 0.5, 1.0)},
    ],
)
def test_a_gait_beyond_the_limits_is_invalid(wrong: dict[str, object]) -> None:
    assert not is_valid_gait(WALKER.to_gait(Twist(0.3, 0.0, 0.0))._replace(**wrong))  # type: ignore[arg-type]


def odometry_after(twist: Twist, seconds: float, lifted: tuple[int, ...] = ()) -> LegOdometry:
    """Return the odometry of a body that moves at `twist`, with the feet `lifted` in the air."""
    odometry, passed = LegOdometry(GEOMETRY), 0.01
    contacts = tuple(leg not in lifted for leg in range(4))
    stand = GEOMETRY.standing(0.29)
    radius = GEOMETRY.foot
    rates = []
    for leg, angles in zip(GEOMETRY.legs, stand, strict=True):
        x, y, _ = leg.foot(angles)
        wanted = (twist.angular_z * y - twist.linear_x, -twist.angular_z * x - twist.linear_y, 0.0)
        rates.append(_rates(leg.jacobian(angles), wanted, radius))
    senses = Senses(stand, tuple(rates), contacts, LEVEL, (0.0, 0.0, twist.angular_z), UP)
    for _ in range(round(seconds / passed)):
        odometry.update(senses, passed)
    return odometry


def _rates(columns: tuple[Vector, ...], wanted: Vector, radius: float) -> Vector:
    """Return the joint rates at which the contact point of a rolling ball moves as wanted."""
    import numpy as np

    matrix = np.array(columns).T
    matrix[0, 1:] -= radius
    matrix[1, 0] += radius
    a, b, c = np.linalg.solve(matrix, wanted).tolist()
    return a, b, c


def test_feet_on_the_floor_measure_the_velocity() -> None:
    odometry = odometry_after(Twist(0.2, 0.0, 0.0), 1.0)
    assert odometry.velocity == pytest.approx((0.2, 0.0, 0.0), abs=1e-3)
    assert odometry.pose.x == pytest.approx(0.2, abs=0.02)


def test_feet_in_the_air_measure_no_velocity() -> None:
    odometry = odometry_after(Twist(0.2, 0.0, 0.0), 1.0, lifted=(0, 1, 2, 3))
    assert odometry.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)


def test_turning_on_the_spot_does_not_change_the_position() -> None:
    odometry = odometry_after(Twist(0.0, 0.0, 0.8), 1.0, lifted=(0, 3))
    assert (odometry.pose.x, odometry.pose.y) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert odometry.pose.yaw == pytest.approx(0.8, abs=1e-9)


def test_a_tilted_body_at_rest_has_no_velocity() -> None:
    tilt = 0.1
    attitude = (math.sin(tilt / 2), 0.0, 0.0, math.cos(tilt / 2))
    acceleration = (0.0, 9.81 * math.sin(tilt), 9.81 * math.cos(tilt))
    odometry, still = LegOdometry(GEOMETRY), ((0.0, 0.0, 0.0),) * 4
    senses = Senses(GEOMETRY.standing(0.29), still, (False,) * 4, attitude, still[0], acceleration)
    for _ in range(100):
        odometry.update(senses, 0.01)
    assert odometry.velocity == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
