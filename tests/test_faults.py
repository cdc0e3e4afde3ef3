"""Processes are killed and frozen while the robot drives; judged by the robot's own clock."""

import asyncio
import os
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_schemas.body import RobotState
from tests.onlooker import Onlooker, looking_on
from tests.stack import Home, endpoint_of, until

SYSTEMS = [("perception", 0.15), ("decision", 0.10), ("control", 0.10), ("safety", 0.10)]


@pytest.fixture(scope="module")
def deployment(shared_home: Home) -> Path:
    """A Waffle that drives at its full speed and goes on by itself after a fault."""
    file = shared_home.deployment(world="arena", resume="auto", decision={"linear_speed": 0.26})
    shared_home.start("up", str(file))
    return file


@pytest.fixture
async def robot(deployment: Path) -> AsyncIterator[Onlooker]:
    async with looking_on(endpoint_of(deployment)) as onlooker:
        yield onlooker


async def stops_within(robot: Onlooker, start: RobotState, limit_m: float) -> None:
    """The body comes to rest soon after `start`, and nothing moves it before the gate reopens."""
    await until(lambda: robot.state.gate.mode == "idle", "the gate shuts")
    assert robot.travel_until_rest(start) <= limit_m


async def goes_on(robot: Onlooker) -> None:
    """It drives again by itself; nothing stale has moved it, and it has touched nothing."""
    await robot.straight(room=0.0)
    truth = await robot.truth()
    assert (truth["stale_commands_executed"], truth["contacts"]) == (0, 0)


@pytest.mark.parametrize(("victim", "limit_m"), SYSTEMS)
async def test_a_killed_system_stops_the_body_and_is_restarted(
    robot: Onlooker, victim: str, limit_m: float
) -> None:
    pid = await robot.pid(victim)
    await robot.straight()
    start = robot.state
    os.kill(pid, signal.SIGKILL)
    await stops_within(robot, start, limit_m)
    await goes_on(robot)
    assert await robot.pid(victim) != pid


@pytest.mark.parametrize(("victim", "limit_m"), SYSTEMS)
async def test_a_frozen_system_stops_the_body_until_it_thaws(
    robot: Onlooker, victim: str, limit_m: float
) -> None:
    pid = await robot.pid(victim)
    await robot.straight()
    start = robot.state
    os.kill(pid, signal.SIGSTOP)
    try:
        await stops_within(robot, start, limit_m)
        await robot.ticks(250 if victim == "decision" else 40)
        assert robot.state.gate.mode == "idle"
        assert robot.moved(start) <= limit_m
    finally:
        os.kill(pid, signal.SIGCONT)
    await goes_on(robot)
    assert await robot.pid(victim) == pid


@pytest.mark.parametrize("victim", ["router", "driver"])
async def test_what_was_said_while_all_stood_still_moves_nothing(
    robot: Onlooker, victim: str
) -> None:
    pid = await robot.pid(victim)
    await robot.straight()
    start = robot.state
    os.kill(pid, signal.SIGSTOP)
    await asyncio.sleep(1.0)
    os.kill(pid, signal.SIGCONT)
    await until(lambda: robot.state.gate.enables > start.gate.enables, "it goes on by itself")
    await goes_on(robot)


async def test_a_killed_router_is_restarted_and_all_find_it_again(robot: Onlooker) -> None:
    await robot.straight()
    start = robot.state
    os.kill(await robot.pid("router"), signal.SIGKILL)
    await until(lambda: robot.state.gate.enables > start.gate.enables, "it goes on by itself")
    await goes_on(robot)


async def test_a_killed_driver_comes_back_latched_and_then_goes_on(robot: Onlooker) -> None:
    pid = await robot.pid("driver")
    await robot.straight()
    before = robot.state
    os.kill(pid, signal.SIGKILL)
    await until(lambda: robot.state.boot != before.boot, "the driver's restart")
    first = next(state for state in robot.states if state.boot != before.boot)
    assert (first.gate.mode, first.gate.causes[0].code) == ("latched", "boot")
    assert (first.velocity.linear_x, first.gate.enables) == (0.0, 0)
    await goes_on(robot)
