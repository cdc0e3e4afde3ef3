"""Fusion of odometry and gyro: turns, slip, jumps, glitches and the gyro's bias."""

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


def state_at(tick: int, pose: tuple[float, float, float], gyro: float | None = None) -> RobotState:
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
    for robot_state in states:
        fusion.add(robot_state, WAFFLE)
    return fusion


def test_without_a_gyro_the_fused_pose_is_the_odometry() -> None:
    fusion = fused(
        state_at(1, (0, 0, 0)), state_at(2, (0.005, 0, 0.01)), state_at(3, (0.01, 0, 0.02))
    )
    sample = fusion.at(3)
    assert sample
    assert sample.fused == pytest.approx((0.01, 0, 0.02))
    assert sample.odometry == pytest.approx((0.01, 0, 0.02))


def test_distances_come_from_the_wheels_and_turns_from_the_gyro() -> None:
    """The wheels measure a straight line of 0.5 m; the motion is an eighth of a circle."""
    rate = math.pi / 4 / 2.0  # [rad/s], for 100 ticks
    fusion = fused(*(state_at(1 + k, (0.005 * k, 0, 0), rate) for k in range(101)))
    sample = fusion.at(101)
    assert sample
    radius = 0.5 / (math.pi / 4)
    assert sample.fused[2] == pytest.approx(math.pi / 4)
    assert sample.fused[0] == pytest.approx(radius * math.sin(math.pi / 4), abs=1e-4)
    assert sample.fused[1] == pytest.approx(radius * (1 - math.cos(math.pi / 4)), abs=1e-4)


def test_over_missing_states_the_turn_comes_from_the_wheels() -> None:
    """The gyro reads 1 rad/s before a gap of 0.8 s, and 0 after it; the body turned by 0.3 rad."""
    before = [state_at(1 + k, (0, 0, 0.02 * k), 1.0) for k in range(11)]
    fusion = fused(*before, state_at(51, (0.1, 0, 0.5), 0.0), state_at(52, (0.1, 0, 0.5), 0.0))
    last, sample, after = fusion.at(11), fusion.at(51), fusion.at(52)
    assert last
    assert sample
    assert after
    assert sample.fused == pytest.approx((0.1, 0, 0.5))
    assert after.fused == pytest.approx((0.1, 0, 0.5))
    by_wheels, by_gyro = way(last, sample)[1], way(sample, after)[1]
    lag = np.diag((0.0, 0.0, LAG_S)) ** 2
    expected = uncertainty(way(last, sample)[0], slipping=False) + lag * (0.3 / 0.8 - 1.0) ** 2
    assert by_wheels == pytest.approx(expected)
    still = uncertainty(np.zeros(3), slipping=False, gyro=True)
    assert by_gyro == pytest.approx(still + lag * (0.3 / 0.8) ** 2)


