"""Nav2's goals become our tasks: requests, feedback, preemption, cancelling, error codes."""

import asyncio
import math
from contextlib import asynccontextmanager

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import OccupancyGrid, PoseInMap
from gigabrain_schemas.tasks import Goal, GoalReply, MissionReply, Task, TaskReply, TaskStatus
from gigabrain_schemas.topics import BODY, GOAL, MAP, MISSION, POSE, STATE, TASK, TASK_CHANGE
from gigabrain_zenoh.decision.tasks.mission_files import loads
from gigabrain_zenoh.gateway.navigation import (
    EndState,
    Navigator,
    Outcome,
    feedback,
    requested,
)
from gigabrain_zenoh.gateway.result_codes import THROUGH_POSES, TO_POSE, inner_radius
from gigabrain_zenoh.gateway.scene import Scene
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing import samples
from gigabrain_zenoh.testing.in_memory import Net
from tests.node.ros2_robot import RosNode, gateway_on

MAKE = Types().make
THERE = Pose(x=2.0, y=1.0, yaw=0.5)
STOPS = (Pose(x=1.0, y=0.0, yaw=0.0), Pose(x=1.0, y=2.0, yaw=0.0), Pose(x=3.0, y=2.0, yaw=0.0))
FREE = OccupancyGrid(resolution=0.1, width=50, height=50, origin_x=-1.0, origin_y=-1.0,
                     cells=bytes(2500))  # fmt: skip


class Brain:
    """A stand-in for decision, and the navigator that sends requests to it."""

    def __init__(self):
        self.net = Net()
        self.bus = self.net.one
        self.bus.time.boot = samples.BOOT
        self.navigator = Navigator(Scene(self.net.bus("ros2")))
        self.requests, self.done, self.tick, self.count = [], [], 0, 0
        self.refusal, self.progress = "", []
        self.bus.serve(GOAL, self._goal)
        self.bus.serve(MISSION, self._mission)
        self.bus.serve(TASK_CHANGE, self._change)

    async def _goal(self, request):
        self.requests.append((request.x, request.y, request.yaw, request.how))
        if self.refusal:
            return GoalReply(ok=False, text=self.refusal)
        self.count += 1
        return GoalReply(ok=True, text="on the way", goal=f"goal-{self.count}")

    async def _mission(self, request):
        self.requests.append(loads(request.mission, "mission"))
        self.count += 1
        return MissionReply(ok=True, text="", task=f"mission-{self.count}")

    async def _change(self, request):
        self.requests.append((request.do, request.task))
        return TaskReply(ok=True, text="")

    async def located(self, x=0.0, y=0.0, grid=FREE):
        self.bus.publish(BODY, samples.body())
        self.tick += 1
        self.bus.time.tick = self.tick
        self.bus.publish(STATE, samples.state(self.tick))
        self.bus.publish(POSE, PoseInMap(x=x, y=y, yaw=0.0, covariance=(0.0,) * 9),
                         basis=self.tick)  # fmt: skip
        if grid:
            self.bus.publish(MAP, grid)
        await self.settle()

    async def settle(self):
        await self.net.clock.advance(0)

    def begin(self, poses=(THERE,), codes=TO_POSE):
        return asyncio.ensure_future(self.navigator.carry_out(codes, poses, self.progress.append))

    async def publish_task(self, state, name="goal-1", reason="", source="ros2", **about):
        """Publish the status of a task that is active, or has ended."""
        task = Task(id=name, kind="goal", label="", source=source, state=state, reason=reason)
        if state in ("succeeded", "failed", "cancelled"):
            self.done.insert(0, task)
            status = TaskStatus(done=tuple(self.done), **about)
        else:
            status = TaskStatus(current=task, done=tuple(self.done), **about)
        self.bus.publish(TASK, status)
        await self.settle()


async def test_a_goal_becomes_a_task_whose_end_is_the_result():
    brain = Brain()
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    assert brain.requests == [(2.0, 1.0, 0.5, "replace")]
    await brain.publish_task(
        "active", path=((0.0, 0.0), (2.0, 1.0)), distance_remaining=2.5, eta=11.0
    )
    await brain.publish_task("succeeded")
    assert await goal == Outcome(EndState.SUCCEEDED, 0, "")


