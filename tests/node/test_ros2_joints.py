"""ROS moves the joints of an arm in memory: a topic and an action, through the gate, in ticks."""

import math
import random
from contextlib import asynccontextmanager
from xml.etree import ElementTree as xml

import numpy as np
import pytest

from gigabrain_schemas.topics import JOINT_CMD
from gigabrain_zenoh.client import requests
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.errors import NoAnswer
from gigabrain_zenoh.gateway.joint_requests import FOLLOW_TYPE, TRAJECTORY
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED
from tests.node.ros2_arm import NAMES, ArmRobot, Client
from tests.node.ros2_robot import TYPES
from tests.node.test_ros2_hostile import mutated, payload_of

SUCCEEDED, CANCELED, ABORTED = 4, 5, 6
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
REFUSED = "joint_trajectory_refused"


@pytest.fixture(autouse=True)
def _patient(monkeypatch):
    """Prevent that a slow disk of this machine delays the answer, and the e-stop is repeated."""
    monkeypatch.setattr(requests, "FIRST_S", 1.9)


@asynccontextmanager
async def ready(folder, config=None):
    """Yield a robot that is released and idle, and a client of the action."""
    async with ArmRobot(folder, config) as robot:
        await robot.released()
        yield robot, Client(robot)


async def test_joint_states_have_all_joints_even_if_limp(tmp_path):
    async with ArmRobot(tmp_path) as robot:
        robot.node.read("/joint_states", "sensor_msgs/msg/JointState")
        await robot.go(5)
        assert (await requests.let_go(robot.operator, limp=True)).ok
        await robot.go(5)
        assert robot.state.limp
        message = robot.node.received["/joint_states"][-1]
        assert message.name == list(NAMES)
        assert message.position == pytest.approx([*robot.robot.arm.home])
        assert len(message.velocity) == 6
        assert message.effort == pytest.approx([0.1] * 6)


STRING, TF = "std_msgs/msg/String", "tf2_msgs/msg/TFMessage"
LINKS = ["shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw"]  # each with a joint


def arm_links(message):
    return [each.child_frame_id for each in message.transforms if each.child_frame_id in LINKS]


async def test_a_description_with_the_whole_arm_and_the_frames_of_its_links_are_published(tmp_path):
    async with ArmRobot(tmp_path) as robot:
        robot.node.read("/robot_description", STRING, LATCHED)
        robot.node.read("/tf_static", TF, LATCHED)
        robot.node.read("/tf", TF)
        robot.arm.positions, robot.arm.blocked = {**robot.arm.positions, "shoulder_pan": 1.0}, True
        await robot.go(150)
        (text,) = robot.node.received["/robot_description"]
        urdf = xml.fromstring(text.data)
        kinds = {joint.get("name"): joint.get("type") for joint in urdf.findall("joint")}
        assert [kinds[name] for name in NAMES] == ["revolute"] * 6
        static = robot.node.received["/tf_static"][-1]
        found = {each.child_frame_id: each.header.frame_id for each in static.transforms}
        assert (found["base"], found["tool"]) == ("base_link", "gripper")
        moving = robot.node.received["/tf"][-1]
        assert arm_links(moving) == LINKS
        pan = next(each for each in moving.transforms if each.child_frame_id == "shoulder")
        turn = pan.transform.rotation  # about -z
        assert 2 * math.atan2(turn.z, turn.w) == pytest.approx(-1.0)
        joints = {joint.find("child").get("link") for joint in urdf.findall("joint")}
        frames = {*found, *(each.child_frame_id for each in moving.transforms)}
        assert joints == frames - {"base_footprint"}


async def test_the_description_is_published_without_a_model_that_cannot_be_read(tmp_path, caplog):
    async with ArmRobot(tmp_path, mjcf="<mujoco><worldbody>") as robot:
        robot.node.read("/robot_description", STRING, LATCHED)
        robot.node.read("/tf", TF)
        await robot.go(150)
        (text,) = robot.node.received["/robot_description"]
        assert 'link name="base_link"' in text.data
        assert "shoulder" not in text.data
        assert arm_links(robot.node.received["/tf"][-1]) == []
        assert caplog.text.count("the arm's model cannot be drawn") == 1


