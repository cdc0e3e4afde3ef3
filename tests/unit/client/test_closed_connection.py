"""A robot that outlived its `async with` block says so, whatever is called."""

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.tasks import TaskStatus
from gigabrain_schemas.topics import BODY, STATE, TASK
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.testing.in_memory import Net


async def called(call: Callable[[], None]) -> None:
    call()


@pytest.mark.parametrize(
    "call",
    [
        lambda robot: robot.read_state(),
        lambda robot: robot.read_body(),
        lambda robot: robot.get_joint_states(),
        lambda robot: robot.get_sensor_data("scan"),
        lambda robot: robot.move(1.0),
        lambda robot: robot.turn(1.0),
        lambda robot: robot.drive(0.1, seconds=1.0),
        lambda robot: robot.set_base_velocity(0.1),
        lambda robot: robot.set_joint_positions({"elbow": 0.1}),
        lambda robot: robot.limp(),
        lambda robot: robot.enable(),
        lambda robot: robot.release(),
        lambda robot: robot.estop(),
        lambda robot: robot.audit(),
        lambda robot: robot.objects(),
        lambda robot: robot.goto(1.0, 1.0),
        lambda robot: robot.tasks.cancel(),
        lambda robot: robot.tasks.explore(),
        lambda robot: robot.tasks.status(),
        lambda robot: robot.tasks.result("goal-1"),
        lambda robot: called(lambda: robot.steer(Velocity(linear_x=0.1))),
        lambda robot: called(lambda: robot.jog({"elbow": 0.1})),
    ],
)
async def test_a_robot_that_outlived_its_block_says_how_to_connect_again(
    call: Callable[[Robot], Awaitable[object]],
) -> None:
    net = Net()
    robot = Robot(net.two)
    net.one.publish(BODY, example(Body))
    net.one.publish(STATE, example(RobotState))
    with pytest.raises(TimeoutError):  # it has subscribed, but no status has come
        await asyncio.wait_for(robot.tasks.status(), 0.01)
    net.one.publish(TASK, example(TaskStatus))
    await net.two.close()
    with pytest.raises(
        BusError, match=r"closed.*use `async with gigabrain_zenoh\.connect\(\) as robot:`"
    ):
        await asyncio.wait_for(call(robot), 0.5)
