"""Speed and acceleration limits of a body."""

import math

import msgspec
import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, DriveType
from gigabrain_schemas.safety import SpeedCaps
from gigabrain_zenoh.geometry.limits import ZERO, Limits, clamp, limits_of, ramp, slowed

LIMITS = Limits(
    linear_speed=0.5,
    lateral_speed=0.25,
    angular_speed=2.0,
    linear_acceleration=1.0,
    linear_deceleration=2.0,
    angular_acceleration=4.0,
)


def test_the_limits_are_those_of_the_bodys_file() -> None:
    body = BodyDescription(
        robot_type="test",
        drive_type="omni",
        footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1)),
        max_linear_speed=0.26,
        max_lateral_speed=0.2,
        max_angular_speed=1.8,
        max_linear_acceleration=0.9,
        max_linear_deceleration=1.1,
        max_angular_acceleration=3.3,
    )
    assert limits_of(body) == Limits(
        linear_speed=0.26,
        lateral_speed=0.2,
        angular_speed=1.8,
        linear_acceleration=0.9,
        linear_deceleration=1.1,
        angular_acceleration=3.3,
    )


@pytest.mark.parametrize(
    ("drive_type", "rim", "rim_speed", "half_track"),
    [
        ("differential", 0.25, 0.25, 0.125),
        ("differential", None, math.inf, 0.125),
        ("mecanum", 0.25, math.inf, 0.0),
    ],
)
def test_only_the_wheels_of_a_differential_base_have_a_limit_of_their_own(
    drive_type: DriveType, rim: float | None, rim_speed: float, half_track: float
) -> None:
    body = BodyDescription(
        robot_type="test",
        drive_type=drive_type,
        footprint=((0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1)),
        max_linear_speed=0.5,
        max_angular_speed=2.0,
        wheel_separation=0.25,
        max_rim_speed=rim,
    )
    limits = limits_of(body)
    assert (limits.rim_speed, limits.half_track) == (rim_speed, half_track)


def test_a_wheel_may_be_far_over_its_limit() -> None:
    wheels = msgspec.structs.replace(LIMITS, rim_speed=0.25, half_track=0.75)
    assert clamp(Velocity(linear_x=0.5, angular_z=2.0), wheels) == Velocity(
        linear_x=0.0625, angular_z=0.25
    )


def test_a_velocity_within_the_limits_is_unchanged() -> None:
    for sign in (1, -1):
        velocity = Velocity(linear_x=0.5 * sign, linear_y=0.25 * sign, angular_z=2.0 * sign)
        assert clamp(velocity, LIMITS) == velocity


