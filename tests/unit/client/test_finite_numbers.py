"""A script's NaN and infinities are refused: a clamp would turn them into the greatest speed."""

import asyncio
import math
from collections.abc import Awaitable, Callable

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import Body, GateStatus, RobotState
from gigabrain_schemas.brain import DetectedObject, JointSpeeds, Objects, Twist
from gigabrain_schemas.examples import example
from gigabrain_schemas.topics import BODY, CMD_VEL, JOINT_TELEOP, STATE, TELEOP
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.codec import encode
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing.in_memory import Net

NAN, INF = math.nan, math.inf


async def called(call: Callable[[], None]) -> None:
    call()


@pytest.mark.parametrize(
    "command",
    [
        lambda robot: robot.set_base_velocity(NAN),
        lambda robot: robot.set_base_velocity(0.1, 0.0, NAN),
        lambda robot: robot.set_base_velocity(0.1, INF),
        lambda robot: robot.drive(NAN, seconds=1.0),
        lambda robot: robot.drive(0.1, seconds=NAN),
        lambda robot: robot.drive(0.1, seconds=INF),
        lambda robot: robot.drive(0.1, seconds=-1.0),
        lambda robot: robot.move(NAN),
        lambda robot: robot.move(-INF),
        lambda robot: robot.move(1.0, speed=NAN),
        lambda robot: robot.turn(NAN),
        lambda robot: called(lambda: robot.steer(Velocity(angular_z=NAN))),
        lambda robot: called(lambda: robot.jog({"elbow": INF})),
    ],
)
async def test_it_is_refused_and_nothing_is_sent(
    command: Callable[[Robot], Awaitable[object]],
) -> None:
    net = Net()
    robot, sent = Robot(net.two), list[object]()
    for topic in (CMD_VEL, TELEOP, JOINT_TELEOP):
        net.one.subscribe(topic, lambda _key, message: sent.append(message))
    net.one.publish(BODY, Body(description=load_robot("mock").description(), link="sim"))
    gate = GateStatus(mode="enabled", commander=net.two.process)
    net.one.publish(STATE, replace(example(RobotState), gate=gate))
    with pytest.raises(ConfigError, match=r"^[a-z_]+: expected .*, got (nan|-?inf|-1)$"):
        await asyncio.wait_for(command(robot), 5.0)
    assert sent == []


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.int64])
async def test_a_number_of_numpy_is_sent_like_any_other(kind: Callable[[int], float]) -> None:
    net = Net()
    robot, sent = Robot(net.two), list[object]()
    net.one.subscribe(TELEOP, lambda _key, message: sent.append(message))
    net.one.subscribe(JOINT_TELEOP, lambda _key, message: sent.append(message))
    robot.steer(Velocity(linear_x=kind(1), angular_z=kind(-1)))
    robot.jog({"elbow": kind(1)})
    twist, speeds = sent
    assert isinstance(twist, Twist)
    assert isinstance(speeds, JointSpeeds)
    assert (twist.linear_x, twist.angular_z, speeds.velocity) == (1.0, -1.0, (1.0,))


def test_a_truth_value_of_numpy_is_sent_like_any_other() -> None:
    found = DetectedObject(id=1, x=0.0, y=0.0, radius=0.1, label="can", avoid=np.bool_(1))
    assert msgspec.msgpack.decode(encode(found), type=DetectedObject).avoid is True


def test_an_array_is_no_number() -> None:
    with pytest.raises(TypeError, match="objects of type numpy"):
        encode(Objects(objects=np.zeros(2)))  # type: ignore[arg-type]
