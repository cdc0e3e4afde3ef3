"""The MuJoCo driver, joined to the real brain over an in-memory network, in lock-step."""

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.driver import catalog, process
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.topics import IMU, INTENT, SCAN, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.headers import header_of
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DecisionConfig, DriverConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.safety import node as safety

WAFFLE = "turtlebot3_waffle"
Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]


def make_waffle(
    speed: float = 100.0, seconds: float | None = None, cameras: bool = False, **options: float
) -> MujocoDriver:
    run = Run(folder=Path(), world="arena", seed=0, speed=speed, seconds=seconds, cameras=cameras)
    robot, driver = catalog.make_driver(WAFFLE, run)
    assert isinstance(driver, MujocoDriver)
    changed = msgspec.structs.replace(driver.options, **options)
    return MujocoDriver(robot, changed, driver.run)


async def drive(driver: MujocoDriver, folder: Path) -> tuple[LocalNetwork, list[float]]:
    """Drive with the whole brain to the end; return the network and the true speeds [m/s]."""
    network, speeds = LocalNetwork(), list[float]()
    config = DriverConfig(
        body=WAFFLE,
        speed=driver.run.speed,
        resume="auto",
        state_dir=str(folder),
        lockstep_timeout_s=10.0,
    )

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
    gated = DriverProcess(config, driver.robot, driver, body)
    tasks.append(asyncio.ensure_future(gated.run(lambda: None)))
    while not driver.finished:
        await asyncio.sleep(0.01)
        assert gated.report()["lockstep_timeouts"] == 0  # the brain answered each tick
        for task in tasks:
            if task.done():
                task.result()
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    return network, speeds


async def test_a_calibrated_smaller_wheel_gives_the_commanded_speed(
    tmp_path: Path,
) -> None:
    worn = make_waffle(seconds=6.0, wheel_scale=0.9, odometry_wheel_radius=0.0297)
    _, speeds = await drive(worn, tmp_path)

    straight = speeds[-100:]  # the last 2 s; the first leg takes more than 6 s
    assert 0.196 <= sum(straight) / len(straight) <= 0.204


async def test_the_brain_drives_the_simulated_body_and_the_report_is_true(
    tmp_path: Path,
) -> None:
    driver = make_waffle(seconds=5.0)
    network, _ = await drive(driver, tmp_path)

    report = driver.report()
    assert report["sim_seconds"] == 5.0
    assert report["contacts"] == 0
    assert 0.7 <= float(report["distance_m"] or 0) <= 0.95  # 0.5 s to start, then 0.2 m/s
    assert ticks_of(network, STATE.key) == list(range(1, 251))
    scans = ticks_of(network, SCAN.key)
    assert scans == [1, *range(5, 251, 5)]  # one per 0.1 s, and one in the first tick
    assert sum(key == IMU.key for key, _ in network.sent) == 500


def ticks_of(network: LocalNetwork, key: str) -> list[int]:
    """Return the ticks of all messages on a key, without repetitions of the first one."""
    ticks = [header_of(payload).tick for sent, payload in network.sent if sent == key]
    repeated = len(list(itertools.takewhile(lambda tick: tick == ticks[0], ticks)))
    return ticks[repeated - 1 :]


async def test_the_first_tick_does_not_wait_for_ever_for_a_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "CAMERAS_S", 0.3)
    async with asyncio.timeout(60):
        network, _ = await drive(make_waffle(seconds=0.06, cameras=True), tmp_path)
    assert ticks_of(network, STATE.key) == [1, 2, 3]


async def test_two_runs_with_the_same_seed_have_equal_intents(tmp_path: Path) -> None:
    def intents(network: LocalNetwork) -> list[Intent]:
        decode = msgspec.msgpack.Decoder(Intent).decode
        intents_sent = [decode(payload) for key, payload in network.sent if key == INTENT.key]
        return [msgspec.structs.replace(i, stamp_ns=0, seq=0, boot=0) for i in intents_sent]

    first, _ = await drive(make_waffle(seconds=3.0), tmp_path / "a")
    second, _ = await drive(make_waffle(seconds=3.0), tmp_path / "b")
    assert intents(first) == intents(second)
