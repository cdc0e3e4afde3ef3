"""Our brain explores rooms with a TurtleBot3 simulated by rclpy, and reaches goals in them."""

import asyncio
import contextlib
import math
from pathlib import Path
from typing import Any

import pytest

from gigabrain_schemas.tasks import Task
from gigabrain_zenoh.client.requests import enable
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.gate.state import BRAIN
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, endpoint_of
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge
from tests.system.ros2.test_gateway_ros import Robot, released
from tests.system.ros2.test_ros2_body import ROOM, robot_file

WALLS = [*ROOM, [1, -2, 1, 0.6], [2.5, 2, 2.5, -0.4]]  # three rooms in a row
GOALS = ((3.2, 1.2), (1.8, -1.2), (-1.3, -1.3), (-1.3, 1.3))  # relative to the start [m]
TIMEOUT_S = 1200.0
NEAR_M = 0.3  # by the true pose; the planner stops within 0.25 m


async def kept_enabled(robot: Robot) -> None:
    """Enable the brain, and again if the gate of a busy machine has stopped it."""
    while True:
        if robot.now.gate.mode == "idle":
            with contextlib.suppress(GigabrainError):
                await enable(robot.bus, BRAIN, take=False)
        await released(robot)
        await asyncio.sleep(1.0)


async def succeeded(tasks: Tasks, send: Any) -> None:
    """Send a task until it is accepted, which needs a map; wait for its success."""
    while True:
        with contextlib.suppress(GigabrainError):
            task: Task = await tasks.result(await send())
            break
        await asyncio.sleep(1.0)
    assert task.state == "succeeded", task.reason


@pytest.mark.slow
async def test_our_brain_explores_with_a_turtlebot3_of_rclpy_and_reaches_goals(
    home: Home, judge: Judge, tmp_path: Path
) -> None:
    played = judge.start("turtlebot3", walls=WALLS, stamped=True)
    file = home.deployment(
        body=str(robot_file(judge, tmp_path)),
        link="real",
        perception={"mapping": "slam"},
        decision={"behaviour": "navigate"},
    )
    home.start("up", str(file))
    session = connect(endpoint_of(file), "test", timeout_s=None)
    async with asyncio.timeout(TIMEOUT_S), session as bus:
        robot, tasks = Robot(home, bus, ""), Tasks(bus)
        await until(lambda: robot.states, "states")
        async with asyncio.TaskGroup() as group:
            keeping = group.create_task(kept_enabled(robot))
            await succeeded(tasks, tasks.explore)
            for x, y in GOALS:
                await succeeded(tasks, lambda x=x, y=y: tasks.go_to(x, y, None))
                truth = await played.query("truth")
                assert math.dist((x, y), truth["pose"][:2]) < NEAR_M, truth
            keeping.cancel()
    assert (await played.query("truth"))["contacts"] == 0
