"""Open-RMF's free_fleet adapter, in memory: its requests, our answers and our topics."""

import math
import random
from contextlib import asynccontextmanager

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.topics import BODY, CMD_VEL, STATE
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.ros2.types import MAX_COMMAND
from gigabrain_zenoh.testing import samples
from gigabrain_zenoh.testing.waiting import until
from tests.node.ros2_robot import TYPES, RosNode, gateway_on
from tests.node.test_ros2_hostile import mutated
from tests.node.test_ros2_navigation import ACTION, Brain, Client, ros_goal

SERVICES = {
    "send_goal": f"{ACTION}_SendGoal",
    "get_result": f"{ACTION}_GetResult",
    "cancel_goal": "action_msgs/srv/CancelGoal",
}
TOPICS = {
    "tf": "tf2_msgs/msg/TFMessage",
    "battery_state": "sensor_msgs/msg/BatteryState",
    "navigate_to_pose/_action/feedback": f"{ACTION}_FeedbackMessage",
    "navigate_to_pose/_action/status": "action_msgs/msg/GoalStatusArray",
}
EVERY_GOAL = 0


def goal_id(number):
    return {"uuid": np.full(16, number, np.uint8)}


class Adapter:
    """The adapter's side: plain Zenoh keys, and ROS types only for the payloads."""

    def __init__(self, brain, gateway_bus, node):
        self.brain, self.gateway_bus, self.node = brain, gateway_bus, node
        self.transport, self.received = brain.net.network.transport(), {key: [] for key in TOPICS}

    def read(self, key):
        """Subscribe; return a function that unsubscribes."""
        received = self.received[key]
        return self.transport.subscribe(
            key, lambda _, payload: received.append(TYPES.decode(TOPICS[key], payload)), 1
        )

    async def post(self, name, payload):
        """Query a service; return its reply, CDR or an error text. Fake time stands still."""
        key = f"navigate_to_pose/_action/{name}"
        (reply,) = await self.transport.query(key, payload, "", 1.0, "data")
        return reply

    async def ask(self, name, **fields):
        kind = SERVICES[name]
        request = TYPES.encode(f"{kind}_Request", TYPES.make(f"{kind}_Request", **fields))
        reply = TYPES.decode(f"{kind}_Response", await self.post(name, request))
        await self.brain.settle()
        return reply

    async def send(self, number, **pose):
        goal = {"pose": ros_goal(**pose)}
        return (await self.ask("send_goal", goal_id=goal_id(number), goal=goal)).accepted

    async def status(self, number):
        return (await self.ask("get_result", goal_id=goal_id(number))).status

    async def cancel(self, number):
        info = {"goal_id": goal_id(number)}
        return (await self.ask("cancel_goal", goal_info=info)).return_code


@asynccontextmanager
async def adapter():
    brain, config = Brain(), Ros2Config(free_fleet=True)
    async with gateway_on(brain.net.network, brain.net.clock, config) as (bus, ros):
        await brain.located()
        yield Adapter(brain, bus, RosNode(ros, brain.net.clock))


async def test_a_goal_becomes_a_task_and_get_result_answers_at_once():
    async with adapter() as rmf:
        rmf.read("navigate_to_pose/_action/feedback")
        assert await rmf.send(1)
        assert rmf.brain.requests == [(2.0, 1.0, 0.0, "replace")]
        assert await rmf.status(1) == 2
        await rmf.brain.publish_task(
            "active", path=((0.0, 0.0), (2.0, 1.0)), distance_remaining=2.25, eta=9
        )
        (message,) = rmf.received["navigate_to_pose/_action/feedback"]
        assert message.goal_id.uuid.tolist() == [1] * 16
        feedback = message.feedback
        assert (feedback.distance_remaining, feedback.estimated_time_remaining.sec) == (2.25, 9)
        assert feedback.current_pose.header.frame_id == "map"
        assert await rmf.status(1) == 2
        await rmf.brain.publish_task("succeeded")
        assert await rmf.status(1) == 4


async def test_the_zero_id_cancels_all_goals_including_those_of_ros():
    async with adapter() as rmf:
        await rmf.send(1)
        assert await rmf.cancel(EVERY_GOAL) == 0
        assert rmf.brain.requests[1:] == [("cancel", "goal-1")]
        assert await rmf.status(1) == 5
        ros = Client(rmf.brain, rmf.node)
        await ros.send(2)
        assert await rmf.cancel(EVERY_GOAL) == 0
        assert await ros.result(2) == (5, 0)


async def test_failed_and_unknown_goals_have_their_own_states():
    async with adapter() as rmf:
        await rmf.send(1)
        await rmf.brain.publish_task("failed", reason="gave up")
        assert await rmf.status(1) == 6
        assert await rmf.status(9) == 0
        await rmf.send(2, frame="somewhere")
        assert await rmf.status(2) == 6


