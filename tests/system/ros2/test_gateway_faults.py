"""The process `ros2` frozen and killed while ROS drives: the body stops, the rest works on."""

import asyncio
import contextlib
import os
import signal
from collections.abc import AsyncIterator
from typing import Any

import pytest
import pytest_asyncio

from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge, frozen
from tests.ros2.nodes import Nodes
from tests.system.ros2.test_gateway_ros import Robot, driving, released, running

pytestmark = pytest.mark.asyncio(loop_scope="module")
TWIST = "geometry_msgs/msg/Twist"


class ZenohDriver:
    """A node of `rmw_zenoh` with the same commands as the rclpy program `drive`."""

    def __init__(self, nodes: Nodes, node: Any) -> None:
        self._types, self._publisher = nodes.types, node.publisher("/cmd_vel", TWIST)
        self._sending: asyncio.Task[None] | None = None

    async def query(self, do: str, linear: float = 0.0, hz: float = 20.0) -> None:
        if self._sending:
            self._sending.cancel()
        twist = self._types.make(TWIST, linear={"x": linear})
        payload = self._types.encode(TWIST, twist)
        self._sending = asyncio.create_task(self._send(payload, hz)) if do == "drive" else None

    async def _send(self, payload: bytes, hz: float) -> None:
        while True:
            self._publisher.publish(payload)
            await asyncio.sleep(1 / hz)


@pytest_asyncio.fixture(loop_scope="module", scope="module", params=["dds", "rmw_zenoh"])
async def driven(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator[tuple[Robot, Any]]:
    """Yield a robot, and a ROS node that can drive it."""
    judge: Judge | None = None
    if request.param == "dds":
        judge = request.getfixturevalue("shared_judge")
    async with contextlib.AsyncExitStack() as stack:
        home = stack.enter_context(contextlib.closing(Home(tmp_path_factory.mktemp("home"))))
        robot = await stack.enter_async_context(running(home, judge))
        if judge:
            driver: Any = judge.start("drive")
        else:
            nodes = Nodes(transport="rmw_zenoh", router=robot.router)
            await stack.enter_async_context(nodes.stack)
            driver = ZenohDriver(nodes, await nodes.node("hands"))
        await until(lambda: robot.states, "states")
        await released(robot)
        yield robot, driver
        await driver.query("rest")


async def stopped(robot: Robot) -> None:
    await until(lambda: robot.now.sent.linear_x == 0.0, "a command of zero")
    await until(lambda: abs(robot.now.velocity.linear_x) < 0.01, "it stands")
    await robot.becomes("idle")
    assert robot.now.gate.commander == ""


async def test_a_frozen_gateway_stops_the_body_and_its_backlog_moves_nothing(
    driven: tuple[Robot, Any],
) -> None:
    robot, driver = driven
    await driving(robot, driver)
    (gateway,) = robot.home.processes("ros2")
    before, enables = set(robot.home.processes()), robot.now.gate.enables
    alive: list[Health] = []
    with frozen(gateway):
        await stopped(robot)
        await asyncio.sleep(1.0)  # commands queue up meanwhile
        await driver.query("rest")
        since = len(robot.states)
    robot.bus.subscribe(HEALTH, lambda _, health: alive.append(health), name="ros2")
    await until(lambda: len(alive) >= 3, "the gateway goes on")
    assert {each.sent.linear_x for each in robot.states[since:]} == {0.0}
    assert {each.gate.mode for each in robot.states[since:]} == {"idle"}
    assert set(robot.home.processes()) == before
    await driving(robot, driver)
    assert robot.now.gate.enables > enables
    await driver.query("rest")
    await robot.becomes("idle")


async def test_a_gateway_killed_while_ros_drives_stops_the_body_and_drives_again_later(
    driven: tuple[Robot, Any],
) -> None:
    robot, driver = driven
    await driving(robot, driver)
    (gateway,) = robot.home.processes("ros2")
    others, enables = set(robot.home.processes()) - {gateway}, robot.now.gate.enables
    os.kill(gateway, signal.SIGKILL)
    await stopped(robot)
    await until(lambda: robot.home.processes("ros2") not in ([], [gateway]), "it is restarted")
    await until(lambda: robot.now.gate.enables > enables, "the stream asks for it again")
    await driving(robot, driver)
    assert others <= set(robot.home.processes())