async def test_feedback_has_pose_time_and_remaining_distance():
    brain = Brain()
    await brain.located(x=0.5, y=0.25)
    goal = brain.begin()
    await brain.settle()
    brain.net.clock.stall(1_500_000_000)
    await brain.located(x=0.75, y=0.25)
    await brain.publish_task(
        "active", path=((0.0, 0.0), (2.0, 1.0)), distance_remaining=2.5, eta=11.25
    )
    await brain.publish_task("active", name="goal-9", distance_remaining=99.0)
    (progress,) = brain.progress
    made = feedback(MAKE, "nav2_msgs/action/NavigateToPose", 7_000_000_001, progress)
    assert (made.current_pose.header.frame_id, made.current_pose.header.stamp.sec) == ("map", 7)
    assert (made.current_pose.pose.position.x, made.current_pose.pose.position.y) == (0.75, 0.25)
    assert made.navigation_time.sec == 1
    assert (made.estimated_time_remaining.sec, made.estimated_time_remaining.nanosec) == (
        11, 250_000_000,
    )  # fmt: skip
    assert (made.distance_remaining, made.number_of_recoveries) == (2.5, 0)
    await brain.publish_task("succeeded")
    await goal


async def test_several_poses_become_a_mission_and_feedback_counts_the_remaining_ones():
    brain = Brain()
    await brain.located()
    goal = brain.begin(STOPS, THROUGH_POSES)
    await brain.settle()
    (mission,) = brain.requests
    assert [step.goto for step in mission.do] == [(1.0, 0.0, 0.0), (1.0, 2.0, 0.0), (3.0, 2.0, 0.0)]
    for at in STOPS:
        await brain.publish_task("active", "mission-1", goal=Goal(x=at.x, y=at.y + 0.1),
                        distance_remaining=0.5, eta=2.0)  # fmt: skip
    assert [each.poses_left for each in brain.progress] == [3, 2, 1]
    assert [each.left_m for each in brain.progress] == pytest.approx([4.5, 2.5, 0.5])
    assert [each.left_s for each in brain.progress] == pytest.approx(
        [2 + 4 / 0.26, 2 + 2 / 0.26, 2]
    )
    action = "nav2_msgs/action/NavigateThroughPoses"
    assert feedback(MAKE, action, 0, brain.progress[1]).number_of_poses_remaining == 2
    await brain.publish_task("succeeded", "mission-1")
    assert (await goal).state is EndState.SUCCEEDED


async def test_a_cancel_cancels_the_task():
    brain = Brain()
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    goal.cancel()
    await brain.settle()
    assert goal.cancelled()
    assert brain.requests[1:] == [("cancel", "goal-1")]


async def test_a_cancel_before_the_answer_cancels_the_task_that_was_accepted():
    brain = Brain()
    await brain.located()
    goal = brain.begin()
    await asyncio.sleep(0)
    goal.cancel()
    with pytest.raises(asyncio.CancelledError):
        await goal
    assert brain.requests == [(2.0, 1.0, 0.5, "replace"), ("cancel", "goal-1")]


async def test_a_new_goal_replaces_the_task_without_a_cancel_between():
    brain = Brain()
    await brain.located()
    old = brain.begin()
    await brain.settle()
    new = brain.begin((replace(THERE, x=1.5),))
    old.cancel()
    await brain.settle()
    assert brain.requests == [(2.0, 1.0, 0.5, "replace"), (1.5, 1.0, 0.5, "replace")]
    await brain.publish_task("succeeded", "goal-2")
    assert (await new).state is EndState.SUCCEEDED


async def test_a_new_goal_ends_the_previous_task_even_if_it_is_refused():
    brain = Brain()
    await brain.located()
    old = brain.begin()
    await brain.settle()
    brain.refusal = "no path leads there"
    new = brain.begin()
    old.cancel()
    assert (await new).state is EndState.ABORTED
    assert brain.requests[2:] == [("cancel", "goal-1")]


async def test_a_task_that_another_client_ends_is_aborted_with_its_reason():
    brain = Brain()
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    await brain.publish_task("cancelled", reason="cancelled by ann")
    assert await goal == Outcome(EndState.ABORTED, 9000, "cancelled by ann")


@pytest.mark.parametrize(("path", "code"), [(((0.0, 0.0), (2.0, 1.0)), 105), ((), 208)])
async def test_a_task_that_fails_has_the_code_of_the_controller_or_the_planner(path, code):
    brain = Brain()
    await brain.located()
    goal = brain.begin()
    await brain.settle()
    await brain.publish_task("active", path=path)
    await brain.publish_task("failed", reason="gave up")
    assert await goal == Outcome(EndState.ABORTED, code, "gave up")