async def test_goals_of_ros_and_of_open_rmf_preempt_each_other():
    async with adapter() as rmf:
        ros = Client(rmf.brain, rmf.node)
        await ros.send(1)
        await rmf.send(2, x=1.5)
        assert await ros.result(1) == (6, 0)
        await ros.send(3)
        assert await rmf.status(2) == 6
        await rmf.brain.publish_task("succeeded", "goal-3")
        assert await ros.result(3) == (4, 0)
        assert rmf.brain.requests == [
            (2.0, 1.0, 0.0, "replace"), (1.5, 1.0, 0.0, "replace"), (2.0, 1.0, 0.0, "replace"),
        ]  # fmt: skip


async def test_goal_states_are_published_on_change():
    async with adapter() as rmf:
        rmf.read("navigate_to_pose/_action/status")
        await rmf.send(1)
        await until(lambda: published_states(rmf) == [[2]], "it is carried out")
        await rmf.brain.publish_task("succeeded")
        await until(lambda: published_states(rmf) == [[2], [4]], "its end")


def published_states(rmf):
    """Return the states of all goals in each message on the status topic."""
    messages = rmf.received["navigate_to_pose/_action/status"]
    return [[one.status for one in message.status_list] for message in messages]


async def publish_states(rmf, count, **about):
    for _ in range(count):
        rmf.brain.tick += 1
        rmf.brain.bus.time.tick = rmf.brain.tick
        rmf.brain.bus.publish(STATE, samples.state(rmf.brain.tick, **about))
        await rmf.brain.net.clock.advance(20_000_000)


async def test_transforms_lead_from_the_map_to_the_footprint():
    async with adapter() as rmf:
        await rmf.brain.located(x=2.0, y=1.0)
        rmf.read("tf")
        await publish_states(rmf, 3, pose=(0.5, 0.0, 0.25))
        assert len(rmf.received["tf"]) == 3
        frames = {one.child_frame_id: one for one in rmf.received["tf"][-1].transforms}
        assert frames["odom"].header.frame_id == "map"
        assert frames["base_footprint"].header.frame_id == "odom"
        shift = frames["odom"].transform.translation
        moved = frames["base_footprint"].transform
        assert (shift.x, shift.y) == pytest.approx((2.0, 1.0))
        assert moved.translation.x == pytest.approx(0.5)
        assert 2 * math.asin(moved.rotation.z) == pytest.approx(0.25)


async def test_a_battery_is_published_once_a_second_as_0_to_1():
    async with adapter() as rmf:
        rmf.read("battery_state")
        await publish_states(rmf, 100, battery=62.5)
        found = [one.percentage for one in rmf.received["battery_state"]]
        assert found == [0.625, 0.625]
        rmf.brain.bus.publish(STATE, replace(samples.state(rmf.brain.tick + 1), battery=None))
        await rmf.brain.net.clock.advance(10**9)
        assert len(rmf.received["battery_state"]) == 2


async def test_topics_without_subscribers_are_not_encoded():
    async with adapter() as rmf:
        encoded = rmf.gateway_bus.counters
        await publish_states(rmf, 10)
        assert encoded["published"] == 0
        end = rmf.read("tf")
        await publish_states(rmf, 10)
        assert encoded["published"] == 10
        end()
        await publish_states(rmf, 10)
        assert encoded["published"] == 10
        keys = {key for key, _ in rmf.brain.net.network.sent if "robot/" not in key}
        assert keys == {"tf", "navigate_to_pose/_action/status"}


@pytest.mark.parametrize("name", SERVICES)
@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "not CDR: 0 bytes"),
        (b"\x00\x01\x00\x00\x01", "Request: "),
        (b"\x00\x01\x00\x00" + bytes(MAX_COMMAND), "expected at most 65536"),
    ],
)
async def test_a_bad_request_is_refused_counted_and_logged_once(name, payload, reason, caplog):
    async with adapter() as rmf:
        for _ in range(3):
            assert reason in await rmf.post(name, payload)
        await rmf.brain.net.clock.advance(10**9)
        assert rmf.gateway_bus.counters["free_fleet_refused"] == 3
        logged = [one for one in caplog.messages if "refused a request of" in one]
        assert len(logged) == 1
        assert f"navigate_to_pose/_action/{name}" in logged[0]
        assert rmf.brain.requests == []
        assert await rmf.send(1)


@pytest.mark.parametrize("seed", range(3))
async def test_mutated_requests_neither_crash_the_gateway_nor_move_the_robot(seed):
    dice = random.Random(seed)
    async with adapter() as rmf:
        rmf.brain.bus.publish(BODY, samples.body())
        for name, kind in SERVICES.items():
            payload = TYPES.encode(f"{kind}_Request", TYPES.make(f"{kind}_Request"))
            for _ in range(200):
                await rmf.post(name, mutated(dice, payload))
                await rmf.brain.settle()
        assert rmf.gateway_bus.sent[CMD_VEL.key] == 0
        await rmf.cancel(EVERY_GOAL)
        assert await rmf.send(77)
        assert await rmf.status(77) == 2


async def test_without_its_setting_free_fleet_is_not_served():
    brain = Brain()
    async with gateway_on(brain.net.network, brain.net.clock):
        await brain.located()
        key = "navigate_to_pose/_action/send_goal"
        assert await brain.net.network.transport().query(key, b"", "", 1.0, "data") == []
