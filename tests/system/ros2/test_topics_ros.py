"""Our topics over DDS, with real ROS 2 on the other side."""

import contextlib
import json
from collections.abc import AsyncIterator
from typing import Any

import numpy as np
import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.ros2.dds import DdsTransport
from gigabrain_zenoh.ros2.qos import DEFAULT, LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import GraphEndpoint, Received
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.processes import repeat
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import Judge

SCAN, TWIST = "sensor_msgs/msg/LaserScan", "geometry_msgs/msg/Twist"
MAP, STRING = "nav_msgs/msg/OccupancyGrid", "std_msgs/msg/String"
SCAN_VALUES: dict[str, Any] = {
    "header": {"frame_id": "base_scan", "stamp": {"sec": 12, "nanosec": 34}},
    "angle_increment": 0.015625,
    "range_max": 3.5,
    "ranges": [0.5, 1.25, "Infinity", "NaN"],
}


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


class Node:
    """Opens our transports in the judge's domain."""

    def __init__(self, judge: Judge, types: Types) -> None:
        self.judge, self.types = judge, types
        self.stack = contextlib.AsyncExitStack()

    def opened(self, name: str = "gigabrain", namespace: str = "/") -> DdsTransport:
        link = Ros2Link(
            node=name,
            namespace=namespace,
            transport="dds",
            domain=self.judge.domain,
            localhost=True,
        )
        return DdsTransport(link, self.types)

    async def open(self, name: str = "gigabrain", namespace: str = "/") -> DdsTransport:
        return await self.stack.enter_async_context(self.opened(name, namespace))

    def payload(self, kind: str, **values: Any) -> bytes:
        return self.types.encode(kind, self.types.from_dict(kind, values))


@pytest.fixture
async def node(judge: Judge, types: Types) -> AsyncIterator[Node]:
    made = Node(judge, types)
    async with made.stack:
        yield made


async def test_ros_receives_our_values_and_sees_type_hash_and_qos(judge: Judge, node: Node) -> None:
    ours = await node.open("robot", "/red")
    publisher = ours.publisher("scan", SCAN, SENSOR_DATA)
    listen = judge.start("listen", node="ears")
    await listen.query("subscribe", topic="/red/scan", type=SCAN, qos={"reliable": False})
    await until(lambda: publisher.readers == 1, "ROS's reader")
    await repeat(
        lambda: publisher.publish(node.payload(SCAN, **SCAN_VALUES)),
        lambda: listen.ask("report", topic="/red/scan")["count"],
    )
    report = await listen.query("report", topic="/red/scan")
    scan = report["values"][0]
    assert scan["header"] == SCAN_VALUES["header"]
    assert (scan["angle_increment"], scan["range_max"]) == (0.015625, 3.5)
    assert json.dumps(scan["ranges"]) == "[0.5, 1.25, Infinity, NaN]"
    assert 0 < report["sent_ns"][0] <= report["now_ns"]
    (seen,) = (await listen.endpoints("/red/scan"))["publishers"]
    assert (seen["node"], seen["namespace"]) == ("robot", "/red")
    assert (seen["type"], seen["hash"]) == (SCAN, node.types.hash(SCAN))
    assert (seen["reliable"], seen["transient_local"]) == (False, False)


async def test_our_node_receives_messages_of_ros(judge: Judge, node: Node) -> None:
    ours = await node.open()
    got: list[Received] = []
    ours.subscribe("/cmd_vel", TWIST, DEFAULT, got.append)
    drive = judge.start("drive", node="hands")
    drive.ask("drive", linear=0.25, angular=-0.5, hz=50)
    await until(lambda: len(got) >= 20, "commands")
    twist = node.types.decode(TWIST, got[-1].payload)
    assert (twist.linear.x, twist.angular.z) == (0.25, -0.5)
    times = [each.source_ns for each in got if each.source_ns]
    assert times == sorted(times)
    assert len(set(times)) == len(got)

    def theirs() -> list[GraphEndpoint]:
        return [each for each in ours.endpoints() if each.topic == "/cmd_vel" and not each.ours]

    await until(lambda: [each.node for each in theirs()] == ["/hands"], "the publisher's node")
    (endpoint,) = theirs()
    assert (endpoint.kind, endpoint.type) == ("publisher", TWIST)
    assert endpoint.hash == node.types.hash(TWIST)
    assert endpoint.qos.reliable
    seen = await drive.endpoints("/cmd_vel")
    assert {each["gid"] for each in seen["publishers"]} == {each.gid.hex() for each in got}