@pytest.mark.parametrize("sign", [1, -1])
def test_a_velocity_beyond_the_limits_is_cut_axis_by_axis(sign: int) -> None:
    asked = Velocity(linear_x=0.51 * sign, linear_y=0.26 * sign, angular_z=2.1 * sign)
    cut = Velocity(linear_x=0.5 * sign, linear_y=0.25 * sign, angular_z=2.0 * sign)
    assert clamp(asked, LIMITS) == cut
    assert clamp(Velocity(linear_x=9.0 * sign, angular_z=1.0), LIMITS) == Velocity(
        linear_x=0.5 * sign, angular_z=1.0
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_a_base_whose_wheel_would_be_too_fast_is_slower_along_the_same_curve(sign: int) -> None:
    wheels = msgspec.structs.replace(LIMITS, rim_speed=0.5, half_track=0.25)
    asked = Velocity(linear_x=0.5 * sign, angular_z=-2.0)
    assert clamp(asked, wheels) == Velocity(linear_x=0.25 * sign, angular_z=-1.0)
    assert clamp(Velocity(linear_x=0.25 * sign, angular_z=1.0), wheels).linear_x == 0.25 * sign


@pytest.mark.parametrize(
    ("caps", "highest", "lowest"),
    [
        (SpeedCaps(forward=0.1), (0.1, 0.25, 2.0), (-0.5, -0.25, -2.0)),
        (SpeedCaps(backward=0.1), (0.5, 0.25, 2.0), (-0.1, -0.25, -2.0)),
        (SpeedCaps(left=0.1), (0.5, 0.1, 2.0), (-0.5, -0.25, -2.0)),
        (SpeedCaps(right=0.1), (0.5, 0.25, 2.0), (-0.5, -0.1, -2.0)),
        (SpeedCaps(rotation=0.1), (0.5, 0.25, 0.1), (-0.5, -0.25, -0.1)),
        (SpeedCaps(turn_left=0.1), (0.5, 0.25, 0.1), (-0.5, -0.25, -2.0)),
        (SpeedCaps(turn_right=0.1), (0.5, 0.25, 2.0), (-0.5, -0.25, -0.1)),
        (SpeedCaps(rotation=0.2, turn_left=0.1), (0.5, 0.25, 0.1), (-0.5, -0.25, -0.2)),
        (SpeedCaps(forward=0.0, rotation=0.0), (0.0, 0.25, 0.0), (-0.5, -0.25, 0.0)),
    ],
)
def test_a_cap_limits_only_its_own_direction(
    caps: SpeedCaps, highest: tuple[float, float, float], lowest: tuple[float, float, float]
) -> None:
    fast = Velocity(linear_x=9.0, linear_y=9.0, angular_z=9.0)
    back = Velocity(linear_x=-9.0, linear_y=-9.0, angular_z=-9.0)
    assert clamp(fast, LIMITS, caps) == Velocity(
        linear_x=highest[0], linear_y=highest[1], angular_z=highest[2]
    )
    assert clamp(back, LIMITS, caps) == Velocity(
        linear_x=lowest[0], linear_y=lowest[1], angular_z=lowest[2]
    )


def test_a_cap_above_the_bodys_own_limit_changes_nothing() -> None:
    caps = SpeedCaps(forward=9.0, backward=9.0, left=9.0, right=9.0, rotation=9.0)
    fast = Velocity(linear_x=9.0, linear_y=-9.0, angular_z=9.0)
    back = Velocity(linear_x=-9.0, linear_y=9.0, angular_z=-9.0)
    assert clamp(fast, LIMITS, caps) == Velocity(linear_x=0.5, linear_y=-0.25, angular_z=2.0)
    assert clamp(back, LIMITS, caps) == Velocity(linear_x=-0.5, linear_y=0.25, angular_z=-2.0)


@pytest.mark.parametrize(
    ("current", "target", "after"),
    [
        (0.0, 0.5, 0.125),  # gaining speed: 1 m/s2 for 1/8 s
        (0.0, -0.5, -0.125),
        (0.25, 0.5, 0.375),
        (-0.25, -0.5, -0.375),
        (0.5, 0.0, 0.25),  # losing it: 2 m/s2
        (-0.5, 0.0, -0.25),
        (0.5, 0.375, 0.375),
        (-0.5, -0.375, -0.375),
        (0.0, 0.0625, 0.0625),  # no farther than the target
        (0.375, 0.375, 0.375),
        (-0.375, -0.375, -0.375),
        (0.0, 0.0, 0.0),
        (0.5, -0.5, 0.25),  # reversing: it brakes first
        (0.125, -0.5, 0.0),
        (-0.125, 0.5, 0.0),
        (0.25, -0.0625, 0.0),
        (-0.25, 0.0625, 0.0),
        (2.0, -2.0, 1.75),
        (-2.0, 2.0, -1.75),
    ],
)
def test_a_step_along_each_linear_axis(current: float, target: float, after: float) -> None:
    assert ramp(Velocity(linear_x=current), Velocity(linear_x=target), LIMITS, 0.125) == Velocity(
        linear_x=after
    )
    assert ramp(Velocity(linear_y=current), Velocity(linear_y=target), LIMITS, 0.125) == Velocity(
        linear_y=after
    )


@pytest.mark.parametrize(
    ("current", "target", "after"),
    [
        (0.0, 2.0, 0.5),  # 4 rad/s2 for 1/8 s, both ways
        (0.0, -2.0, -0.5),
        (2.0, 0.0, 1.5),
        (-2.0, 0.0, -1.5),
        (0.25, -2.0, 0.0),
        (-0.25, 2.0, 0.0),
        (1.0, 1.25, 1.25),
    ],
)
def test_a_step_of_the_yaw_rate(current: float, target: float, after: float) -> None:
    assert ramp(Velocity(angular_z=current), Velocity(angular_z=target), LIMITS, 0.125) == Velocity(
        angular_z=after
    )


@pytest.mark.parametrize(
    ("current", "target", "after"),
    [
        (0.5, 0.0, 0.25),  # braking, as in ramp
        (-0.5, 0.0, -0.25),
        (0.5, 0.375, 0.375),
        (-0.5, -0.375, -0.375),
        (0.375, 0.375, 0.375),
        (0.125, 0.5, 0.125),  # no faster
        (-0.125, -0.5, -0.125),
        (0.0, 0.5, 0.0),
        (0.0, -0.5, 0.0),
        (0.5, -0.5, 0.5),  # no reversing
        (-0.5, 0.5, -0.5),
        (0.0, 0.0, 0.0),
    ],
)
def test_a_step_in_which_nothing_may_speed_up(current: float, target: float, after: float) -> None:
    assert slowed(Velocity(linear_x=current), Velocity(linear_x=target), LIMITS, 0.125) == Velocity(
        linear_x=after
    )
    assert slowed(Velocity(linear_y=current), Velocity(linear_y=target), LIMITS, 0.125) == Velocity(
        linear_y=after
    )


@pytest.mark.parametrize(
    ("current", "target", "after"),
    [(2.0, 0.0, 1.5), (-2.0, -1.75, -1.75), (1.0, 2.0, 1.0), (1.0, -1.0, 1.0)],
)
def test_a_step_in_which_turning_may_not_speed_up(
    current: float, target: float, after: float
) -> None:
    assert slowed(
        Velocity(angular_z=current), Velocity(angular_z=target), LIMITS, 0.125
    ) == Velocity(angular_z=after)


WHEELS = msgspec.structs.replace(LIMITS, rim_speed=0.5, half_track=0.25)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("side", [1, -1])
def test_no_wheel_is_too_fast_while_one_axis_takes_over_from_the_other(
    sign: int, side: int
) -> None:
    turning, straight = Velocity(angular_z=2.0 * side), Velocity(linear_x=0.5 * sign)
    # turning loses 0.25 rad/s, which frees 0.0625 m/s of a wheel: the gain that 1/16 s allows
    assert ramp(turning, straight, WHEELS, 0.0625) == Velocity(
        linear_x=0.0625 * sign, angular_z=1.75 * side
    )
    slow = msgspec.structs.replace(WHEELS, angular_acceleration=2.0)
    assert ramp(turning, straight, slow, 0.0625) == Velocity(
        linear_x=0.03125 * sign, angular_z=1.875 * side
    )
    assert ramp(straight, turning, msgspec.structs.replace(WHEELS, half_track=1.0), 0.0625) == (
        Velocity(linear_x=0.375 * sign, angular_z=0.125 * side)
    )


def test_a_body_faster_than_its_wheels_slows_down_and_gains_no_speed() -> None:
    pushed = Velocity(linear_x=1.0, angular_z=1.0)
    assert ramp(pushed, Velocity(angular_z=2.0), WHEELS, 0.0625) == Velocity(
        linear_x=0.875, angular_z=1.0
    )
    no_track = msgspec.structs.replace(WHEELS, half_track=0.0)
    assert ramp(pushed, Velocity(angular_z=2.0), no_track, 0.0625) == Velocity(
        linear_x=0.875, angular_z=1.25
    )


@pytest.mark.parametrize("sign", [1, -1])
def test_a_stop_brakes_both_axes_fully_regardless_of_the_wheel_limit(sign: int) -> None:
    curve = Velocity(linear_x=0.25 * sign, angular_z=1.0)
    assert ramp(curve, ZERO, WHEELS, 0.0625) == Velocity(linear_x=0.125 * sign, angular_z=0.75)


def test_a_ramp_reaches_its_target_exactly() -> None:
    velocity, target = ZERO, Velocity(linear_x=0.3, linear_y=-0.1, angular_z=1.7)
    for _ in range(40):
        velocity = ramp(velocity, target, LIMITS, 0.02)
    assert velocity == target
    for _ in range(40):
        velocity = ramp(velocity, ZERO, LIMITS, 0.02)
    assert velocity == ZERO