async def test_a_trajectory_on_the_topic_is_followed_and_the_body_becomes_idle(tmp_path):
    async with ready(tmp_path) as (robot, _):
        robot.publish(robot.trajectory((1.0, 0.5, 0.8), names=("shoulder_pan", "gripper")))
        await robot.go(35)
        assert robot.state.gate.commander == "ros2"
        assert 0.1 < robot.at("shoulder_pan") < 0.4
        await robot.go(35)
        assert robot.at("shoulder_pan") == pytest.approx(0.5, abs=0.01)
        assert robot.at("gripper") == pytest.approx(0.8, abs=0.01)
        assert robot.at("elbow_flex") == pytest.approx(1.4, abs=1e-6)
        assert robot.state.gate.commander == "ros2"
        await robot.go(50)
        assert (robot.state.gate.mode, robot.state.gate.commander) == ("idle", "")
        assert robot.at("shoulder_pan") == pytest.approx(0.5, abs=0.01)
        assert robot.gateway_bus.counters[REFUSED] == 0


async def test_a_goal_has_feedback_and_succeeds(tmp_path):
    async with ready(tmp_path) as (robot, client):
        id = await client.send(robot.trajectory((1.0, 0.5)))
        await robot.go(80)
        assert await client.result(id) == (SUCCEEDED, 0, "")
        half = next(each for each in client.feedback if each.desired.time_from_start.nanosec >= 5e8)
        assert half.joint_names == list(NAMES)
        assert half.desired.positions[0] == pytest.approx(0.25, abs=0.03)
        assert half.actual.positions[0] == pytest.approx(half.desired.positions[0], abs=0.05)
        assert half.error.positions == pytest.approx(half.desired.positions - half.actual.positions)
        assert half.desired.velocities[0] == pytest.approx(0.5)
        assert half.desired.positions[2] == pytest.approx(1.4)


async def test_an_invalid_goal_is_aborted_with_its_code_and_the_present_one_continues(tmp_path):
    async with ready(tmp_path) as (robot, client):
        good = await client.send(robot.trajectory((2.0, 0.8)))
        await robot.go(20)
        now = robot.clock.unix_ns() // 10**9
        bad = {
            -1: robot.trajectory((0.1, 1.5)),
            -2: robot.trajectory((1.0, 0.5), names=("shoulder",)),
            -3: robot.trajectory((1.0, 0.5), header={"stamp": {"sec": now - 9}}),
        }
        for code, message in bad.items():
            found = await client.result(await client.send(message))
            assert found[:2] == (ABORTED, code)
            assert found[2]
        bumper = [TYPES.make("control_msgs/msg/JointTolerance", name="bumper")]
        id = await client.send(robot.trajectory((1.0, 0.5)), goal_tolerance=bumper)
        assert (await client.result(id))[1] == -2
        await robot.go(110)
        assert (await client.result(good))[:2] == (SUCCEEDED, 0)


async def test_a_cancelled_goal_brakes_at_once_and_the_arm_is_held(tmp_path):
    async with ready(tmp_path) as (robot, client):
        id = await client.send(robot.trajectory((2.0, 1.6)))
        await robot.go(50)
        answer = await client.cancel(id)
        assert len(answer.goals_canceling) == 1
        where = robot.at("shoulder_pan")
        await robot.go(30)
        assert (await client.result(id))[:2] == (CANCELED, 0)
        assert robot.at("shoulder_pan") == pytest.approx(where, abs=0.15)
        stays = robot.at("shoulder_pan")
        await robot.go(50)
        assert robot.at("shoulder_pan") == pytest.approx(stays, abs=0.01)


@pytest.mark.parametrize("by", ["goal", "topic"])
async def test_a_newer_trajectory_preempts_a_goal_without_a_stop(tmp_path, by):
    async with ready(tmp_path) as (robot, client):
        old = await client.send(robot.trajectory((2.0, 1.0)))
        await robot.go(40)
        newer = robot.trajectory((1.0, -0.5))
        new = await client.send(newer) if by == "goal" else robot.publish(newer)
        await robot.go(1)
        assert (await client.result(old))[0] == ABORTED
        enables = robot.state.gate.enables
        await robot.go(70)
        assert robot.at("shoulder_pan") == pytest.approx(-0.5, abs=0.01)
        assert robot.state.gate.enables == enables
        if new:
            assert (await client.result(new))[:2] == (SUCCEEDED, 0)


