"""A simulated SO-101, moved by real ROS 2 as by MoveIt or a user of ros2_control."""

import asyncio
import contextlib
import functools
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as xml

import pytest
import pytest_asyncio

from gigabrain_zenoh.client.requests import press_estop
from gigabrain_zenoh.testing.processes import Home
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT
from tests.ros2.judge import Judge, Program
from tests.system.ros2.test_gateway_ros import READ, Robot, diagnosed, judge, released, running

__all__ = ["judge"]
pytestmark = pytest.mark.asyncio(loop_scope="module")
NAMES = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]
HOME = (0.0, -1.7, 1.4, 0.6, 0.0, 0.0)
ACTION, FOLLOW = "/follow_joint_trajectory", "control_msgs/action/FollowJointTrajectory"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
STATES = "sensor_msgs/msg/JointState"
TOLERANCE_RAD = 0.06  # the goal tolerance, and a step of the encoder
SAG = 0.03  # [rad]


@pytest_asyncio.fixture(loop_scope="module", scope="module")
async def robot(shared_home: Home, shared_judge: Judge) -> AsyncIterator[Robot]:
    """An arm that the tests share; its brain does not command it."""
    parts = {"body": "so101", "resume": "manual"}
    async with running(shared_home, shared_judge, **parts) as made:
        await made.becomes("latched")
        await released(made)
        yield made


def pan(robot: Robot) -> float:
    return robot.now.joints[0].position


def point(seconds: float, *positions: float, **fields: Any) -> dict[str, Any]:
    since = {"sec": int(seconds), "nanosec": round(seconds % 1 * 1e9)}
    return {"positions": list(positions), "time_from_start": since} | fields


def trajectory(*points: dict[str, Any], names: tuple[str, ...] = ("shoulder_pan",)) -> Any:
    return {"joint_names": list(names), "points": list(points)}


class Client:
    """A client of the action in a ROS program."""

    def __init__(self, program: Program, robot: Robot) -> None:
        self.program, self._robot = program, robot

    async def send(self, name: str, sent: Any, **goal: Any) -> None:
        await self.program.query(
            "send", action=ACTION, type=FOLLOW, name=name, goal={"trajectory": sent} | goal
        )
        await self.program.wait_async("accepted", name=name)

    async def result(self, name: str) -> tuple[str, int]:
        found = await self.program.wait_async("result", name=name)
        return found["status"], found["value"]["error_code"]

    async def done(self, sent: Callable[[], Any], **goal: Any) -> tuple[str, str, int]:
        """Send a goal, again if the gate of a busy machine stopped it; return name and result."""
        while True:
            name = f"goal-{len(self.program.seen('accepted'))}"
            await self.send(name, sent(), **goal)
            result = await self.result(name)
            if not self._stopped(name):
                return name, *result
            await self._robot.becomes("idle")

    async def moving(self, sent: Any, way: float) -> str:
        """Send a goal until the first joint moves that way; return its name."""
        while True:
            name = f"goal-{len(self.program.seen('accepted'))}"
            await self.send(name, sent)
            now = self._robot
            await until(
                lambda: now.now.joints[0].velocity * way > 0.05 or self._stopped(name),  # noqa: B023
                "it moves",
            )
            if not self._stopped(name):
                return name
            await self._robot.becomes("idle")

    def _stopped(self, name: str) -> bool:
        """Return whether the gate has stopped a goal, because commands were late."""
        found = self.program.seen("result", name=name)
        return bool(found) and "no valid command for" in found[0]["value"]["error_string"]


async def following(judge: Judge, robot: Robot) -> Client:
    """Return a client that has found the action."""
    client = Client(judge.start("navigate", node="arm_client"), robot)
    await client.program.available(action=ACTION, type=FOLLOW)
    return client


