"""Poses that RViz publishes, and the parameters of the node, on a gateway in memory."""

import asyncio
import math

import numpy as np
import pytest

from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.requests import PoseReply
from gigabrain_schemas.tasks import GoalReply
from gigabrain_schemas.topics import GOAL, POSE, POSE_SET
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.gateway import driving
from gigabrain_zenoh.testing.waiting import until
from tests.node.ros2_robot import TICK_NS
from tests.node.test_ros2_topics import diagnosed, driver


async def requests_for(robot, service, reply, topic, kind, **fields):
    """Publish a pose as RViz does; return the requests that our service `service` receives."""
    requests = []

    async def answer(request):
        requests.append(request)
        return reply

    robot.bus.serve(service, answer)
    await robot.states(2, pose=(1.0, 0.0, 0.0))
    robot.node.publish(topic, kind, **fields)
    await robot.clock.advance(TICK_NS)
    return requests


GUESS = "geometry_msgs/msg/PoseWithCovarianceStamped"
THERE = {"position": {"x": 2.0, "y": 3.0}, "orientation": {"z": 1.0, "w": 0.0}}
COVARIANCE = np.diag((0.25, 0.25, 0, 0, 0, 0.07)).ravel()


async def test_initialpose_sets_the_pose_with_its_covariance():
    async with driver() as robot:
        guess = {"pose": THERE, "covariance": COVARIANCE}
        (request,) = await requests_for(
            robot, POSE_SET, PoseReply(ok=True, text="looking"), "/initialpose", GUESS,
            header={"frame_id": "map"}, pose=guess,
        )  # fmt: skip
        assert (request.x, request.y, request.source) == (2.0, 3.0, "ros2")
        assert abs(request.yaw) == pytest.approx(math.pi)
        assert request.covariance == (0.25, 0, 0, 0, 0.25, 0, 0, 0, 0.07)


POSE_STAMPED = "geometry_msgs/msg/PoseStamped"


async def test_a_goal_pose_that_is_answered_late_may_have_been_accepted(monkeypatch):
    monkeypatch.setattr(driving, "PLAN_S", 0.01)
    async with driver() as robot:
        await robot.body()
        robot.read("/diagnostics")
        robot.bus.serve(GOAL, lambda _: asyncio.Event().wait())
        robot.node.publish("/goal_pose", POSE_STAMPED, header={"frame_id": "map"}, pose=THERE)
        await robot.clock.advance(0)
        await until(lambda: robot.gateway_bus.counters["goal_pose_refused"], "the timeout")
        _, text = (await diagnosed(robot))["gigabrain: goal_pose"]
        assert "no answer within 0.01 s; `gigabrain task list` shows" in text


async def test_goal_pose_is_a_goal_in_map_or_odom():
    async with driver() as robot:
        accepted = GoalReply(ok=True, text="on the way", goal="goal-1")
        (request,) = await requests_for(
            robot,
            GOAL,
            accepted,
            "/goal_pose",
            POSE_STAMPED,
            header={"frame_id": "map"},
            pose=THERE,
        )
        assert (request.x, request.y, request.how, request.source) == (2.0, 3.0, "replace", "ros2")
        await robot.publish(POSE, PoseInMap(x=1.0, y=9.0, yaw=0.0, covariance=(0.0,) * 9), basis=2)
        await robot.states(1, pose=(1.0, 0.0, 0.0))
        requests = []

        async def answer(request):
            requests.append(request)
            return accepted

        robot.bus.serve(GOAL, answer)
        robot.node.publish("/goal_pose", POSE_STAMPED, header={"frame_id": "odom"}, pose=THERE)
        await robot.clock.advance(TICK_NS)
        assert (requests[0].x, requests[0].y) == pytest.approx((2.0, 12.0))


@pytest.mark.parametrize(
    ("frame", "pose", "words"),
    [
        ("base_link", THERE, "frame 'base_link'"),
        ("odom", THERE, "a goal in odom needs a localized robot"),
        ("map", {"position": {"x": math.nan}}, "position"),
    ],
)
async def test_an_invalid_goal_pose_is_refused_and_reported_in_diagnostics(frame, pose, words):
    async with driver() as robot:
        await robot.body()
        robot.read("/diagnostics")
        reply = GoalReply(ok=True, text="on the way", goal="goal-1")
        header = {"frame_id": frame}
        assert not await requests_for(
            robot, GOAL, reply, "/goal_pose", POSE_STAMPED, header=header, pose=pose
        )
        level, text = (await diagnosed(robot))["gigabrain: goal_pose"]
        assert (level, words in text) == (1, True)
        assert robot.gateway_bus.problems[0].code == "ros2_goal_pose"


async def test_of_many_goals_at_once_only_the_first_and_the_newest_are_requested():
    async with driver() as robot:
        requests, go_on = [], asyncio.Event()

        async def answer(request):
            requests.append(request.x)
            await go_on.wait()
            return GoalReply(ok=True, text="on the way", goal="goal-1")

        robot.bus.serve(GOAL, answer)
        for number in range(100):
            pose = {"position": {"x": float(number)}}
            robot.node.publish("/goal_pose", POSE_STAMPED, header={"frame_id": "map"}, pose=pose)
            await robot.clock.advance(0)
        go_on.set()
        await robot.clock.advance(TICK_NS)
        assert requests == [0.0, 99.0]


async def test_an_initialpose_in_another_frame_is_refused():
    async with driver() as robot:
        requests = await requests_for(
            robot, POSE_SET, PoseReply(ok=True, text=""), "/initialpose", GUESS,
            header={"frame_id": "odom"}, pose={"pose": THERE},
        )  # fmt: skip
        assert requests == []
        assert robot.gateway_bus.counters["initialpose_refused"] == 1


RCL = "rcl_interfaces/srv"


async def test_the_settings_are_parameters_that_cannot_be_set():
    async with driver(Ros2Config(cmd_vel_timeout=0.15, leave_out=("imu",))) as robot:
        await robot.body()
        call = robot.node.call
        listed = (await call("/gigabrain/list_parameters", f"{RCL}/ListParameters")).result.names
        assert {"use_sim_time", "transport", "domain", "cmd_vel_timeout", "take"} <= set(listed)
        names = ["use_sim_time", "domain", "cmd_vel_timeout", "transport", "leave_out", "nothing"]
        found = await call("/gigabrain/get_parameters", f"{RCL}/GetParameters", names=names)
        assert [each.type for each in found.values] == [1, 2, 3, 4, 9, 0]
        time, domain, timeout, transport, left, _ = found.values
        assert (time.bool_value, domain.integer_value) == (True, 0)
        assert (timeout.double_value, transport.string_value) == (0.15, "rmw_zenoh")
        assert left.string_array_value == ["imu"]
        types = await call(
            "/gigabrain/get_parameter_types", f"{RCL}/GetParameterTypes", names=names
        )
        assert list(types.types) == [1, 2, 3, 4, 9, 0]
        about = await call(
            "/gigabrain/describe_parameters", f"{RCL}/DescribeParameters", names=["take"]
        )
        assert (about.descriptors[0].type, about.descriptors[0].read_only) == (1, True)
        wanted = [{"name": "take", "value": {"type": 1, "bool_value": True}}]
        done = await call("/gigabrain/set_parameters", f"{RCL}/SetParameters", parameters=wanted)
        assert (done.results[0].successful, "read-only" in done.results[0].reason) == (False, True)
        done = await call("/gigabrain/set_parameters_atomically", f"{RCL}/SetParametersAtomically",
                          parameters=wanted)  # fmt: skip
        assert not done.result.successful
