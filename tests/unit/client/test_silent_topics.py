"""A topic that nobody publishes does not hold up a script that gives a timeout."""

import asyncio
import time

import pytest

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.client.sync_robot import EventLoopThread, SyncRobot
from gigabrain_zenoh.errors import BodyLost, ConfigError
from gigabrain_zenoh.testing.in_memory import Net

SILENT = r"^no message on robot/scan for 0\.02 s; is it published\?$"


async def test_a_loop_over_a_silent_topic_ends_after_its_timeout() -> None:
    with pytest.raises(BodyLost, match=SILENT):
        await anext(Robot(Net().two).topic("scan", timeout=0.02))


async def test_it_ends_as_well_where_the_driver_dies_after_its_first_messages() -> None:
    net = Net()
    states = Robot(net.two).topic(STATE, timeout=0.5)
    reading = asyncio.ensure_future(anext(states))
    await asyncio.sleep(0)
    net.one.publish(STATE, example(RobotState))
    assert (await reading).robot_type == example(RobotState).robot_type
    with pytest.raises(BodyLost, match=r"no message on robot/state for 0\.5 s"):
        await anext(states)


def test_so_does_one_without_asyncio() -> None:
    thread = EventLoopThread()

    async def make() -> Robot:
        return Robot(Net().two)

    robot = SyncRobot(thread.run(make()), thread)
    with pytest.raises(BodyLost, match=SILENT):
        next(robot.topic("scan", timeout=0.02))
    thread.close()


@pytest.mark.parametrize("seconds", [0.0, -1.0, float("nan")])
async def test_a_timeout_that_cannot_be_is_refused(seconds: float) -> None:
    with pytest.raises(ConfigError, match=f"timeout: expected more than 0, got {seconds:g}"):
        Robot(Net().two).topic("scan", timeout=seconds)


async def test_time_in_which_the_script_was_stopped_does_not_count() -> None:
    net = Net()
    reading = asyncio.ensure_future(anext(Robot(net.two).topic(STATE, timeout=0.5)))
    await asyncio.sleep(0.01)
    loop = asyncio.get_running_loop()
    loop.call_soon(time.sleep, 1.0)
    loop.call_later(
        0.05, lambda: loop.call_later(0.05, net.one.publish, STATE, example(RobotState))
    )
    assert (await reading).robot_type == example(RobotState).robot_type
