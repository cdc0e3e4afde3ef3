"""An exception in a thread or in a message handler ends its process."""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import emulated_body
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork, LocalTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DriverConfig, Endpoint, ProcessConfig
from gigabrain_zenoh.launch import process
from gigabrain_zenoh.testing.waiting import until

WAFFLE = "turtlebot3_waffle"
PATIENCE_S = 20.0


def raise_at_step(monkeypatch: pytest.MonkeyPatch, step: int) -> None:
    """Let the physics raise in the given step."""
    advance, steps = Simulation.advance, iter(range(1, 1_000_000))

    def advance_or_raise(simulation: Simulation) -> None:
        if next(steps) == step:
            raise FloatingPointError("mj_step: divided by zero")
        advance(simulation)

    monkeypatch.setattr(Simulation, "advance", advance_or_raise)


@pytest.mark.parametrize("step", [1, 2, 25])
async def test_a_physics_step_that_raises_ends_the_driver(
    step: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    raise_at_step(monkeypatch, step)
    robot, driver = catalog.make_driver(WAFFLE, Run(folder=Path()))
    assert isinstance(driver, MujocoDriver)
    config = DriverConfig(body=WAFFLE, state_dir=str(tmp_path))
    bus = Bus(LocalNetwork().transport(), Clock(), "driver")
    node = DriverProcess(config, robot, driver, bus).run(lambda: None)
    with pytest.raises(ExceptionGroup) as ended:
        await asyncio.wait_for(node, PATIENCE_S)
    assert "mj_step: divided by zero" in str(ended.value.exceptions[0])


async def test_a_scan_that_raises_ends_the_driver(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robot, driver = catalog.make_driver(WAFFLE, Run(folder=Path()))
    config = DriverConfig(body=WAFFLE, state_dir=str(tmp_path))
    bus = Bus(LocalNetwork().transport(), Clock(), "driver")

    def ready() -> None:
        monkeypatch.setattr(Simulation, "scan", lambda _simulation: 1 / 0)

    node = DriverProcess(config, robot, driver, bus).run(ready)
    with pytest.raises(ExceptionGroup, match="unhandled"):
        await asyncio.wait_for(node, PATIENCE_S)


async def test_an_exception_of_the_physics_sets_lost_in_the_emulator(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The emulator's process ends with the text in `lost`."""
    raise_at_step(monkeypatch, 5)
    body = emulated_body(WAFFLE, Run(folder=Path()))
    body.start()
    try:
        await until(lambda: body.lost)
        assert body.lost == "FloatingPointError: mj_step: divided by zero"
    finally:
        await body.close()


async def test_a_handler_that_raises_ends_an_otherwise_waiting_process(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    network = LocalNetwork()

    async def join(_: Endpoint) -> LocalTransport:
        return network.transport()

    async def node(bus: Bus, ready: Callable[[], None]) -> None:
        bus.subscribe(CMD_VEL, lambda _key, _command: 1 / 0)
        ready()
        await asyncio.Event().wait()

    monkeypatch.setattr("gigabrain_zenoh.runtime.connect.open_session", join)
    config = ProcessConfig(name="control", endpoint=Endpoint())
    work = process._work(config, process.ProcessType("control:run"), node, Bus)
    working = asyncio.ensure_future(asyncio.wait_for(work, PATIENCE_S))
    sender = Bus(network.transport(), Clock())
    while not working.done():
        sender.publish(CMD_VEL, CmdVel(linear_x=0.1, source="anybody"))
        await asyncio.sleep(0.01)
    with pytest.raises(process._ReportedError) as ended:
        working.result()
    assert ended.value.exit_code == 1
    (died,) = [one for one in caplog.records if one.levelname == "CRITICAL"]
    assert "died of ZeroDivisionError: division by zero, in test_thread_faults.py:" in died.message
