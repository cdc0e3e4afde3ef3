"""An SO-101's driver on a real pty."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech.driver import FeetechDriver
from gigabrain_drivers.driver.robot import Run
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing.waiting import until
from tests.system.servos import emulated_arm
from tests.unit.drivers.feetech import FOLDER, OPTIONS, ROBOT


def arm_on(port: Path) -> FeetechDriver:
    return FeetechDriver(
        ROBOT, replace(OPTIONS, port=str(port)), Run(folder=FOLDER, link="emulated")
    )


async def test_a_second_driver_on_the_same_port_is_refused_and_the_first_goes_on(
    tmp_path: Path,
) -> None:
    port = tmp_path / "base"
    async with emulated_arm(port), arm_on(port) as first:
        await until(lambda: not first.problem)
        second = arm_on(port)
        with pytest.raises(ConfigError, match=r"base is in use by pid \d+"):
            await second.open()
        await second.close()
        await until(lambda: not first.problem)


async def test_the_driver_waits_for_a_missing_arm(tmp_path: Path) -> None:
    port = tmp_path / "base"
    async with arm_on(port) as driver:
        assert "is it plugged in?" in driver.problem
        assert not (await driver.read_state()).link.connected
        async with emulated_arm(port):
            await until(lambda: not driver.problem)