async def test_a_blocked_joint_violates_the_path_tolerance(tmp_path):
    async with ready(tmp_path) as (robot, client):
        id = await client.send(robot.trajectory((2.0, 1.6)))
        await robot.go(20)
        robot.arm.blocked = True
        where = robot.at("shoulder_pan")
        await robot.go(40)
        status, code, text = await client.result(id)
        assert (status, code) == (ABORTED, -4)
        assert "shoulder_pan is 0.3" in text
        await robot.go(20)
        assert robot.state.joints_sent[0] == pytest.approx(where, abs=0.03)  # braked on the way


async def test_a_joint_that_misses_its_target_violates_the_goal_tolerance(tmp_path):
    async with ready(tmp_path) as (robot, client):
        free = [TYPES.make("control_msgs/msg/JointTolerance", name="shoulder_pan", position=-1.0)]
        robot.arm.blocked = True
        id = await client.send(robot.trajectory((1.0, 0.5)), path_tolerance=free)
        await robot.go(90)
        assert robot.state.gate.commander == "ros2"
        await robot.go(40)
        assert (await client.result(id))[:2] == (ABORTED, -5)
        id = await client.send(
            robot.trajectory((1.0, 0.5)), path_tolerance=free, goal_tolerance=free
        )
        await robot.go(80)
        assert (await client.result(id))[:2] == (SUCCEEDED, 0)


async def test_an_estop_ends_a_goal_and_later_ones_are_refused(tmp_path):
    async with ready(tmp_path) as (robot, client):
        robot.node.read("/diagnostics", DIAGNOSTICS)
        id = await client.send(robot.trajectory((2.0, 1.6)))
        await robot.go(40)
        assert (await robot.node.call("/estop", "std_srvs/srv/SetBool", data=True)).success
        await robot.go(6)
        stays = robot.at("shoulder_pan")
        status, code, text = await client.result(id)
        assert (status, code) == (ABORTED, -1)
        assert "e-stop" in text
        robot.publish(robot.trajectory((1.0, 0.0)))
        await robot.go(60)
        assert robot.at("shoulder_pan") == pytest.approx(stays, abs=0.05)
        found = robot.diagnostics()["gigabrain: joint_trajectory"]
        assert found.level == 1
        assert "refused: latched: e-stop pressed by ros2" in found.message
        assert "latched" in (await client.result(await client.send(
            robot.trajectory((1.0, 0.0)))))[2]  # fmt: skip
        assert robot.gateway_bus.counters[REFUSED] == 1
        await robot.released()
        robot.publish(robot.trajectory((1.0, 0.0)))
        await robot.go(80)
        assert robot.at("shoulder_pan") == pytest.approx(0.0, abs=0.01)
        await robot.go(50)
        assert "gigabrain: joint_trajectory" not in robot.diagnostics()


async def test_a_velocity_command_for_an_arm_without_a_base_is_refused_and_reported(tmp_path):
    async with ready(tmp_path) as (robot, _):
        robot.node.read("/diagnostics", DIAGNOSTICS)
        for speed in (0.0, 0.2):
            for _ in range(60):
                robot.node.drive(speed)
                await robot.go(1)
            found = robot.diagnostics()["gigabrain: cmd_vel"]
            assert (found.level, "has no base to drive" in found.message) == (
                (1, True) if speed else (0, False)
            )
        assert robot.gateway_bus.counters["cmd_vel_no_base"] == 60
        await robot.go(80)
        assert robot.diagnostics()["gigabrain: cmd_vel"].level == 0