def with_wall(column, row=None):
    """Return a map with an occupied column of cells, or one cell."""
    cells = np.zeros((50, 50), np.int8)
    cells[slice(None) if row is None else row, column] = 100
    return replace(FREE, cells=cells.tobytes())


@pytest.mark.parametrize(
    ("codes", "here", "goal", "grid", "code"),
    [
        (TO_POSE, (0.0, 0.0), (2.0, 1.0), with_wall(20), 208),
        (THROUGH_POSES, (0.0, 0.0), (2.0, 1.0), with_wall(20), 308),
        (TO_POSE, (0.0, 0.0), (9.0, 1.0), FREE, 204),
        (TO_POSE, (-3.0, 0.0), (2.0, 1.0), FREE, 203),
        (TO_POSE, (0.05, 0.05), (2.0, 1.0), with_wall(10, 10), 205),
        (TO_POSE, (0.0, 0.0), (2.05, 1.05), with_wall(30, 20), 206),
        (TO_POSE, (0.0, 0.0), (2.05, 1.11), with_wall(30, 20), 208),
        (TO_POSE, (0.0, 0.0), (2.0, 1.0), None, 202),
        (TO_POSE, None, (2.0, 1.0), FREE, 202),
    ],
)
async def test_a_refused_goal_has_the_code_of_the_planner(codes, here, goal, grid, code):
    brain = Brain()
    if here:
        await brain.located(*here, grid)
    elif grid:
        brain.bus.publish(MAP, grid)
    brain.refusal = "no path leads to the goal"
    found = await brain.begin((Pose(x=goal[0], y=goal[1], yaw=0.0),), codes)
    assert found == Outcome(EndState.ABORTED, code, "no path leads to the goal")


def test_the_largest_circle_in_a_footprint_touches_its_nearest_side():
    assert inner_radius(samples.WAFFLE.footprint) == pytest.approx(0.075)
    assert inner_radius(((1.0, 1.0), (2.0, 1.0), (2.0, 2.0))) == pytest.approx(math.sqrt(2))


def ros_goal(frame="map", x=2.0, w=1.0):
    return MAKE("geometry_msgs/msg/PoseStamped", header={"frame_id": frame},
                pose={"position": {"x": x, "y": 1.0}, "orientation": {"w": w}})  # fmt: skip


@pytest.mark.parametrize(
    ("poses", "tree", "code"),
    [
        ([ros_goal("base_link")], "", 9002),
        ([ros_goal("odom")], "", 9002),
        ([ros_goal(x=math.nan)], "", 9002),
        ([ros_goal(w=0.0)], "", 9002),
        ([ros_goal()], "my_tree.xml", 9001),
        ([], "", 9000),
        ([ros_goal()] * 201, "", 9000),
    ],
)
def test_an_invalid_goal_has_an_error_code_and_a_text(poses, tree, code):
    fault = requested(TO_POSE, poses, tree, None).fault
    assert (fault.state, fault.code) == (EndState.ABORTED, code)
    assert fault.text


def test_goals_in_odom_are_transformed_to_the_map():
    odom = Pose(x=10.0, y=0.0, yaw=math.pi / 2)
    (found,) = requested(TO_POSE, [ros_goal("odom")], "", odom).poses
    assert (found.x, found.y, found.yaw) == pytest.approx((9.0, 2.0, math.pi / 2))


ACTION = "nav2_msgs/action/NavigateToPose"
THROUGH = "nav2_msgs/action/NavigateThroughPoses"


