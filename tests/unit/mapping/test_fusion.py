"""Odometry and gyro: who is believed, when something slips, and what is no motion at all."""

import math

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import ImuData
from gigabrain_zenoh.mapping.odometry import LAG_S, OdometryFusion, uncertainty, way
from gigabrain_zenoh.mapping.slam import Slam
from gigabrain_zenoh.testing.samples import WAFFLE, state
from tests.unit.mapping.rooms import Lidar, box

LEVEL = (0.0, 0.0, 0.0, 1.0)


def seen(tick: int, pose: tuple[float, float, float], gyro: float | None = None) -> RobotState:
    imu = None
    if gyro is not None:
        imu = ImuData(
            orientation=LEVEL,
            angular_velocity=(0.0, 0.0, gyro),
            linear_acceleration=(0.0, 0.0, 9.81),
        )
    return replace(state(tick, pose=pose), imu=imu)


def fused(*states: RobotState) -> OdometryFusion:
    fusion = OdometryFusion()
    for one in states:
        fusion.add(one, WAFFLE)
    return fusion


def test_without_a_gyro_it_is_the_odometry() -> None:
    fusion = fused(seen(1, (0, 0, 0)), seen(2, (0.005, 0, 0.01)), seen(3, (0.01, 0, 0.02)))
    moment = fusion.at(3)
    assert moment
    assert moment.fused == pytest.approx((0.01, 0, 0.02))
    assert moment.odometry == pytest.approx((0.01, 0, 0.02))


def test_wheels_say_how_far_and_the_gyro_how_much_it_turned() -> None:
    """The wheels believe in a straight line of 0.5 m; it was an eighth of a circle."""
    rate = math.pi / 4 / 2.0  # [rad/s], for 100 ticks
    fusion = fused(*(seen(1 + k, (0.005 * k, 0, 0), rate) for k in range(101)))
    moment = fusion.at(101)
    assert moment
    radius = 0.5 / (math.pi / 4)
    assert moment.fused[2] == pytest.approx(math.pi / 4)
    assert moment.fused[0] == pytest.approx(radius * math.sin(math.pi / 4), abs=1e-4)
    assert moment.fused[1] == pytest.approx(radius * (1 - math.cos(math.pi / 4)), abs=1e-4)


def test_over_missing_states_the_wheels_say_how_much_it_turned() -> None:
    """The gyro reads 1 rad/s before a gap of 0.8 s, and 0 after it; the body turned by 0.3 rad."""
    before = [seen(1 + k, (0, 0, 0.02 * k), 1.0) for k in range(11)]
    fusion = fused(*before, seen(51, (0.1, 0, 0.5), 0.0), seen(52, (0.1, 0, 0.5), 0.0))
    last, moment, after = fusion.at(11), fusion.at(51), fusion.at(52)
    assert last
    assert moment
    assert after
    assert moment.fused == pytest.approx((0.1, 0, 0.5))
    assert after.fused == pytest.approx((0.1, 0, 0.5))
    by_wheels, by_gyro = way(last, moment)[1], way(moment, after)[1]
    lag = np.diag((0.0, 0.0, LAG_S)) ** 2
    expected = uncertainty(way(last, moment)[0], slipping=False) + lag * (0.3 / 0.8 - 1.0) ** 2
    assert by_wheels == pytest.approx(expected)
    still = uncertainty(np.zeros(3), slipping=False, gyro=True)
    assert by_gyro == pytest.approx(still + lag * (0.3 / 0.8) ** 2)


