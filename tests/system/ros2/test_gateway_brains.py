"""A robot whose brain is Nav2, and one that carries out goals of Nav2's clients."""

import asyncio
from typing import Any

import yaml

from gigabrain_zenoh.testing.processes import Home
from tests.places import ROOT
from tests.ros2.judge import Judge
from tests.system.ros2.test_gateway_ros import READ, driving, released, running

OF_NAV2 = ("/map", "/plan", "/goal_pose", "/initialpose", "/navigate_to_pose/_action/status")
NAVIGATE = "nav2_msgs/action/NavigateToPose"


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
        heard = (await listener.query("endpoints", topic="/cmd_vel"))["subscribers"]
        assert {one["node"] for one in heard} == {"gigabrain"}
        for topic in OF_NAV2:
            found = await listener.query("endpoints", topic=topic)
            assert (topic, found["publishers"], found["subscribers"]) == (topic, [], [])


def goal_at(x: float, y: float, frame: str = "map") -> dict[str, Any]:
    return {
        "pose": {
            "header": {"frame_id": frame},
            "pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}},
        }
    }


async def test_rclpy_sends_goals_cancels_and_preempts_them(home: Home, judge: Judge) -> None:
    brain = {"perception": {"mapping": "slam"}, "decision": {"behaviour": "navigate"}}
    async with running(home, judge, resume="auto", **brain) as robot:
        client = judge.start("navigate")
        action = "/navigate_to_pose"
        await client.available(action=action, type=NAVIGATE)
        await robot.becomes("enabled")

        async def send(name: str, goal: dict[str, Any]) -> None:
            await client.query("send", action=action, type=NAVIGATE, name=name, goal=goal)
            await client.hear("accepted", name=name)

        async def result(name: str) -> tuple[str, int]:
            found = await client.hear("result", 120.0, name=name)
            return found["status"], found["value"]["error_code"]

        while True:  # until there is a map
            await send(name := f"early-{len(client.seen('accepted'))}", goal_at(50.0, 50.0))
            if (found := await result(name)) != ("aborted", 202):
                break
        assert found == ("aborted", 204)
        await send("frame", goal_at(0.0, 0.0, "somewhere"))
        assert await result("frame") == ("aborted", 9002)
        await send("far", goal_at(0.6, 0.0))
        feedback = await client.hear("feedback", name="far")
        assert feedback["value"]["current_pose"]["header"]["frame_id"] == "map"
        await send("back", goal_at(-0.4, 0.0))
        assert await result("far") == ("aborted", 0)
        await client.query("cancel", name="back")
        assert await result("back") == ("canceled", 0)
        await send("home", goal_at(0.2, 0.0))
        assert await result("home") == ("succeeded", 0)
