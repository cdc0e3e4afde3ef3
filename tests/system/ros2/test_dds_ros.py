"""The graph, services and actions over DDS, with real ROS 2 on the other side."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.actions import ActionServer, Goal, GoalState, Outcome
from gigabrain_zenoh.ros2.dds import DdsTransport
from gigabrain_zenoh.ros2.qos import SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge

TWIST = "geometry_msgs/msg/Twist"
SCAN = "sensor_msgs/msg/LaserScan"
TRIGGER = "std_srvs/srv/Trigger"
NAVIGATE = "nav2_msgs/action/NavigateToPose"


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


@pytest.fixture
async def node(judge: Judge, types: Types) -> AsyncIterator[DdsTransport]:
    link = Ros2Link(
        transport="dds", domain=judge.domain, localhost=True, namespace="/robot1", node="brain"
    )
    async with DdsTransport(link, types) as made:
        yield made


async def test_rclpy_finds_our_node_and_its_endpoints(
    judge: Judge, node: DdsTransport, types: Types
) -> None:
    node.publisher("scan", SCAN, SENSOR_DATA)
    node.subscribe("cmd_vel", TWIST, Qos(), lambda _: None)

    async def answer(request: bytes) -> bytes:
        return request

    close = node.serve("estop", TRIGGER, answer)
    viewer = judge.start("graph", node="viewer")
    while "/robot1/brain" not in (found := await viewer.query("graph"))["nodes"]:
        pass
    while "/robot1/estop" not in (found := await viewer.query("graph"))["services"]:
        pass
    assert found["services"]["/robot1/estop"] == [TRIGGER]
    assert found["topics"]["/robot1/scan"] == [SCAN]
    (scan,) = (await viewer.query("endpoints", topic="/robot1/scan"))["publishers"]
    assert (scan["node"], scan["namespace"], scan["type"]) == ("brain", "/robot1", SCAN)
    assert (scan["reliable"], scan["transient_local"]) == (False, False)
    assert scan["hash"] == types.hash(SCAN)
    (command,) = (await viewer.query("endpoints", topic="/robot1/cmd_vel"))["subscribers"]
    assert (command["node"], command["reliable"]) == ("brain", True)
    close()
    while "/robot1/estop" in (await viewer.query("graph"))["services"]:
        pass


async def test_our_node_finds_the_nodes_and_endpoints_of_rclpy(
    judge: Judge, node: DdsTransport
) -> None:
    serve = judge.start("serve", node="server", namespace="/other")
    await serve.query("service", service="/release", type=TRIGGER)
    drive = judge.start("drive", node="hands")
    await drive.query("drive", linear=0.1, hz=10)
    await until(lambda: {"/other/server", "/hands"} <= set(node.nodes()), "their nodes")

    def found() -> set[tuple[str, str, str, str]]:
        return {(each.node, each.kind, each.topic, each.type) for each in node.endpoints()}

    wanted = {
        ("/hands", "publisher", "/cmd_vel", TWIST),
        ("/other/server", "server", "/release", TRIGGER),
    }
    await until(lambda: wanted <= found(), "their endpoints")
    hashes = {each.hash for each in node.endpoints() if each.topic == "/cmd_vel"}
    assert hashes == {node.types.hash(TWIST)}


@pytest.mark.slow  # Fast DDS's lease is 20 s
async def test_a_killed_rclpy_node_is_forgotten_after_its_lease(
    judge: Judge, node: DdsTransport
) -> None:
    publisher = node.publisher("scan", SCAN, SENSOR_DATA)
    ears = judge.start("listen", node="ears")
    await ears.query("subscribe", topic="/robot1/scan", type=SCAN, qos={"reliable": False})
    await until(lambda: publisher.readers == 1 and "/ears" in node.nodes(), "the reader")
    ears.kill()
    await until(lambda: publisher.readers == 0 and "/ears" not in node.nodes(), "its end")


class Walk:
    """A handler whose goal runs until it is cancelled or preempted, or has sent all feedback."""

    def __init__(self) -> None:
        self.goals: list[Any] = []

    def accept(self, message: Any) -> bool:
        return bool(message.behavior_tree != "none")

    def cancel(self, goal: Goal) -> bool:
        return True

    async def run(self, goal: Goal, feedback: Callable[[Any], None]) -> Outcome:
        self.goals.append(goal.message)
        steps = 5 if goal.message.behavior_tree == "short" else 10_000
        for step in range(steps):
            if goal.cancel_requested:
                return Outcome(GoalState.CANCELED)
            if goal.preempted:
                return Outcome(GoalState.ABORTED)
            feedback({"distance_remaining": float(steps - step)})
            await asyncio.sleep(0.02)
        return Outcome(GoalState.SUCCEEDED, {"error_code": 0, "error_msg": "there"})


async def test_rclpys_goals_are_followed_preempted_and_cancelled(
    judge: Judge, node: DdsTransport, types: Types
) -> None:
    walk = Walk()
    server = ActionServer(node, types, "/navigate_to_pose", NAVIGATE, walk, preempts=True)
    client = judge.start("navigate", node="client")
    action = {"action": "/navigate_to_pose", "type": NAVIGATE}
    await client.available(**action)
    pose = {"header": {"frame_id": "map"}, "pose": {"position": {"x": 1.5}}}
    for name in ("first", "second"):
        await client.query("send", **action, name=name, goal={"pose": pose})
        await client.wait_async("accepted", name=name)
        received = await client.wait_async("feedback", name=name)
        assert received["value"]["distance_remaining"] > 0
    assert (await client.wait_async("result", name="first"))["status"] == "aborted"
    await client.query("cancel", name="second")
    assert (await client.wait_async("cancelled", name="second"))["goals"] == 1
    assert (await client.wait_async("result", name="second"))["status"] == "canceled"
    await client.query("send", **action, name="third", goal={"behavior_tree": "short"})
    third = await client.wait_async("result", name="third")
    assert (third["status"], third["value"]["error_msg"]) == ("succeeded", "there")
    await client.query("send", **action, name="fourth", goal={"behavior_tree": "none"})
    await client.wait_async("rejected", name="fourth")
    assert walk.goals[0].pose.pose.position.x == 1.5
    await server.close()


async def test_services_go_both_ways(judge: Judge, node: DdsTransport, types: Types) -> None:
    async def answer(request: bytes) -> bytes:
        response = types.make(f"{TRIGGER}_Response", success=True, message="stopped")
        return types.encode(f"{TRIGGER}_Response", response)

    node.serve("estop", TRIGGER, answer)
    caller = judge.start("call", node="caller")
    service = {"service": "/robot1/estop", "type": TRIGGER}
    await caller.available(**service)
    await caller.query("call", **service)
    assert (await caller.wait_async("response"))["value"] == {"success": True, "message": "stopped"}
    serve = judge.start("serve", node="server")
    await serve.query("service", service="/release", type=TRIGGER, success=True, message="free")
    request = types.encode(f"{TRIGGER}_Request", types.make(f"{TRIGGER}_Request"))
    response = await node.call("/release", TRIGGER, request, 60)
    assert types.decode(f"{TRIGGER}_Response", response).message == "free"