def test_at_rest_the_bias_of_the_gyro_is_learnt_and_the_heading_stays() -> None:
    fusion = fused(*(state_at(1 + k, (0, 0, 0), 0.05) for k in range(200)))
    assert fusion.bias == pytest.approx(0.05)
    sample = fusion.at(200)
    assert sample
    assert sample.fused[2] == pytest.approx(0.05 * 0.02 * 24, abs=1e-6)  # before it was at rest
    for k in range(1, 51):
        fusion.add(state_at(200 + k, (0.005 * k, 0, 0), 0.05), WAFFLE)
    after = fusion.at(250)
    assert after
    assert after.fused[2] == pytest.approx(sample.fused[2], abs=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_the_bias_of_a_noisy_gyro_is_the_mean_of_its_readings_at_rest(seed: int) -> None:
    """A heading that drifts by 0.2 degrees a second turns the map with it."""
    readings = np.random.default_rng(seed).normal(0.01, 0.002, 35).tolist()
    fusion = fused(*(state_at(1 + k, (0, 0, 0), rate) for k, rate in enumerate(readings)))
    assert fusion.bias == pytest.approx(0.01, abs=4 * 0.002 / math.sqrt(len(readings)))


def test_a_robot_that_is_turned_by_hand_turns() -> None:
    still = [state_at(1 + k, (0, 0, 0), 0.0) for k in range(50)]
    fusion = fused(*still, *(state_at(51 + k, (0, 0, 0), 0.5) for k in range(100)))
    sample = fusion.at(150)
    assert sample
    assert sample.fused[2] == pytest.approx(0.5 * 0.02 * 99.5)
    assert fusion.bias == pytest.approx(0.0)


@pytest.mark.parametrize("glitch", [10.0, -35.0, 1000.0])
def test_a_single_impossible_reading_of_the_gyro_does_not_turn_the_pose(glitch: float) -> None:
    rates = [0.5] * 10 + [glitch] + [0.5] * 10
    fusion = fused(*(state_at(1 + k, (0, 0, 0.01 * k), rate) for k, rate in enumerate(rates)))
    sample = fusion.at(len(rates))
    assert sample
    assert sample.fused[2] == pytest.approx(0.01 * 20, abs=0.01)
    assert not sample.slipping


def test_wheels_and_gyro_that_disagree_mean_slip() -> None:
    agree = fused(*(state_at(1 + k, (0, 0, 0.01 * k), 0.5) for k in range(50)))
    assert not agree.slipping
    spin = fused(*(state_at(1 + k, (0, 0, 0.01 * k), 0.1) for k in range(50)))
    assert spin.slipping


def test_slip_makes_odometry_five_times_less_certain() -> None:
    step = np.array((0.02, 0.0, 0.1))
    assert uncertainty(step, slipping=True) == pytest.approx(25 * uncertainty(step, slipping=False))
    assert uncertainty(np.zeros(3), slipping=False)[0, 0] == pytest.approx(0.002**2)


def test_a_step_larger_than_the_body_can_do_is_a_jump_and_no_motion() -> None:
    fusion = fused(state_at(1, (0, 0, 0)), state_at(2, (3.0, 0, 0)), state_at(3, (3.005, 0, 0)))
    sample = fusion.at(3)
    assert sample
    assert sample.jumps == 1
    assert sample.fused == pytest.approx((0.005, 0, 0))
    assert fused(state_at(1, (0, 0, 0)), state_at(2, (0, 0, 2.5))).at(2).jumps == 1  # type: ignore[union-attr]


def test_poses_are_interpolated_between_states_and_unknown_outside() -> None:
    fusion = fused(state_at(10, (0, 0, 0)), state_at(20, (0.1, 0, 0)), state_at(60, (0.1, 0, 0)))
    half = fusion.at(15)
    assert half
    assert half.fused == pytest.approx((0.05, 0, 0))
    assert [fusion.at(tick) for tick in (9, 40, 61)] == [None, None, None]


def test_an_older_state_changes_nothing() -> None:
    fusion = fused(state_at(10, (0, 0, 0)), state_at(11, (0.01, 0, 0)), state_at(10, (5.0, 0, 0)))
    assert fusion.newest
    assert fusion.newest.fused == pytest.approx((0.01, 0, 0))


@pytest.mark.parametrize("lag", [0, 2, 4])
def test_turns_do_not_bend_the_map_if_odometry_is_older_than_scans(lag: int) -> None:
    """A node of ROS 2 sends odometry at 20 Hz, so states show turns up to 80 ms late."""
    walls = np.array([*box(-2, -2, 6, 4), (1, -2, 1, 0.6), (2.5, 2, 2.5, -0.4)])
    lidar, fusion, slam, last = Lidar(220, reach=8.0, noise=0.0), OdometryFusion(), Slam(), None
    turns = 1.9 * np.sin(np.arange(280) * 0.02 * 2.5)  # [rad/s], faster and slower within 1.3 s
    rates = np.concatenate([np.zeros(20), turns])
    yaws = np.cumsum(rates) * 0.02
    for tick in range(5, 300):
        state_tick = max(tick - lag, 0)
        fusion.add(
            state_at(tick, (0, 0, float(yaws[state_tick])), float(rates[state_tick])), WAFFLE
        )
        if tick % 5 == 0:
            sample = fusion.at(tick)
            assert sample
            true = np.array((0.0, 0.0, yaws[tick]))
            found = slam.add(lidar.scan(walls, true), *way(last or sample, sample))
            assert math.remainder(found.pose[2] - true[2], math.tau) == pytest.approx(0, abs=0.02)
            last = sample
