"""`limp` and `hold` say that a body has no joints."""

from collections.abc import Awaitable, Callable

import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import Body, RobotState
from gigabrain_schemas.examples import example
from gigabrain_schemas.topics import BODY, STATE
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.errors import Unsupported
from gigabrain_zenoh.testing.in_memory import Net


@pytest.mark.parametrize("call", [lambda robot: robot.limp(), lambda robot: robot.hold()])
async def test_a_body_without_joints_has_nothing_to_let_go_of(
    call: Callable[[Robot], Awaitable[object]],
) -> None:
    net = Net()
    robot = Robot(net.two)
    body = replace(load_robot("mock").description(), joints=())
    net.one.publish(BODY, Body(description=body, link="sim"))
    net.one.publish(STATE, example(RobotState))
    with pytest.raises(Unsupported, match=r"^mock has no joint that can be positioned$"):
        await call(robot)
