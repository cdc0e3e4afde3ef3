"""A robot without our brain, for use with Nav2."""

import asyncio

import yaml

from gigabrain_zenoh.testing.processes import Home
from tests.places import ROOT
from tests.ros2.judge import Judge
from tests.system.ros2.test_gateway_ros import READ, driving, released, running

NAV2_TOPICS = ("/map", "/plan", "/goal_pose", "/initialpose", "/navigate_to_pose/_action/status")


async def test_a_robot_without_a_brain_does_not_use_the_names_of_nav2(
    home: Home, judge: Judge
) -> None:
    parts = yaml.safe_load((ROOT / "examples/ros2/nav2.yaml").read_text())
    async with running(home, judge, **parts) as robot:
        listener, driver = judge.start("listen", node="listener"), judge.start("drive")
        kind, qos = READ["/tf"]
        await listener.query("subscribe", topic="/tf", type=kind, qos=qos)
        await released(robot)
        await driving(robot, driver)
        assert robot.now.gate.commander == "ros2"
        report = await asyncio.to_thread(
            listener.poll, "report", lambda each: each["count"] > 0, topic="/tf"
        )
        parents = {each["header"]["frame_id"] for each in report["values"][-1]["transforms"]}
        assert parents == {"odom", "base_link"}
        received = (await listener.endpoints("/cmd_vel"))["subscribers"]
        assert {each["node"] for each in received} == {"gigabrain"}
        for topic in NAV2_TOPICS:
            found = await listener.endpoints(topic)
            assert (topic, found["publishers"], found["subscribers"]) == (topic, [], [])