class Client:
    """A client of the gateway's actions, on a ROS network in memory."""

    def __init__(self, brain, node):
        self.brain, self.node = brain, node
        self.results = {}

    async def send(self, number, poses=None, name="/navigate_to_pose", **fields):
        """Send a goal, and request its result in a task; return whether the goal was accepted."""
        kind = THROUGH if name.endswith("poses") else ACTION
        key = "poses" if kind == THROUGH else "pose"
        goal = {key: poses if poses is not None else ros_goal(), **fields}
        id = {"uuid": np.full(16, number, np.uint8)}
        reply = await self.node.call(
            f"{name}/_action/send_goal", f"{kind}_SendGoal", goal_id=id, goal=goal
        )
        if reply.accepted:
            getting = self.node.call(f"{name}/_action/get_result", f"{kind}_GetResult", goal_id=id)
            self.results[number] = asyncio.ensure_future(getting)
        await self.brain.settle()
        return reply.accepted

    async def result(self, number):
        response = await self.results[number]
        return response.status, response.result.error_code

    async def cancel(self, number):
        info = {"goal_id": {"uuid": np.full(16, number, np.uint8)}}
        reply = await self.node.call(
            "/navigate_to_pose/_action/cancel_goal", "action_msgs/srv/CancelGoal", goal_info=info
        )
        await self.brain.settle()
        return reply.return_code, len(reply.goals_canceling)


@asynccontextmanager
async def client():
    brain = Brain()
    async with gateway_on(brain.net.network, brain.net.clock) as (_, ros):
        await brain.located()
        yield Client(brain, RosNode(ros, brain.net.clock))


async def test_a_client_of_ros_sends_a_goal_follows_it_and_gets_the_result():
    async with client() as ros:
        topic = "/navigate_to_pose/_action/feedback"
        ros.node.read(topic, f"{ACTION}_FeedbackMessage")
        assert await ros.send(1)
        assert ros.brain.requests == [(2.0, 1.0, 0.0, "replace")]
        await ros.brain.publish_task(
            "active", path=((0.0, 0.0), (2.0, 1.0)), distance_remaining=2.25
        )
        (message,) = ros.node.received[topic]
        assert message.goal_id.uuid.tolist() == [1] * 16
        assert message.feedback.distance_remaining == 2.25
        await ros.brain.publish_task("succeeded")
        assert await ros.result(1) == (4, 0)


async def test_a_client_of_ros_cancels_a_goal():
    async with client() as ros:
        await ros.send(1)
        assert await ros.cancel(1) == (0, 1)
        assert ros.brain.requests[1:] == [("cancel", "goal-1")]
        assert await ros.result(1) == (5, 0)
        assert await ros.cancel(1) == (3, 0)


async def test_a_new_goal_preempts_the_previous_one_which_is_aborted_as_in_nav2():
    async with client() as ros:
        await ros.send(1)
        await ros.send(2, ros_goal(x=1.5))
        assert await ros.result(1) == (6, 0)
        assert ros.brain.requests == [(2.0, 1.0, 0.0, "replace"), (1.5, 1.0, 0.0, "replace")]
        await ros.brain.publish_task("succeeded", "goal-2")
        assert await ros.result(2) == (4, 0)


async def test_an_invalid_goal_is_aborted_and_does_not_end_the_present_one():
    async with client() as ros:
        await ros.send(1)
        await ros.send(2, ros_goal("camera"))
        assert await ros.result(2) == (6, 9002)
        await ros.brain.publish_task("succeeded")
        assert await ros.result(1) == (4, 0)


async def test_a_goal_without_a_path_is_aborted_with_the_planners_code():
    async with client() as ros:
        ros.brain.refusal = "no path leads to the goal"
        await ros.send(1, ros_goal(x=99.0))
        assert await ros.result(1) == (6, 204)


async def test_while_several_poses_are_driven_a_single_one_is_rejected():
    async with client() as ros:
        name = "/navigate_through_poses"
        topic = f"{name}/_action/feedback"
        ros.node.read(topic, f"{THROUGH}_FeedbackMessage")
        assert await ros.send(1, [ros_goal(x=1.0), ros_goal(x=2.0)], name)
        assert not await ros.send(2)
        await ros.brain.publish_task(
            "active", "mission-1", goal=Goal(x=2.0, y=1.0), distance_remaining=0.5
        )
        assert ros.node.received[topic][0].feedback.number_of_poses_remaining == 1
        await ros.brain.publish_task("succeeded", "mission-1")
        assert await ros.result(1) == (4, 0)
        assert await ros.send(3)


async def test_a_gateway_that_ends_cancels_the_task_of_ros():
    brain = Brain()
    async with gateway_on(brain.net.network, brain.net.clock) as (_, network):
        await brain.located()
        ros = Client(brain, RosNode(network, brain.net.clock))
        await ros.send(1)
    assert brain.requests[1:] == [("cancel", "goal-1")]
    assert await ros.result(1) == (6, 0)
