"""Both TurtleBot3 as their files describe them: real ports, and whole emulated robots."""

import asyncio
import math
from pathlib import Path

import pytest

from gigabrain_drivers.driver.catalog import make_driver, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import Emulator
from gigabrain_schemas.base import Message
from gigabrain_schemas.sensors import Imu, LaserScan
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing.waiting import until

ROBOTS = ["turtlebot3_burger", "turtlebot3_waffle"]


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_real_link_has_the_board_and_the_lidar_on_usb(robot: str) -> None:
    _, driver = make_driver(robot, Run(folder=Path(), link="real"))
    assert driver.options.port == "usb:0483:5740"
    assert driver.options.scan.port == "usb:10c4:ea60"


def test_a_real_link_may_have_another_lidar_than_the_simulation() -> None:
    real, _ = make_driver("turtlebot3_waffle", Run(folder=Path(), link="real"))
    simulated, _ = make_driver("turtlebot3_waffle", Run(folder=Path()))
    assert real.lidar
    assert simulated.lidar
    assert (real.lidar.beams, real.lidar.range_max) == (220, 8.0)
    assert (simulated.lidar.beams, simulated.lidar.range_max) == (360, 3.5)


@pytest.mark.parametrize("robot", ROBOTS)
async def test_the_emulated_robot_drives_and_sees(robot: str, tmp_path: Path) -> None:
    run = Run(folder=Path(), link="emulated", emulator=str(tmp_path))
    description, driver = make_driver(robot, run)
    seen: list[Message] = []

    def take(_: Topic[Message], message: Message) -> None:
        seen.append(message)

    driver.emit = take
    async with asyncio.timeout(120), Emulator(robot, run) as emulator:
        async with driver:
            async for _ in driver.ticks(Clock()):
                state = await driver.read_state()
                await driver.set_base_velocity(0.1, 0.0, 0.0)
                scans = [message for message in seen if isinstance(message, LaserScan)]
                if scans and state.pose.x > 0.02:
                    break
            assert emulator.body.snapshot.odometry.x > 0.01
            assert any(isinstance(message, Imu) for message in seen)
            assert await driver.get_sensor_data("scan") is scans[-1]
            assert description.lidar
            assert len(scans[-1].ranges_m) == description.lidar.beams
        await until(lambda: emulator.body.commanded == (0.0, 0.0, 0.0))  # wait for the last zero


@pytest.mark.parametrize(("rate", "refused"), [("10", True), ("5", False)])
def test_an_lds01_is_refused_at_other_than_five_turns_a_second(
    rate: str, refused: bool, tmp_path: Path
) -> None:
    mine = tmp_path / "robot.yaml"
    text = robot_path("turtlebot3_burger").read_text()
    assert "driver: lds03" in text
    assert "rate_hz: 10" in text
    mine.write_text(
        text.replace("driver: lds03", "driver: lds01").replace("rate_hz: 10", f"rate_hz: {rate}")
    )
    run = Run(folder=Path(), link="real")
    if refused:
        with pytest.raises(
            ConfigError, match=r"robot.yaml:24: real.scan: .* lds01 makes 5 turns a second"
        ):
            make_driver(str(mine), run)
    else:
        assert make_driver(str(mine), run)[1].options.scan.driver == "lds01"


def test_the_speed_limit_of_the_burger_is_61_rpm_of_its_motors() -> None:
    robot, _ = make_driver("turtlebot3_burger", Run(folder=Path()))
    assert robot.max_linear_speed == pytest.approx(61 / 60 * math.tau * 0.033, rel=0.005)
    assert robot.max_angular_speed == pytest.approx(61 / 60 * math.tau * 0.033 / 0.08, rel=0.005)
    assert (robot.max_linear_speed, robot.max_angular_speed) == (0.21, 2.63)
