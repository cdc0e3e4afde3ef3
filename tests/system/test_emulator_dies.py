"""An emulator is killed while its robot drives: the robot stays there, and drives on."""

import math
import os
import signal
from typing import Any

import pytest

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.qa.probe import Probe, probing
from gigabrain_zenoh.testing.processes import AVOID, Home, robot_of
from gigabrain_zenoh.testing.waiting import until


async def truth(probe: Probe) -> dict[str, Any]:
    return dict((await probe.describe("emulator")).report)


def distance(a: dict[str, Any], b: dict[str, Any]) -> float:
    return math.dist((a["true_x"], a["true_y"]), (b["true_x"], b["true_y"]))


def drives(state: RobotState) -> bool:
    return state.link.connected and state.velocity.linear_x > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    "body", ["mycustombot", "turtlebot3_waffle", "lekiwi", "alpha", "turtlebot3_ros2"]
)
async def test_a_robot_stays_where_it_was_when_its_emulator_is_killed(
    home: Home, body: str
) -> None:
    demo = home.start(*AVOID, "--body", body, "--link", "emulated", "--headless")
    async with probing(await robot_of(home, demo)) as probe:
        start = await truth(probe)
        await until(lambda: drives(probe.state), "it drives")
        while distance(start, before := await truth(probe)) < 0.6:
            pass
        boot = probe.state.boot
        (pid,) = home.processes("emulator")
        os.kill(pid, signal.SIGKILL)
        await until(lambda: not probe.state.link.connected, "the driver loses the body")
        lost = probe.state
        await until(lambda: probe.state.link.connected, "the driver finds the body")
        found, after = probe.state, await truth(probe)
        assert distance(before, after) < 0.5
        assert math.dist((lost.pose.x, lost.pose.y), (found.pose.x, found.pose.y)) < 0.1
        assert abs(math.remainder(found.pose.yaw - lost.pose.yaw, math.tau)) < 0.2
        assert found.boot == boot  # of the driver
        await until(lambda: drives(probe.state), "it drives again")
    demo.send(signal.SIGINT)
    assert await demo.ended() == 0