async def test_joint_states_have_all_joints_of_the_arm(robot: Robot, judge: Judge) -> None:
    listener = judge.start("listen")
    await listener.query("subscribe", topic="/joint_states", type=STATES, qos={}, stream=True)
    message = (await listener.wait_async("message", nth=10))["value"]
    assert message["name"] == NAMES
    assert message["position"] == pytest.approx(HOME, abs=SAG)
    assert [len(message[field]) for field in ("velocity", "effort")] == [6, 6]
    assert robot.now.gate.mode == "idle"


async def test_ros_receives_the_urdf_and_the_frames_of_all_links(
    robot: Robot, judge: Judge
) -> None:
    listener, values = judge.start("listen"), {}
    for topic in ("/robot_description", "/tf_static", "/tf"):
        kind, qos = READ[topic]
        await listener.query("subscribe", topic=topic, type=kind, qos=qos)
        report = await asyncio.to_thread(
            listener.poll, "report", lambda each: each["count"] > 0, topic=topic
        )
        values[topic] = report["values"][-1]
    joints = xml.fromstring(values["/robot_description"]["data"]).findall("joint")
    transforms = [*values["/tf"]["transforms"], *values["/tf_static"]["transforms"]]
    frames = {each["child_frame_id"] for each in transforms}
    assert {"shoulder", "jaw", "tool"} < frames
    assert {joint.find("child").get("link") for joint in joints} == frames - {"base_footprint"}


async def test_a_goal_moves_the_arm_with_feedback_and_frees_it(robot: Robot, judge: Judge) -> None:
    client = await following(judge, robot)
    rest = {"velocities": [0.0, 0.0], "accelerations": [0.0, 0.0]}

    def there() -> Any:
        return trajectory(
            point(0.0, pan(robot), robot.now.joints[2].position, **rest),
            point(2.0, 0.6, 1.0, **rest),
            names=("shoulder_pan", "elbow_flex"),
        )

    name, *result = await client.done(there)
    assert result == ["succeeded", 0]
    assert pan(robot) == pytest.approx(0.6, abs=TOLERANCE_RAD)
    assert robot.now.joints[2].position == pytest.approx(1.0, abs=TOLERANCE_RAD)
    assert robot.now.gate.commander == "ros2"
    told = [each["value"] for each in client.program.seen("feedback", name=name)]
    assert len(told) > 10
    assert {tuple(each["joint_names"]) for each in told} == {tuple(NAMES)}
    half = min(told, key=lambda each: abs(each["desired"]["positions"][0] - 0.3))
    actual, desired = (half[part]["positions"][0] for part in ("actual", "desired"))
    assert actual == pytest.approx(desired, abs=0.15)
    assert half["error"]["positions"][0] == pytest.approx(desired - actual)
    await robot.becomes("idle")
    assert robot.now.gate.commander == ""


async def test_invalid_goals_have_error_codes_and_move_nothing(robot: Robot, judge: Judge) -> None:
    client, before = await following(judge, robot), pan(robot)
    wrong = {
        "fast": (trajectory(point(0.1, -1.5)), -1),
        "far": (trajectory(point(5.0, 3.0)), -1),
        "nan": (trajectory(point(5.0, float("nan"))), -1),
        "huge": (trajectory(point(5.0, 1e308)), -1),
        "late": (trajectory(point(2.0**31 - 1, 0.0)), -1),
        "back": (trajectory(point(2.0, 0.1), point(1.0, 0.0)), -1),
        "nobody": (trajectory(point(1.0, 0.0), names=("",)), -2),
        "elbow": (trajectory(point(1.0, 0.0), names=("elbow",)), -2),
        "old": (trajectory(point(1.0, 0.0)) | {"header": {"stamp": {"sec": 1000}}}, -3),
    }
    for name, (sent, code) in wrong.items():
        await client.send(name, sent)
        assert (name, *await client.result(name)) == (name, "aborted", code)
    assert robot.now.gate.mode == "idle"
    assert pan(robot) == pytest.approx(before, abs=0.01)


