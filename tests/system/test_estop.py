"""The e-stop, pressed while the robot drives: it latches, also across a restart of the driver."""

import os
import re
import signal
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from gigabrain_schemas.requests import ReleaseRequest
from gigabrain_schemas.topics import RELEASE
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.qa.probe import Probe, at_rest, path_until_rest, probing
from gigabrain_zenoh.testing.processes import Home, endpoint_of
from gigabrain_zenoh.testing.waiting import until


@pytest.fixture(scope="module")
def deployment(shared_home: Home) -> Path:
    """A Waffle that resumes by itself unless the gate latches."""
    file = shared_home.deployment(world="arena", resume="auto", decision={"linear_speed": 0.26})
    shared_home.start("up", str(file))
    return file


@pytest.fixture
async def robot(deployment: Path) -> AsyncIterator[Probe]:
    """The robot, which drives straight ahead."""
    async with probing(endpoint_of(deployment), "operator") as onlooker:
        if onlooker.state.gate.mode == "latched" and onlooker.state.gate.estop_generation:
            await release_and_enable(onlooker)
        await onlooker.driving_straight()
        yield onlooker


async def release_and_enable(robot: Probe) -> None:
    """Release the latch and enable the brain, as an operator does."""
    person = Robot(robot.bus)
    await robot.at_rest(ticks=30)
    assert (await person.release()).ok
    await robot.ticks(40)
    assert robot.state.gate.mode == "idle"  # also with resume: auto, because an operator stopped it
    await robot.enable_brain()


async def test_an_estop_stops_the_body_and_keeps_it_stopped(robot: Probe) -> None:
    generation, start = robot.state.gate.estop_generation, robot.state
    reply = await Robot(robot.bus).estop("a chair is in the way")
    assert (reply.ok, reply.gate.mode) == (True, "latched")
    assert reply.gate.estop_generation == generation + 1
    await robot.ticks(100)
    path = path_until_rest(robot.since(start), at_rest)
    assert path is not None
    assert path <= 0.06
    assert robot.distance_from(start) <= 0.06
    assert robot.state.gate.mode == "latched"
    assert [cause.code for cause in robot.state.gate.causes] == ["estop"]
    await until(lambda: "a chair is in the way" in " ".join(r.text for r in robot.logs), "its log")
    with pytest.raises(Refused, match=r"latched: e-stop pressed by operator .*; release it first"):
        await Robot(robot.bus, take=True).set_base_velocity(0.2)
    await release_and_enable(robot)
    await robot.driving_straight(room=0.0)


async def test_the_estop_command_names_the_robot_that_confirmed_it(
    robot: Probe, shared_home: Home, deployment: Path
) -> None:
    start = robot.state
    where = endpoint_of(deployment).connect[0]
    stop = await shared_home.run("estop", "--connect", where, "--reason", "test")
    assert await stop.ended() == 0
    assert re.fullmatch(
        r"CONFIRMED by turtlebot3_waffle: stopped and latched; e-stop number \d+ \(\d+ ms\)\n",
        stop.out,
    )
    await robot.at_rest()
    assert robot.state.gate.mode == "latched"
    enable = await shared_home.run("enable")
    assert await enable.ended() == 1
    assert re.fullmatch(
        r"gigabrain: turtlebot3_waffle: latched: e-stop pressed by \S+-cli .*; release it first\n",
        enable.err,
    )
    await robot.at_rest(ticks=30)
    release = await shared_home.run("release")
    assert "released; enable it to move" in release.out
    assert "control drives" in (await shared_home.run("enable")).out
    await robot.driving_straight()
    assert robot.state.gate.enables > start.gate.enables


async def test_an_estop_survives_the_death_of_the_driver(robot: Probe) -> None:
    generation = (await Robot(robot.bus).estop()).gate.estop_generation
    before = robot.state
    os.kill(await robot.pid("driver"), signal.SIGKILL)
    await until(lambda: robot.state.boot != before.boot, "the driver's restart")
    await robot.ticks(100)
    assert robot.state.gate.mode == "latched"
    assert [cause.code for cause in robot.state.gate.causes] == ["estop"]
    assert robot.state.gate.estop_generation == generation
    assert (robot.state.pose.x, robot.state.pose.y) == (0.0, 0.0)
    await release_and_enable(robot)
    await robot.driving_straight(room=0.0)


async def test_a_release_must_name_the_newest_estop(robot: Probe) -> None:
    person = Robot(robot.bus)
    first = (await person.estop()).gate.estop_generation
    await person.estop()
    await robot.at_rest(ticks=30)
    replies = await robot.bus.ask(RELEASE, ReleaseRequest(estop_generation=first))
    assert (replies[0].ok, replies[0].gate.estop_generation) == (False, first + 1)
    assert robot.state.gate.mode == "latched"
    await release_and_enable(robot)
    await robot.driving_straight(room=0.0)
