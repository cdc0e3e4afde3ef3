"""The MuJoCo driver alone: stops, sensors, reports and configuration errors."""

import threading
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, ConfigError, Unsupported

WAFFLE = "turtlebot3_waffle"


def make_waffle(
    speed: float = 100.0, seconds: float | None = None, **options: float
) -> MujocoDriver:
    run = Run(folder=Path(), world="arena", seed=0, speed=speed, seconds=seconds)
    robot, driver = catalog.make_driver(WAFFLE, run)
    assert isinstance(driver, MujocoDriver)
    changed = msgspec.structs.replace(driver.options, **options)
    return MujocoDriver(robot, changed, driver.run)


async def test_a_report_does_not_read_the_simulation_outside_its_thread(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    readers, report = set[str](), Simulation.report

    def account(simulation: Simulation, robot: RobotFile, run: Run) -> dict[str, object]:
        readers.add(threading.current_thread().name)
        return report(simulation, robot, run)

    monkeypatch.setattr(Simulation, "report", account)
    driver = make_waffle(seconds=1.0)
    readers.clear()  # forget reads before the thread starts
    async with driver:
        ticks = driver.ticks(Clock())
        for seconds in (0.02, 0.04):
            await anext(ticks)
            assert driver.report()["sim_seconds"] == seconds
        await ticks.aclose()  # type: ignore[attr-defined]
    assert readers == {"physics"}


async def test_the_body_stops_150_ms_after_its_last_command() -> None:
    driver = make_waffle(seconds=1.0)
    async with driver:
        ticks = driver.ticks(Clock())
        await anext(ticks)
        await driver.set_base_velocity(0.2, 0.0, 0.0)
        for _ in range(7):
            await anext(ticks)
        assert (await driver.read_state()).velocity.linear_x > 0.1
        for _ in range(20):
            await anext(ticks)
        assert abs((await driver.read_state()).velocity.linear_x) < 0.01
        await ticks.aclose()  # type: ignore[attr-defined]


async def test_stop_and_close_work_in_any_state_and_other_calls_only_when_open() -> None:
    driver = make_waffle()
    await driver.stop()
    await driver.close()
    await driver.close()
    with pytest.raises(BodyLost):
        await driver.read_state()
    with pytest.raises(BodyLost):
        await driver.set_base_velocity(0.1, 0.0, 0.0)


async def test_an_unknown_sensor_is_refused_with_the_known_ones() -> None:
    async with make_waffle() as driver:
        assert await driver.get_sensor_data("scan") is not None
        with pytest.raises(Unsupported, match="imu, scan"):
            await driver.get_sensor_data("camera")
        with pytest.raises(Unsupported, match="no joints"):
            await driver.set_joint_position("arm", 1.0)


def test_a_missing_model_file_is_named(tmp_path: Path) -> None:
    original = catalog.robot_path(WAFFLE).read_text()
    mine = tmp_path / "robot.yaml"
    mine.write_text(original)  # without its model.xml
    with pytest.raises(ConfigError, match=r"model\.xml: no such file"):
        catalog.make_driver(str(mine), Run(folder=Path(), world="arena"))


def test_an_unknown_link_is_refused_with_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="has no link 'real'; it has: sim"):
        catalog.make_driver("mock", Run(folder=Path(), link="real"))


def test_an_unknown_simulator_option_is_refused_with_its_line(
    tmp_path: Path,
) -> None:
    text = (
        catalog.robot_path(WAFFLE).read_text().replace("driver: mujoco", "driver: mujoco, mdel: x")
    )
    mine = tmp_path / "robot.yaml"
    mine.write_text(text)
    with pytest.raises(ConfigError, match=r"robot\.yaml:22: .*'mdel'; did you mean 'model'"):
        catalog.make_driver(str(mine), Run(folder=Path()))