async def test_goals_are_cancelled_and_preempted(robot: Robot, judge: Judge) -> None:
    client = await following(judge, robot)
    first = await client.moving(trajectory(point(20.0, -1.5)), -1.0)
    other = await client.moving(trajectory(point(20.0, 1.5)), 1.0)
    assert await client.result(first) in (("aborted", 0), ("aborted", -1))
    await client.program.query("cancel", name=other)
    assert await client.result(other) == ("canceled", 0)
    await until(lambda: abs(robot.now.joints[0].velocity) < 0.05, "it rests")
    await robot.becomes("idle")


@pytest.mark.slow
async def test_a_violated_tolerance_ends_a_goal(robot: Robot, judge: Judge) -> None:
    client = await following(judge, robot)

    def away() -> Any:
        return trajectory(point(3.0, -0.5))

    tight = [{"name": "shoulder_pan", "position": 1e-6}]
    _, *result = await client.done(away, path_tolerance=tight)
    assert result == ["aborted", -4]
    sharp = [{"name": "shoulder_pan", "position": 1e-9}]
    _, *result = await client.done(away, goal_tolerance=sharp)
    assert result == ["aborted", -5]
    await robot.becomes("idle")


@pytest.mark.slow
async def test_the_topic_moves_the_arm_and_invalid_messages_are_reported(
    robot: Robot, judge: Judge
) -> None:
    sender = judge.start("drive")
    refused = functools.partial(await diagnosed(judge), "joint_trajectory")

    async def publish(message: Any) -> None:
        await sender.query("publish", topic="/joint_trajectory", type=TRAJECTORY, value=message)

    while not refused():  # until the subscription is discovered
        await publish(trajectory(point(1.0, 0.1), names=("elbow",)))
        await asyncio.sleep(0.5)
    await until(lambda: "no joint 'elbow'" in refused(), "it is named")
    for count in (9_000, 1_500):  # too many for a message, and for the joint
        await publish(trajectory(*(point(0.001 * n, 0.1) for n in range(1, count))))
    await until(lambda: "would have to move" in refused(), "it is too fast")
    assert robot.now.gate.mode == "idle"
    while abs(pan(robot) - 0.3) > TOLERANCE_RAD:  # the gate of a busy machine may stop it,
        await asyncio.sleep(1.0)  # and then the sender has to pause
        await publish(trajectory(point(2.0, 0.3)))
        with contextlib.suppress(TimeoutError):
            await until(lambda: robot.now.gate.commander == "ros2", "it moves", 10.0)
        await robot.becomes("idle")
    await until(lambda: "refused" not in refused(), "nothing is refused")


@pytest.mark.slow
async def test_the_example_moves_two_joints(robot: Robot, judge: Judge, ros2: Path) -> None:
    command = (str(ros2), str(ROOT / "examples/ros2/move_arm.py"))
    text = ""
    while "ended with code 0" not in text:
        process = await asyncio.create_subprocess_exec(
            *command, env=judge.environment(), stdout=asyncio.subprocess.PIPE
        )
        text = (await process.communicate())[0].decode()
        assert "ended with code 0" in text or "no valid command for" in text  # a busy machine
        await robot.becomes("idle")
    assert process.returncode == 0
    assert "3 s: 0." in text


async def held(robot: Robot) -> tuple[float, ...]:
    """Return the commanded positions, once they no longer change."""
    sent: list[tuple[float, ...]] = []

    def rests() -> bool:
        sent.append(robot.now.joints_sent)
        return len(sent) > 20 and len(set(sent[-20:])) == 1

    await until(rests, "it rests")
    return sent[-1]


async def test_an_estop_ends_a_goal_and_the_next_is_refused(robot: Robot, judge: Judge) -> None:
    client = await following(judge, robot)
    slow = await client.moving(trajectory(point(15.0, -1.5)), -1.0)
    await press_estop(robot.bus, "a test")
    assert await client.result(slow) == ("aborted", -1)
    await robot.becomes("latched")
    where = await held(robot)
    await client.send("again", trajectory(point(1.0, 0.0)))
    assert await client.result("again") == ("aborted", -1)
    assert robot.now.joints_sent == where
    await released(robot)