async def test_a_late_ros_node_receives_a_whole_map(judge: Judge, node: Node) -> None:
    ours = await node.open()
    cells = np.random.default_rng(1).integers(-1, 101, 200_000).astype(np.int8)
    message = node.types.make(MAP, info={"width": 500, "height": 400}, data=cells)
    ours.publisher("/map", MAP, LATCHED).publish(node.types.encode(MAP, message))
    listen = judge.start("listen")
    listen.ask("subscribe", topic="/map", type=MAP, qos={"transient_local": True, "depth": 1})
    await until(lambda: listen.ask("report", topic="/map")["count"], "the map")
    (grid,) = listen.ask("report", topic="/map")["values"]
    assert grid["info"]["width"] == 500
    assert np.array_equal(grid["data"], cells)


async def test_our_late_node_receives_latched_messages_of_ros(judge: Judge, node: Node) -> None:
    drive = judge.start("drive")
    latched = {"reliable": True, "transient_local": True, "depth": 1}
    drive.ask("publish", topic="/told", type=STRING, value={"data": "grüß"}, **latched)
    got: list[Received] = []
    (await node.open()).subscribe("/told", STRING, LATCHED, got.append)
    await until(lambda: got, "the latched text")
    assert node.types.decode(STRING, got[0].payload).data == "grüß"


async def test_a_killed_and_restarted_ros_node_is_found_again(judge: Judge, node: Node) -> None:
    ours = await node.open()
    got: list[Received] = []
    ours.subscribe("/cmd_vel", TWIST, DEFAULT, got.append)
    for linear in (0.1, 0.2):
        drive = judge.start("drive", node="hands")
        drive.ask("drive", linear=linear, hz=50)
        await until(lambda speed=linear: got and _speed(node, got[-1]) == speed, "commands")
        drive.kill()


async def test_our_restarted_node_is_found_again(judge: Judge, node: Node) -> None:
    listen = judge.start("listen")
    listen.ask("subscribe", topic="/scan", type=SCAN, qos={"reliable": False})
    scan = node.payload(SCAN, **SCAN_VALUES)
    for _ in range(2):
        before = listen.ask("report", topic="/scan")["count"]
        async with node.opened() as ours:
            publisher = ours.publisher("/scan", SCAN, SENSOR_DATA)
            await until(lambda to=publisher: to.readers == 1, "ROS's reader")
            await repeat(  # ROS may discover it a moment later
                lambda to=publisher: to.publish(scan),
                lambda n=before: listen.ask("report", topic="/scan")["count"] > n,
            )


async def test_ros_lists_nodes_and_topics_of_two_robots(judge: Judge, node: Node) -> None:
    for robot in ("/red", "/blue"):
        (await node.open("brain", robot)).publisher("scan", SCAN, SENSOR_DATA)
    graph = judge.start("graph")
    wanted = {"/red/brain", "/blue/brain"}
    await until(lambda: wanted <= set(graph.ask("graph")["nodes"]), "both nodes")
    await until(
        lambda: {"/red/scan", "/blue/scan"} <= graph.ask("graph")["topics"].keys(), "both topics"
    )
    assert graph.ask("graph")["topics"]["/red/scan"] == [SCAN]


async def test_a_best_effort_reader_of_ros_matches_our_reliable_topic(
    judge: Judge, node: Node
) -> None:
    ours = await node.open()
    best_effort = ours.publisher("/a", STRING, Qos(reliable=False))
    reliable = ours.publisher("/b", STRING, DEFAULT)
    listen = judge.start("listen")
    listen.ask("subscribe", topic="/a", type=STRING, qos={"reliable": True})
    listen.ask("subscribe", topic="/b", type=STRING, qos={"reliable": False})
    await until(lambda: reliable.readers == 1, "the reader of /b")
    await until(lambda: len(listen.ask("endpoints", topic="/a")["publishers"]) == 1, "/a is seen")
    assert best_effort.readers == 0


def _speed(node: Node, received: Received) -> float:
    return float(node.types.decode(TWIST, received.payload).linear.x)
