"""The driver's process: what it publishes of the body, and when."""

import asyncio
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_drivers.bodies.mock.driver import MockBody, MockOptions
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import Run
from gigabrain_schemas.base import TICK_NS, Message, Velocity
from gigabrain_schemas.body import ArmModel, Battery, Body, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.sim import SimScene
from gigabrain_schemas.topics import ARM_MODEL, BODY, CMD_VEL, SIM_SCENE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.restoring import NO_HEADER
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.testing.in_memory import RobotInMemory

MODEL = ArmModel(mjcf="its own")
SCENE = SimScene(
    version=1, world="arena", bodies=("world",), kinds=b"", owners=b"", sizes=b"", places=b"",
    colours=b"",
)  # fmt: skip


class HeldUp(MockBody):
    """A body whose process is always held up: it makes up for seven ticks at a time."""

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        while True:
            await clock.sleep_ns(7 * TICK_NS)
            yield 7


async def test_the_body_is_described_once_a_second_whatever_ticks_are_missed(
    tmp_path: Path,
) -> None:
    network, clock, told = LocalNetwork(), FakeClock(), list[int]()
    watcher = Bus(network.transport(), clock)
    watcher.subscribe(BODY, lambda _key, body: told.append(body.tick))
    driver = HeldUp(load_robot("mock"), MockOptions(driver="mock"), Run(folder=Path()))
    config = DriverConfig(body="mock", state_dir=str(tmp_path))
    bus = Bus(network.transport(), clock, "driver")
    running = asyncio.ensure_future(
        DriverProcess(config, driver.robot, driver, bus).run(lambda: None)
    )
    await clock.advance(168 * TICK_NS)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert told == [0, 56, 112, 168]


class WithArm(HeldUp):
    """A body whose arm has a model."""

    def arm_model(self) -> ArmModel:
        return MODEL


@pytest.mark.parametrize(
    ("topic", "own", "other"),
    [(ARM_MODEL, MODEL, ArmModel(mjcf="<")), (SIM_SCENE, SCENE, replace(SCENE, version=9))],
)
async def test_what_another_sender_replaced_is_published_again_once(
    tmp_path: Path, topic: Topic[Any], own: Message, other: Message
) -> None:
    network, clock, told = LocalNetwork(), FakeClock(), list[tuple[int, Message]]()
    driver = WithArm(load_robot("mock"), MockOptions(driver="mock"), Run(folder=Path()))
    config = DriverConfig(body="mock", state_dir=str(tmp_path))
    bus, stranger = Bus(network.transport(), clock, "driver"), Bus(network.transport(), clock)
    process = DriverProcess(config, driver.robot, driver, bus)
    stranger.subscribe(topic, lambda _key, one: told.append((one.tick, replace(one, **NO_HEADER))))
    running = asyncio.ensure_future(process.run(lambda: None))
    await clock.advance(TICK_NS)
    driver.emit(SIM_SCENE, SCENE)
    await clock.advance(27 * TICK_NS)
    (first,) = told
    stranger.publish(topic, other)
    await clock.advance(400 * TICK_NS)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert [first[1], *told[1:]] == [own, (0, other), (56, own)]


async def test_another_description_of_the_body_is_replaced_at_the_next_tick(
    tmp_path: Path,
) -> None:
    network, clock, told = LocalNetwork(), FakeClock(), list[tuple[int, str]]()
    driver = HeldUp(load_robot("mock"), MockOptions(driver="mock"), Run(folder=Path()))
    config = DriverConfig(body="mock", state_dir=str(tmp_path))
    bus, stranger = Bus(network.transport(), clock, "driver"), Bus(network.transport(), clock)
    process = DriverProcess(config, driver.robot, driver, bus)
    running = asyncio.ensure_future(process.run(lambda: None))
    await clock.advance(28 * TICK_NS)
    stranger.subscribe(BODY, lambda _key, one: told.append((one.tick, one.link)))
    stranger.publish(BODY, Body(description=driver.robot.description(), link="emulated"))
    await clock.advance(70 * TICK_NS)
    running.cancel()
    await asyncio.gather(running, return_exceptions=True)
    assert told == [(0, "emulated"), (35, "sim"), (56, "sim")]


@pytest.mark.long
async def test_a_state_has_what_the_body_was_commanded_last(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        for _ in range(200):
            await robot.go(1)
            assert robot.state
            assert robot.state.sent == Velocity(linear_x=robot.body.speeds[-1])
        assert robot.state.sent == Velocity(linear_x=0.26)


@pytest.mark.long
async def test_what_comes_just_before_a_tick_counts_as_commanded_before_it(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await robot.go(200)
        brain, read = robot.operator, robot.body.read_state
        brain.sent[CMD_VEL.key] = 10**6  # so it is these that the gate obeys
        speeds, wanted = [0.26], [0.0, 0.0, 0.26, 0.0, 0.26, 0.26] * 20

        async def read_after_a_command() -> RobotState:
            assert robot.state
            speeds.append(robot.state.sent.linear_x)
            command = CmdVel(linear_x=wanted.pop(), source="control")
            brain.publish(CMD_VEL, command, basis=brain.time.tick)
            return await read()

        robot.body.read_state = read_after_a_command  # type: ignore[method-assign]
        await robot.go(100)
        assert robot.mode == "enabled"
        changes = [after - before for before, after in pairwise(speeds)]
        assert -0.04 - 1e-9 <= min(changes) < 0 < max(changes) <= 0.02 + 1e-9


async def test_a_battery_in_millivolts_costs_no_state_and_is_logged_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        read = robot.body.read_state

        async def in_millivolts() -> RobotState:
            return replace(await read(), battery=Battery(voltage=12_600.0, percentage=50.0))

        robot.body.read_state = in_millivolts  # type: ignore[method-assign]
        await robot.go(10)
        assert robot.state
        assert robot.state.battery == Battery(voltage=1000.0, percentage=50.0)
        (logged,) = [one for one in caplog.messages if "clipped" in one]
        assert logged == (
            "the body's state was clipped to its bounds: "
            "Expected `float` <= 1000.0 - at `$.battery.voltage`; is it in another unit?"
        )
