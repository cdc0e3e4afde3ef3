"""Obstacles are added to a simulated world over the bus, and the robot's brain stops for them."""

import asyncio
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.logs import AcceptedRequest
from gigabrain_schemas.sim import SimReply, SimRequest, SimScene, Thing
from gigabrain_schemas.topics import (
    BODY,
    REQUEST_LOG,
    SIM_CHANGE,
    SIM_POSES,
    SIM_SCENE,
    STATE,
    WORLD,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DecisionConfig, DriverConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.testing.waiting import until

Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]
BRAIN: tuple[Node, ...] = (
    lambda bus, ready: perception.run(PerceptionConfig(), bus, ready),
    lambda bus, ready: decision.run(DecisionConfig(), bus, ready),
    control.run,
    safety.run,
)


@asynccontextmanager
async def running_robot(
    driver: Driver, folder: Path, brain: tuple[Node, ...] = ()
) -> AsyncIterator[tuple[LocalNetwork, Bus]]:
    """Run a driver's process and a brain in memory; yield the network and an operator's bus."""
    network = LocalNetwork()

    def bus(name: str) -> Bus:
        return Bus(network.transport(), Clock(), name)

    config = DriverConfig(
        body=driver.robot.robot_type,
        link=driver.run.link,
        speed=driver.run.speed,
        resume="auto" if driver.run.link == "sim" else "manual",
        state_dir=str(folder),
        lockstep_timeout_s=10.0,
    )
    process = DriverProcess(config, driver.robot, driver, bus("driver"))
    tasks = [asyncio.ensure_future(node(bus("brain"), lambda: None)) for node in brain]
    ready = asyncio.Event()
    tasks.append(asyncio.ensure_future(process.run(ready.set)))
    await ready.wait()
    try:
        yield network, bus("person")
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def ask(bus: Bus, **fields: object) -> SimReply:
    (reply,) = await bus.ask(SIM_CHANGE, SimRequest(**fields), timeout_s=5.0)  # type: ignore[arg-type]
    return reply


def payloads_on(network: LocalNetwork, key: str) -> list[bytes]:
    return [payload for at, payload in network.sent if at == key]


async def test_a_robot_stops_for_a_box_added_in_its_way(tmp_path: Path) -> None:
    run = Run(folder=Path(), world="arena", seed=0, speed=20.0, seconds=9.0)
    _, driver = catalog.make_driver("turtlebot3_waffle", run)
    async with running_robot(driver, tmp_path, BRAIN) as (network, operator):
        states = operator.latest(STATE)
        await until(lambda: states.newest is not None and states.newest.velocity.linear_x > 0.15)
        before = await ask(operator)
        assert before.ok
        assert before.robot
        pose = before.robot
        x, y = pose.x + 0.75 * math.cos(pose.yaw), pose.y + 0.75 * math.sin(pose.yaw)
        box = Thing(x=x, y=y, yaw=pose.yaw, size=(0.3, 0.8, 0.5))
        reply = await ask(operator, do="add", thing=box, source="ann")
        assert reply.ok, reply.text
        assert [thing.name for thing in reply.things] == ["box1"]
        await until(lambda: driver.finished)
        assert driver.report()["contacts"] == 0
        assert 0.0 < float(driver.report()["min_clearance_m"] or 0) < 0.6
    log = [
        msgspec.msgpack.decode(one, type=AcceptedRequest)
        for one in payloads_on(network, REQUEST_LOG.key)
        if b"sim_change" in one
    ]
    assert len(log) == 1
    assert (log[0].process, log[0].service) == ("driver", SIM_CHANGE.key)
    assert '"source":"ann"' in log[0].request
    scenes = [
        msgspec.msgpack.decode(one, type=SimScene) for one in payloads_on(network, SIM_SCENE.key)
    ]
    assert [len(scene.things) for scene in scenes] == [0, 1]
    assert len(payloads_on(network, SIM_POSES.key)) >= 40
    assert payloads_on(network, WORLD.key)


async def test_a_refused_request_has_a_reason_and_is_not_logged(tmp_path: Path) -> None:
    _, driver = catalog.make_driver("turtlebot3_waffle", Run(folder=Path(), world="arena"))
    async with running_robot(driver, tmp_path) as (network, operator):
        assert (await ask(operator, do="remove", name="box9")).text.startswith("no object 'box9'")
        assert "outside the world" in (await ask(operator, do="add", thing=Thing(x=50.0))).text
        assert not (await ask(operator, do="add")).ok
    assert not payloads_on(network, REQUEST_LOG.key)


@pytest.mark.parametrize(
    ("link", "why"),
    [("sim", "mock has no simulated world: it is MockBody, no"), ("real", "it is a real body")],
)
async def test_requests_are_refused_without_a_simulated_world(
    link: str, why: str, tmp_path: Path
) -> None:
    _, driver = catalog.make_driver("mock", Run(folder=Path()))
    driver.run = msgspec.structs.replace(driver.run, link=link)
    async with running_robot(driver, tmp_path) as (network, operator):
        reply = await ask(operator)
    assert not reply.ok
    assert why in reply.text
    assert payloads_on(network, BODY.key)
    assert not payloads_on(network, SIM_SCENE.key)


async def test_a_request_while_time_stands_still_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gigabrain_drivers.sim.live_world.ANSWER_S", 0.05)
    run = Run(folder=Path(), world="arena", speed=2.0)
    _, driver = catalog.make_driver("turtlebot3_waffle", run)
    async with running_robot(driver, tmp_path) as (_, operator):  # without a brain no tick ends
        await asyncio.sleep(0.2)
        reply = await ask(operator, do="add", thing=Thing(x=1.0))
    assert "stands still" in reply.text
