"""A robot that makes a map, and carries out goals of rclpy as from Nav2's clients and RViz."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
import pytest_asyncio

from gigabrain_schemas.logs import AcceptedRequest
from gigabrain_schemas.topics import POSE_SET, REQUEST_LOG
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until
from tests.ros2.judge import Judge, Program
from tests.system.ros2.test_gateway_ros import (
    LATCHED,
    TRIGGER,
    Robot,
    diagnosed,
    driving,
    judge,
    running,
)

__all__ = ["judge"]
pytestmark = pytest.mark.asyncio(loop_scope="module")
TO_POSE = {"action": "/navigate_to_pose", "type": "nav2_msgs/action/NavigateToPose"}
THROUGH = {"action": "/navigate_through_poses", "type": "nav2_msgs/action/NavigateThroughPoses"}
POSE, PATH = "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path"
GUESS, MAP = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/OccupancyGrid"
GOAL_TIMEOUT_S = 120.0


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def robot(shared_home: Home, shared_judge: Judge) -> AsyncIterator[Robot]:
    """A robot that the tests share."""
    brain = {"perception": {"mapping": "slam"}, "decision": {"behaviour": "navigate"}}
    brain["ros2"] = {"take": True}
    async with running(shared_home, shared_judge, resume="auto", **brain) as made:
        await made.becomes("enabled")
        yield made


def pose_at(x: float, y: float, frame: str = "map") -> dict[str, Any]:
    return {
        "header": {"frame_id": frame},
        "pose": {"position": {"x": x, "y": y}, "orientation": {"w": 1.0}},
    }


async def send(client: Program, where: dict[str, str], name: str, **goal: Any) -> None:
    await client.available(**where)
    await client.query("send", **where, name=name, goal=goal)
    await client.wait_async("accepted", name=name)


async def result(client: Program, name: str) -> tuple[str, int]:
    found = await client.wait_async("result", GOAL_TIMEOUT_S, name=name)
    return found["status"], found["value"]["error_code"]


async def mapped(client: Program) -> None:
    """Wait for a map: send goals outside until one is aborted for that reason."""
    found, tries = ("", 0), 0
    while found != ("aborted", 204):
        await send(client, TO_POSE, f"early-{tries}", pose=pose_at(50.0, 50.0))
        found, tries = await result(client, f"early-{tries}"), tries + 1
        assert found in (("aborted", 202), ("aborted", 204), ("aborted", 208))


async def test_goals_are_followed_cancelled_and_preempted(robot: Robot, judge: Judge) -> None:
    client = judge.start("navigate")
    await mapped(client)
    await send(client, TO_POSE, "frame", pose=pose_at(0.0, 0.0, "somewhere"))
    assert await result(client, "frame") == ("aborted", 9002)
    await send(client, TO_POSE, "far", pose=pose_at(0.6, 0.0))
    feedback = await client.wait_async("feedback", name="far")
    assert feedback["value"]["current_pose"]["header"]["frame_id"] == "map"
    await send(client, TO_POSE, "back", pose=pose_at(-0.4, 0.0))
    assert await result(client, "far") == ("aborted", 0)
    await client.query("cancel", name="back")
    assert await result(client, "back") == ("canceled", 0)
    await send(client, TO_POSE, "home", pose=pose_at(0.2, 0.0))
    assert await result(client, "home") == ("succeeded", 0)


@pytest.mark.slow
async def test_while_a_goal_through_poses_is_followed_other_goals_are_rejected(
    robot: Robot, judge: Judge
) -> None:
    client = judge.start("navigate")
    await mapped(client)
    poses = [pose_at(0.6, 0.0), pose_at(0.0, 0.0)]
    await send(client, THROUGH, "round", poses=poses)
    first = (await client.wait_async("feedback", name="round"))["value"]
    assert first["number_of_poses_remaining"] == 2
    await client.query("send", **TO_POSE, name="other", goal={"pose": pose_at(0.2, 0.0)})
    await client.wait_async("rejected", name="other")
    assert await result(client, "round") == ("succeeded", 0)
    last = client.seen("feedback", name="round")[-1]["value"]
    assert last["number_of_poses_remaining"] == 1
    await send(client, THROUGH, "nowhere", poses=[pose_at(50.0, 50.0)])
    assert await result(client, "nowhere") == ("aborted", 304)
    await send(client, THROUGH, "again", poses=poses)
    await client.wait_async("feedback", name="again")
    await client.query("cancel", name="again")
    assert await result(client, "again") == ("canceled", 0)


async def published(
    judge: Judge, topic: str, kind: str, value: dict[str, Any], effect: Callable[[], object]
) -> None:
    """Publish a message until it has its effect; the first ones may have no reader yet."""
    sender = judge.start("drive", node="rviz")
    async with asyncio.timeout(PATIENCE_S):
        while not effect():
            await sender.query("publish", topic=topic, type=kind, value=value)
            await asyncio.sleep(0.5)


@pytest.mark.slow
async def test_a_goal_pose_of_rviz_gets_a_plan_and_a_wrong_one_is_reported(
    robot: Robot, judge: Judge
) -> None:
    await mapped(judge.start("navigate"))
    listener, text = judge.start("listen"), await diagnosed(judge)
    await listener.query("subscribe", topic="/plan", type=PATH, qos={}, stream=True)

    def planned() -> bool:
        received = [each["value"] for each in listener.seen("message", topic="/plan")]
        ends = [path["poses"][-1] for path in received if path["poses"]]
        places = [(each["header"]["frame_id"], each["pose"]["position"]) for each in ends]
        return any(
            frame == "map" and abs(at["x"] - 0.5) < 0.1 and abs(at["y"] - 0.1) < 0.1
            for frame, at in places
        )

    await published(judge, "/goal_pose", POSE, pose_at(0.5, 0.1), planned)
    wrong = pose_at(0.0, 0.0, "base_link")
    await published(judge, "/goal_pose", POSE, wrong, lambda: "'base_link'" in text("goal_pose"))


@pytest.mark.slow
async def test_an_initialpose_of_rviz_reaches_the_map_maker(robot: Robot, judge: Judge) -> None:
    await mapped(judge.start("navigate"))
    accepted: list[AcceptedRequest] = []
    robot.bus.subscribe(REQUEST_LOG, lambda _, each: accepted.append(each))
    text, guess = await diagnosed(judge), {"pose": pose_at(0.0, 0.0)["pose"]}
    wrong = {"header": {"frame_id": "odom"}, "pose": guess}
    await published(judge, "/initialpose", GUESS, wrong, lambda: "'odom'" in text("initialpose"))
    right = {"header": {"frame_id": "map"}, "pose": guess}

    def taken() -> bool:
        return POSE_SET.key in [each.service for each in accepted]

    await published(judge, "/initialpose", GUESS, right, taken)


@pytest.mark.slow
async def test_the_map_is_saved_and_received_by_late_readers(robot: Robot, judge: Judge) -> None:
    await mapped(judge.start("navigate"))
    caller, listener = judge.start("call"), judge.start("listen")
    where = {"service": "/map_save", "type": TRIGGER}
    await caller.available(**where)
    await caller.query("call", **where)
    response = (await caller.wait_async("response", service="/map_save"))["value"]
    assert (response["success"], "ros2-" in response["message"]) == (True, True)
    await listener.query("subscribe", topic="/map", type=MAP, qos=LATCHED)
    report = await asyncio.to_thread(
        listener.poll, "report", lambda each: each["count"] > 0, topic="/map"
    )
    grid = report["values"][-1]
    assert grid["header"]["frame_id"] == "map"
    assert len(grid["data"]) == grid["info"]["width"] * grid["info"]["height"]
    known = [cell for cell in grid["data"] if cell >= 0]
    assert min(known) < 25 < 75 < max(known)


async def test_with_take_cmd_vel_takes_the_body_from_the_brain(robot: Robot, judge: Judge) -> None:
    await until(lambda: robot.now.gate.commander == "control", "the brain drives")
    driver = judge.start("drive")
    await driving(robot, driver, angular=0.5)
    assert robot.now.gate.commander == "ros2"
    await driver.query("rest")
    await until(lambda: robot.now.gate.commander == "control", "the brain drives again")
