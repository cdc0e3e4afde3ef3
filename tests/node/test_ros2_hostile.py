"""Mutated messages and requests of other ROS nodes do not disturb the gateway."""

import random

import pytest

from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh.errors import NoAnswer
from gigabrain_zenoh.gateway.nav2 import THROUGH_POSES_TYPE, TO_POSE_TYPE
from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.testing import samples
from tests.node.ros2_robot import TYPES
from tests.node.test_ros2_topics import driver

TOPICS = {
    "/cmd_vel": ("geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"),
    "/initialpose": ("geometry_msgs/msg/PoseWithCovarianceStamped",),
    "/goal_pose": ("geometry_msgs/msg/PoseStamped",),
}
SERVICES = {
    "/release": "std_srvs/srv/Trigger",
    "/enable": "std_srvs/srv/Trigger",
    "/map_save": "std_srvs/srv/Trigger",
    "/gigabrain/get_parameters": "rcl_interfaces/srv/GetParameters",
    "/gigabrain/set_parameters": "rcl_interfaces/srv/SetParameters",
    "/gigabrain/describe_parameters": "rcl_interfaces/srv/DescribeParameters",
    "/gigabrain/list_parameters": "rcl_interfaces/srv/ListParameters",
    "/navigate_to_pose/_action/send_goal": f"{TO_POSE_TYPE}_SendGoal",
    "/navigate_through_poses/_action/send_goal": f"{THROUGH_POSES_TYPE}_SendGoal",
    "/navigate_to_pose/_action/cancel_goal": "action_msgs/srv/CancelGoal",
}


def mutated(dice: random.Random, payload: bytes) -> bytes:
    """Return a payload with changed, missing or additional bytes."""
    data = bytearray(payload)
    for _ in range(dice.randrange(1, 12)):
        data[dice.randrange(len(data))] = dice.choice((0, 1, 0x7F, 0x80, 0xFF, dice.randrange(256)))
    if dice.random() < 0.2:
        del data[dice.randrange(len(data)) :]
    return bytes(data) + dice.randbytes(dice.choice((0, 0, 3, 40)))


def payload_of(kind: str) -> bytes:
    return TYPES.encode(kind, TYPES.make(kind))


@pytest.mark.parametrize("seed", range(4))
async def test_mutated_messages_are_not_obeyed_and_the_gateway_keeps_working(
    seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    dice = random.Random(seed)
    async with driver() as robot:
        await robot.body()
        await robot.states(3)
        transport = robot.node.transport
        plans = [
            (transport.publisher(topic, kind, DEFAULT), payload_of(kind))
            for topic, kinds in TOPICS.items()
            for kind in kinds
        ]
        for _ in range(300):
            for publisher, payload in plans:
                publisher.publish(mutated(dice, payload))
            await robot.clock.advance(0)
        await robot.states(3)
        counters = robot.gateway_bus.counters
        assert counters["cmd_vel_broken"] > 0
        assert robot.gateway_bus.sent[CMD_VEL.key] == 0  # control has the body
        warnings = [each for each in caplog.messages if "dropped a message" in each]
        assert len(warnings) == 1
        before = counters["cmd_vel_commander"]
        robot.node.drive()
        assert counters["cmd_vel_commander"] == before + 1


@pytest.mark.parametrize("seed", range(2))
async def test_the_gateway_keeps_working_after_mutated_requests(seed: int) -> None:
    dice = random.Random(seed)
    async with driver() as robot:
        await robot.body()
        await robot.states(3)
        for service, kind in SERVICES.items():
            payload = payload_of(f"{kind}_Request")
            for _ in range(40):
                try:
                    await robot.node.transport.call(service, kind, mutated(dice, payload), 5.0)
                except NoAnswer:
                    continue
        names = (
            await robot.node.call("/gigabrain/list_parameters", "rcl_interfaces/srv/ListParameters")
        ).result.names
        assert "domain" in names
        assert robot.gateway_bus.time.boot == samples.BOOT
