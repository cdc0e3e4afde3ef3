"""Alpha with `--link sim`: the MuJoCo driver with a quadruped."""

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.kinematics.legs import JOINT_NAMES
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost


def make_driver() -> MujocoDriver:
    _, driver = catalog.make_driver("alpha", Run(folder=Path(), world="arena", speed=100.0))
    assert isinstance(driver, MujocoDriver)
    return driver


async def test_it_walks_sideways_and_reports_joints_and_odometry() -> None:
    driver = make_driver()
    async with driver:
        ticks = driver.ticks(Clock())
        for _ in range(150):
            sent = await driver.set_base_velocity(0.1, 0.15, 0.0)
            await anext(ticks)
        state = await driver.read_state()
        await ticks.aclose()  # type: ignore[attr-defined]
    assert (sent.linear_x, sent.linear_y, sent.angular_z) == pytest.approx((0.1, 0.15, 0.0))
    assert state.velocity.linear_y == pytest.approx(0.15, abs=0.05)
    assert state.pose.y > 1.2 * state.pose.x > 0.1
    assert tuple(joint.name for joint in state.joints) == JOINT_NAMES
    assert all(25 <= joint.temperature < 40 for joint in state.joints if joint.temperature)
    assert driver.report()["contacts"] == 0


async def test_it_comes_to_rest_without_commands() -> None:
    driver = make_driver()
    async with driver:
        ticks = driver.ticks(Clock())
        for _ in range(60):
            await driver.set_base_velocity(0.3, 0.0, 0.0)
            await anext(ticks)
        for _ in range(50):
            await anext(ticks)
        state = await driver.read_state()
        await ticks.aclose()  # type: ignore[attr-defined]
    assert abs(state.velocity.linear_x) < 0.03


async def test_a_body_that_has_fallen_over_is_lost() -> None:
    driver = make_driver()
    async with driver:
        ticks = driver.ticks(Clock())
        await anext(ticks)
        driver._simulation.data.qpos[3:7] = (0.5, 0.866, 0.0, 0.0)  # on its side
        with pytest.raises(BodyLost, match="fell over"):
            await _drain(ticks)
        await ticks.aclose()  # type: ignore[attr-defined]


async def _drain(ticks: AsyncIterator[int]) -> None:
    for _ in range(20):
        await anext(ticks)


def test_its_file_has_its_speed_limits_and_drive_type() -> None:
    robot = catalog.load_robot("alpha")
    assert (robot.max_linear_speed, robot.max_lateral_speed) == (0.5, 0.2)
    assert robot.max_angular_speed == 1.0
    assert robot.drive_type == "quadruped"
