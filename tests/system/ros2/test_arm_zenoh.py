"""A simulated SO-101, moved over `rmw_zenoh` by one of our nodes."""

import uuid
from typing import Any

import numpy as np

from gigabrain_zenoh.ros2.qos import DEFAULT
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.nodes import Nodes
from tests.system.ros2.test_gateway_ros import released, running

BASE, FOLLOW = "/follow_joint_trajectory/_action", "control_msgs/action/FollowJointTrajectory"
STATES, TRAJECTORY = "sensor_msgs/msg/JointState", "trajectory_msgs/msg/JointTrajectory"


async def test_a_goal_and_the_topic_move_the_arm(home: Home) -> None:
    async with running(home, None, body="so101", resume="manual") as robot:
        nodes = Nodes(transport="rmw_zenoh", router=robot.router)
        async with nodes.stack:
            node, types, places = await nodes.node("client"), nodes.types, [0.0]

            def look(received: Any) -> None:
                places[0] = types.decode(STATES, received.payload).position[0]

            node.subscribe("/joint_states", STATES, DEFAULT, look)

            def trajectory(place: float) -> Any:
                point = types.make(
                    "trajectory_msgs/msg/JointTrajectoryPoint",
                    positions=np.array([place]),
                    time_from_start={"sec": 1},
                )
                return types.make(TRAJECTORY, joint_names=["shoulder_pan"], points=[point])

            async def ask(part: str, **fields: Any) -> Any:
                kind = f"{FOLLOW}_{part}"
                service = f"{BASE}/{'send_goal' if part == 'SendGoal' else 'get_result'}"
                made = types.make(f"{kind}_Request", **fields)
                payload = types.encode(f"{kind}_Request", made)
                reply = await node.call(service, kind, payload, 60.0)
                return types.decode(f"{kind}_Response", reply)

            publisher = node.publisher("/joint_trajectory", TRAJECTORY)
            await until(lambda: publisher.readers == 1, "the gateway")
            await released(robot)
            while abs(places[0] - 0.4) > 0.06:  # the gate of a busy machine may stop it
                id = {"uuid": uuid.uuid4().bytes}
                goal = types.make(f"{FOLLOW}_Goal", trajectory=trajectory(0.4))
                assert (await ask("SendGoal", goal_id=id, goal=goal)).accepted
                found = await ask("GetResult", goal_id=id)
                assert (found.status, found.result.error_code) in ((4, 0), (6, -1)), found
                await robot.becomes("idle")
            while abs(places[0] + 0.4) > 0.06:
                publisher.publish(types.encode(TRAJECTORY, trajectory(-0.4)))
                await until(lambda: robot.now.gate.commander == "ros2", "it moves")
                await robot.becomes("idle")