def test_at_rest_the_bias_of_the_gyro_is_learnt_and_the_heading_stays() -> None:
    fusion = fused(*(seen(1 + k, (0, 0, 0), 0.05) for k in range(200)))
    assert fusion.bias == pytest.approx(0.05)
    moment = fusion.at(200)
    assert moment
    assert moment.fused[2] == pytest.approx(0.05 * 0.02 * 24, abs=1e-6)  # before it was at rest
    for k in range(1, 51):
        fusion.add(seen(200 + k, (0.005 * k, 0, 0), 0.05), WAFFLE)
    after = fusion.at(250)
    assert after
    assert after.fused[2] == pytest.approx(moment.fused[2], abs=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_of_a_noisy_gyro_the_bias_is_the_mean_of_what_it_said_at_rest(seed: int) -> None:
    """A heading that drifts by 0.2 degrees a second turns the map with it."""
    readings = np.random.default_rng(seed).normal(0.01, 0.002, 35).tolist()
    fusion = fused(*(seen(1 + k, (0, 0, 0), rate) for k, rate in enumerate(readings)))
    assert fusion.bias == pytest.approx(0.01, abs=4 * 0.002 / math.sqrt(len(readings)))


def test_a_robot_that_somebody_turns_by_hand_has_turned() -> None:
    still = [seen(1 + k, (0, 0, 0), 0.0) for k in range(50)]
    fusion = fused(*still, *(seen(51 + k, (0, 0, 0), 0.5) for k in range(100)))
    moment = fusion.at(150)
    assert moment
    assert moment.fused[2] == pytest.approx(0.5 * 0.02 * 99.5)
    assert fusion.bias == pytest.approx(0.0)


@pytest.mark.parametrize("glitch", [10.0, -35.0, 1000.0])
def test_a_single_impossible_reading_of_the_gyro_turns_nothing(glitch: float) -> None:
    rates = [0.5] * 10 + [glitch] + [0.5] * 10
    fusion = fused(*(seen(1 + k, (0, 0, 0.01 * k), rate) for k, rate in enumerate(rates)))
    moment = fusion.at(len(rates))
    assert moment
    assert moment.fused[2] == pytest.approx(0.01 * 20, abs=0.01)
    assert not moment.slipping


def test_wheels_and_gyro_that_disagree_mean_slip() -> None:
    agree = fused(*(seen(1 + k, (0, 0, 0.01 * k), 0.5) for k in range(50)))
    assert not agree.slipping
    spin = fused(*(seen(1 + k, (0, 0, 0.01 * k), 0.1) for k in range(50)))
    assert spin.slipping


def test_what_slips_is_known_five_times_less() -> None:
    step = np.array((0.02, 0.0, 0.1))
    assert uncertainty(step, slipping=True) == pytest.approx(25 * uncertainty(step, slipping=False))
    assert uncertainty(np.zeros(3), slipping=False)[0, 0] == pytest.approx(0.002**2)


def test_more_than_the_body_can_do_is_a_jump_and_no_motion() -> None:
    fusion = fused(seen(1, (0, 0, 0)), seen(2, (3.0, 0, 0)), seen(3, (3.005, 0, 0)))
    moment = fusion.at(3)
    assert moment
    assert moment.jumps == 1
    assert moment.fused == pytest.approx((0.005, 0, 0))
    assert fused(seen(1, (0, 0, 0)), seen(2, (0, 0, 2.5))).at(2).jumps == 1  # type: ignore[union-attr]


def test_between_two_states_it_is_on_the_way_and_beyond_them_it_is_not_known() -> None:
    fusion = fused(seen(10, (0, 0, 0)), seen(20, (0.1, 0, 0)), seen(60, (0.1, 0, 0)))
    half = fusion.at(15)
    assert half
    assert half.fused == pytest.approx((0.05, 0, 0))
    assert [fusion.at(tick) for tick in (9, 40, 61)] == [None, None, None]


def test_an_older_state_changes_nothing() -> None:
    fusion = fused(seen(10, (0, 0, 0)), seen(11, (0.01, 0, 0)), seen(10, (5.0, 0, 0)))
    assert fusion.newest
    assert fusion.newest.fused == pytest.approx((0.01, 0, 0))


@pytest.mark.parametrize("lag", [0, 2, 4])
def test_where_odometry_is_older_than_scans_turns_do_not_bend_the_map(lag: int) -> None:
    """A node of ROS 2 sends odometry at 20 Hz, so states show turns up to 80 ms late."""
    walls = np.array([*box(-2, -2, 6, 4), (1, -2, 1, 0.6), (2.5, 2, 2.5, -0.4)])
    lidar, fusion, slam, last = Lidar(220, reach=8.0, noise=0.0), OdometryFusion(), Slam(), None
    turns = 1.9 * np.sin(np.arange(280) * 0.02 * 2.5)  # [rad/s], faster and slower within 1.3 s
    rates = np.concatenate([np.zeros(20), turns])
    yaws = np.cumsum(rates) * 0.02
    for tick in range(5, 300):
        old = max(tick - lag, 0)
        fusion.add(seen(tick, (0, 0, float(yaws[old])), float(rates[old])), WAFFLE)
        if tick % 5 == 0:
            moment = fusion.at(tick)
            assert moment
            true = np.array((0.0, 0.0, yaws[tick]))
            found = slam.add(lidar.scan(walls, true), *way(last or moment, moment))
            assert math.remainder(found.pose[2] - true[2], math.tau) == pytest.approx(0, abs=0.02)
            last = moment