async def stream(robot, ticks):
    """Publish a trajectory a little beyond the sent position, every second tick."""
    for _ in range(ticks // 2):
        robot.publish(robot.trajectory((0.1, robot.state.joints_sent[0] + 0.01)))
        await robot.go(2)


async def test_after_a_stop_a_stream_of_trajectories_is_refused_until_it_pauses(tmp_path):
    async with ready(tmp_path) as (robot, _):
        await stream(robot, 40)
        assert robot.state.gate.commander == "ros2"
        assert robot.at("shoulder_pan") > 0.02
        robot.safe = False  # safety's process dies
        await stream(robot, 30)
        robot.safe = True
        stays = robot.at("shoulder_pan")
        await stream(robot, 40)
        assert robot.state.gate.mode == "idle"
        assert robot.at("shoulder_pan") == pytest.approx(stays, abs=0.01)
        await robot.go(30)
        await stream(robot, 40)
        assert robot.at("shoulder_pan") > stays + 0.02


async def test_a_freeze_of_the_gateway_is_not_a_pause_of_a_stream(tmp_path):
    async with ready(tmp_path) as (robot, _):
        await stream(robot, 40)
        assert robot.at("shoulder_pan") > 0.02
        robot.gateway_network.frozen = True  # its ROS transport keeps only the newest message
        await robot.go(60)
        robot.gateway_network.frozen = False
        await robot.go(3)
        stays = robot.at("shoulder_pan")
        await stream(robot, 40)
        assert robot.at("shoulder_pan") == pytest.approx(stays, abs=0.01)
        assert robot.state.gate.mode == "idle"
        await robot.go(30)
        await stream(robot, 40)
        assert robot.at("shoulder_pan") > stays + 0.02


async def test_while_the_brain_commands_the_arm_ros_is_refused_unless_it_takes_it(tmp_path):
    for take in (False, True):
        async with ready(tmp_path, Ros2Config(take=take)) as (robot, client):
            await robot.commanded()
            id = await client.send(robot.trajectory((1.0, 0.5)))
            await robot.go(5)
            if take:
                assert robot.state.gate.commander == "ros2"
                continue
            status, code, text = await client.result(id)
            assert (status, code) == (ABORTED, -1)
            assert "control drives; end that first" in text
            assert robot.state.gate.commander == "control"


async def test_the_gateways_death_stops_the_arm_within_120_ms(tmp_path):
    async with ready(tmp_path) as (robot, client):
        await client.send(robot.trajectory((2.0, 1.6)))
        await robot.go(50)
        assert robot.state.joints[0].velocity > 0.7
        await robot._stack.aclose()
        await robot.go(6)
        sent = [each["shoulder_pan"] for each in robot.arm.history]
        await robot.go(20)
        after = [each["shoulder_pan"] for each in robot.arm.history[len(sent) :]]
        assert after == pytest.approx([after[0]] * len(after), abs=1e-6)
        assert after[0] == pytest.approx(sent[-1], abs=1e-6)


async def test_a_base_offers_neither_topic_nor_action(tmp_path):
    async with ArmRobot(tmp_path, Ros2Config(leave_out=("joint_trajectory",))) as robot:
        found = {each.topic for each in robot.node.transport.endpoints()}
        assert "/joint_trajectory" not in found
        assert "/follow_joint_trajectory/_action/feedback" in found


@pytest.mark.parametrize("seed", range(3))
async def test_mutated_and_wild_messages_move_nothing(tmp_path, seed):
    dice = random.Random(seed)
    async with ready(tmp_path) as (robot, client):
        good = TYPES.encode(TRAJECTORY, robot.trajectory((1.0, math.nan), (2.0, 1e308)))
        transport = robot.node.transport
        publisher = transport.publisher("/joint_trajectory", TRAJECTORY, DEFAULT)
        for _ in range(300):
            publisher.publish(mutated(dice, good))
            await robot.clock.advance(0)
        kind = f"{FOLLOW_TYPE}_SendGoal"
        for _ in range(40):
            try:
                request = mutated(dice, payload_of(f"{kind}_Request"))
                await transport.call(f"{Client.BASE}/send_goal", kind, request, 5.0)
            except NoAnswer:
                continue
        many = robot.trajectory(*((0.001 * n, 0.1) for n in range(1, 20_001)))
        robot.publish(many)
        await robot.go(20)
        assert robot.gateway_bus.counters[REFUSED] > 100
        assert robot.gateway_bus.sent[JOINT_CMD.key] == 0
        assert np.ptp([each["shoulder_pan"] for each in robot.arm.history]) == 0.0
        id = await client.send(robot.trajectory((0.5, 0.2)))
        await robot.go(60)
        assert (await client.result(id))[:2] == (SUCCEEDED, 0)
