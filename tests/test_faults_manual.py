"""Where a person must say so, no fault ends in motion by itself."""

import os
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_zenoh.client import Robot
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate import BRAIN
from tests.onlooker import SYSTEMS, Onlooker, looking_on
from tests.stack import Home, endpoint_of, until


@pytest.fixture(scope="module")
def deployment(shared_home: Home) -> Path:
    """A Waffle that drives at its full speed once a person has let it."""
    file = shared_home.deployment(world="arena", resume="manual", decision={"linear_speed": 0.26})
    shared_home.start("up", str(file))
    return file


@pytest.fixture
async def robot(deployment: Path) -> AsyncIterator[Onlooker]:
    async with looking_on(endpoint_of(deployment)) as onlooker:
        yield onlooker


async def test_nothing_moves_until_it_is_released_and_enabled(robot: Onlooker) -> None:
    await robot.ticks(50)
    assert (robot.state.gate.mode, robot.state.gate.causes[0].code) == ("latched", "boot")
    person = Robot(robot.bus)
    with pytest.raises(Refused, match=r"latched: just started; .*release it first"):
        await person.enable(BRAIN)
    await person.release()
    await robot.ticks(50)
    assert (robot.state.gate.mode, robot.state.pose.x) == ("idle", 0.0)
    await robot.straight(by_hand=True)


@pytest.mark.parametrize("victim", [*SYSTEMS[1:], "router"])
async def test_after_a_fault_it_stands_until_a_person_enables_it(
    robot: Onlooker, victim: str
) -> None:
    pid = await robot.pid(victim)
    await robot.straight(by_hand=True)
    start = robot.state
    os.kill(pid, signal.SIGKILL)
    await until(lambda: robot.state.gate.mode == "idle", "the gate shuts")
    limit_m = 0.15 if victim == "perception" else 0.10
    assert robot.moved(start) <= limit_m
    assert await robot.pid(victim) != pid
    await until(lambda: not robot.state.gate.causes, "nothing speaks against driving any more")
    await robot.ticks(50)
    assert robot.moved(start) <= limit_m
    await robot.straight(room=0.0, by_hand=True)
    assert (await robot.truth())["stale_commands_executed"] == 0
