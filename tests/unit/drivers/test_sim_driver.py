"""The MuJoCo driver, joined to the real brain over an in-memory network, in lock-step."""

import asyncio
import itertools
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim import driver as sim_driver
from gigabrain_drivers.sim.account import account_of
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.topics import IMU, INTENT, SCAN, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DecisionConfig, DriverConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.errors import BodyLost, ConfigError, Unsupported
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.recording.headers import header_of
from gigabrain_zenoh.safety import node as safety

WAFFLE = "turtlebot3_waffle"
Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]


def make(speed: float = 100.0, seconds: float | None = None, **options: float) -> MujocoDriver:
    run = Run(folder=Path(), world="arena", seed=0, speed=speed, seconds=seconds)
    robot, driver = catalog.make_driver(WAFFLE, run)
    assert isinstance(driver, MujocoDriver)
    changed = msgspec.structs.replace(driver.options, **options)
    return MujocoDriver(robot, changed, driver.run)


async def drive(driver: MujocoDriver, folder: Path) -> tuple[LocalNetwork, list[float]]:
    """Let the whole brain drive until the simulation ends; the true speed at each state."""
    network, speeds = LocalNetwork(), list[float]()
    config = DriverConfig(body=WAFFLE, speed=driver.run.speed, resume="auto", state_dir=str(folder))

    def bus() -> Bus:
        return Bus(network.transport(), Clock())

    brain: tuple[Node, ...] = (
        lambda bus, ready: perception.run(PerceptionConfig(), bus, ready),
        lambda bus, ready: decision.run(DecisionConfig(), bus, ready),
        control.run,
        safety.run,
    )
    tasks = [asyncio.ensure_future(node(bus(), lambda: None)) for node in brain]
    watcher = bus()
    watcher.subscribe(STATE, lambda key, state: speeds.append(float(driver.report()["true_speed"])))  # type: ignore[arg-type]
    body = bus()
    process = DriverProcess(config, driver.robot, driver, body)
    tasks.append(asyncio.ensure_future(process.run(lambda: None)))
    while not driver.finished:
        await asyncio.sleep(0.01)
        for task in tasks:
            if task.done():
                task.result()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return network, speeds


async def test_a_wheel_that_is_ten_percent_smaller_still_gives_the_commanded_speed(
    tmp_path: Path,
) -> None:
    worn = make(seconds=6.0, wheel_scale=0.9, odometry_wheel_radius=0.0297)
    _, speeds = await drive(worn, tmp_path)

    straight = speeds[-100:]  # the last two seconds; the arena's first leg is longer than six
    assert 0.196 <= sum(straight) / len(straight) <= 0.204


async def test_the_brain_drives_the_simulated_body_and_the_report_tells_the_truth(
    tmp_path: Path,
) -> None:
    driver = make(seconds=5.0)
    network, _ = await drive(driver, tmp_path)

    report = driver.report()
    assert report["sim_seconds"] == 5.0
    assert report["contacts"] == 0
    assert 0.7 <= float(report["distance_m"] or 0) <= 0.95  # half a second to wake, then 0.2 m/s
    assert ticks_of(network, STATE.key) == list(range(1, 251))
    scans = ticks_of(network, SCAN.key)
    assert scans == [1, *range(5, 251, 5)]  # one per 0.1 s, and one for the brain to wake up by
    assert sum(key == IMU.key for key, _ in network.sent) == 500


def ticks_of(network: LocalNetwork, key: str) -> list[int]:
    """The ticks of all messages on a key; the first is announced until the brain is there."""
    ticks = [header_of(payload).tick for sent, payload in network.sent if sent == key]
    announced = len(list(itertools.takewhile(lambda tick: tick == ticks[0], ticks)))
    return ticks[announced - 1 :]


async def test_a_report_reads_nothing_that_the_physics_is_at_work_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    readers = set[str]()

    def account(simulation: Simulation, robot: RobotFile, run: Run) -> dict[str, object]:
        readers.add(threading.current_thread().name)
        return account_of(simulation, robot, run)

    monkeypatch.setattr(sim_driver, "account_of", account)
    driver = make(seconds=1.0)
    readers.clear()  # before there is a thread
    async with driver:
        ticks = driver.ticks(Clock())
        for seconds in (0.02, 0.04):
            await anext(ticks)
            assert driver.report()["sim_seconds"] == seconds
        await ticks.aclose()  # type: ignore[attr-defined]
    assert readers == {"physics"}


async def test_two_runs_with_the_same_seed_decide_alike(tmp_path: Path) -> None:
    def intents(network: LocalNetwork) -> list[Intent]:
        decode = msgspec.msgpack.Decoder(Intent).decode
        said = [decode(payload) for key, payload in network.sent if key == INTENT.key]
        return [msgspec.structs.replace(i, stamp_ns=0, seq=0, boot=0) for i in said]

    first, _ = await drive(make(seconds=3.0), tmp_path / "a")
    second, _ = await drive(make(seconds=3.0), tmp_path / "b")
    assert intents(first) == intents(second)


async def test_the_body_stops_by_itself_when_nobody_commands_it_for_150_ms() -> None:
    driver = make(seconds=1.0)
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


async def test_stop_and_close_work_in_any_state_and_the_rest_wants_an_open_body() -> None:
    driver = make()
    await driver.stop()
    await driver.close()
    await driver.close()
    with pytest.raises(BodyLost):
        await driver.read_state()
    with pytest.raises(BodyLost):
        await driver.set_base_velocity(0.1, 0.0, 0.0)


async def test_it_says_which_sensors_it_has() -> None:
    async with make() as driver:
        assert await driver.get_sensor_data("scan") is not None
        with pytest.raises(Unsupported, match="scan, imu"):
            await driver.get_sensor_data("camera")
        with pytest.raises(Unsupported, match="no joints"):
            await driver.set_joint_position("arm", 1.0)


def test_a_model_that_is_not_there_is_named(tmp_path: Path) -> None:
    original = catalog.robot_path(WAFFLE).read_text()
    mine = tmp_path / "robot.yaml"
    mine.write_text(original)  # its model.xml stays behind
    with pytest.raises(ConfigError, match=r"model\.xml: No such file"):
        catalog.make_driver(str(mine), Run(folder=Path(), world="arena"))


def test_a_link_that_the_body_does_not_have_lists_those_that_it_has() -> None:
    with pytest.raises(ConfigError, match="has no link 'real'; it has: sim"):
        catalog.make_driver("mock", Run(folder=Path(), link="real"))


def test_an_option_of_the_simulator_that_does_not_exist_is_refused_with_its_line(
    tmp_path: Path,
) -> None:
    text = (
        catalog.robot_path(WAFFLE).read_text().replace("driver: mujoco", "driver: mujoco, mdel: x")
    )
    mine = tmp_path / "robot.yaml"
    mine.write_text(text)
    with pytest.raises(ConfigError, match=r"robot\.yaml:19: .*'mdel'; did you mean 'model'"):
        catalog.make_driver(str(mine), Run(folder=Path()))
