"""A robot whose brain is Nav2."""

import asyncio

import yaml

from gigabrain_zenoh.testing.processes import Home
from tests.places import ROOT
from tests.ros2.judge import Judge
from tests.system.ros2.test_gateway_ros import READ, driving, released, running

OF_NAV2 = ("/map", "/plan", "/goal_pose", "/initialpose", "/navigate_to_pose/_action/status")


async def test_a_robot_without_a_brain_leaves_nav2_its_names(home: Home, judge: Judge) -> None:
    parts = yaml.safe_load((ROOT / "examples/ros2/nav2.yaml").read_text())
    async with running(home, judge, **parts) as robot:
        listener, driver = judge.start("listen", node="listener"), judge.start("drive")
        kind, qos = READ["/tf"]
        await listener.query("subscribe", topic="/tf", type=kind, qos=qos)
        await released(robot)
        await driving(robot, driver)
        assert robot.now.gate.commander == "ros2"
        report = await asyncio.to_thread(
            listener.poll, "report", lambda one: one["count"] > 0, topic="/tf"
        )
        parents = {one["header"]["frame_id"] for one in report["values"][-1]["transforms"]}
        assert parents == {"odom", "base_link"}
        received = (await listener.endpoints("/cmd_vel"))["subscribers"]
        assert {one["node"] for one in received} == {"gigabrain"}
        for topic in OF_NAV2:
            found = await listener.endpoints(topic)
            assert (topic, found["publishers"], found["subscribers"]) == (topic, [], [])
