"""Tests of both transports, with our nodes on both sides."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import pytest

from gigabrain_zenoh.errors import ConfigError, NoAnswer
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.testing.processes import repeat
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.nodes import STRING, TRIGGER, Nodes, dds_nodes, zenoh_nodes


@pytest.fixture(params=[zenoh_nodes, dds_nodes], ids=["rmw_zenoh", "dds"])
async def nodes(request: pytest.FixtureRequest) -> AsyncIterator[Nodes]:
    async with request.param() as made:
        yield made


async def test_a_message_arrives_with_its_time_and_sender(nodes: Nodes) -> None:
    talker, listener = await nodes.node("talker"), await nodes.node("listener")
    delivered: list[Received] = []
    listener.subscribe("/chatter", STRING, Qos(), delivered.append)
    publisher = talker.publisher("/chatter", STRING)
    await until(lambda: publisher.readers == 1, "the reader")
    await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: len(delivered) > 1)
    assert {nodes.text(each.payload) for each in delivered} == {"hi"}
    times = [each.source_ns or 0 for each in delivered]
    assert times == sorted(times)
    assert times[0] > 0
    assert len({each.gid for each in delivered}) == 1
    assert len(delivered[0].gid) == 16


async def test_a_publisher_counts_its_readers(nodes: Nodes) -> None:
    told: list[int] = []
    talker = await nodes.node("talker")
    publisher = talker.publisher("/chatter", STRING, on_readers=told.append)
    async with nodes.opened("listener") as listener:
        closes = [
            listener.subscribe("/chatter", STRING, SENSOR_DATA, lambda _: None) for _ in range(2)
        ]
        await until(lambda: publisher.readers == 2, "two readers")
        closes[0]()
        closes[0]()
        await until(lambda: publisher.readers == 1, "one reader")
    await until(lambda: publisher.readers == 0, "no reader")
    assert told[-1] == 0


async def test_a_node_does_not_receive_its_own_messages(nodes: Nodes) -> None:
    node, other = await nodes.node("talker"), await nodes.node("listener")
    own: list[Received] = []
    delivered: list[Received] = []
    node.subscribe("/chatter", STRING, Qos(), own.append)
    publisher = node.publisher("/chatter", STRING)
    other.subscribe("/chatter", STRING, Qos(), delivered.append)
    await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: delivered)
    assert own == []
    assert publisher.readers == 1


@pytest.mark.parametrize("first", ["publisher", "subscriber"])
async def test_a_latched_message_reaches_late_joiners_in_either_order(
    nodes: Nodes, first: str
) -> None:
    delivered: list[Received] = []
    if first == "subscriber":
        (await nodes.node("listener")).subscribe("/map", STRING, LATCHED, delivered.append)
    publisher = (await nodes.node("talker")).publisher("/map", STRING, LATCHED)
    publisher.publish(nodes.string("old"))
    publisher.publish(nodes.string("map"))
    if first == "publisher":
        (await nodes.node("listener")).subscribe("/map", STRING, LATCHED, delivered.append)
    await until(lambda: delivered and nodes.text(delivered[-1].payload) == "map", "the map")


async def test_a_message_of_a_megabyte_arrives_whole(nodes: Nodes) -> None:
    image = "sensor_msgs/msg/Image"
    types = nodes.types
    payload = types.encode(image, types.make(image, data=bytes(range(256)) * 4096))
    delivered: list[Received] = []
    (await nodes.node("listener")).subscribe("/image", image, SENSOR_DATA, delivered.append)
    publisher = (await nodes.node("talker")).publisher("/image", image, SENSOR_DATA)
    await repeat(lambda: publisher.publish(payload), lambda: delivered)
    assert delivered[0].payload == payload


async def test_the_graph_names_nodes_topics_types_and_qos(nodes: Nodes) -> None:
    rviz = await nodes.node("rviz")
    for name in ("robot1", "robot2"):
        node = await nodes.node("gigabrain", namespace=f"/{name}")
        node.publisher("scan", STRING, SENSOR_DATA)

    def scans() -> list[Any]:
        return [each for each in rviz.endpoints() if each.node]

    await until(lambda: len(scans()) == 2, "both scans")
    assert set(rviz.nodes()) == {"/rviz", "/robot1/gigabrain", "/robot2/gigabrain"}
    assert {(each.node, each.topic, each.type, each.hash) for each in scans()} == {
        (f"/{name}/gigabrain", f"/{name}/scan", STRING, nodes.types.hash(STRING))
        for name in ("robot1", "robot2")
    }
    assert {(each.kind, each.qos.reliable, each.ours) for each in scans()} == {
        ("publisher", False, False)
    }


async def test_a_closed_node_is_forgotten(nodes: Nodes) -> None:
    rviz = await nodes.node("rviz")
    async with nodes.opened("talker") as talker:
        talker.publisher("/chatter", STRING)
        await until(lambda: any(each.node == "/talker" for each in rviz.endpoints()), "the talker")
    await until(lambda: rviz.nodes() == ("/rviz",) and not rviz.endpoints(), "its end")


async def test_a_service_answers_and_is_in_the_graph(nodes: Nodes) -> None:
    server, client = await nodes.node("server"), await nodes.node("client")
    types = nodes.types

    async def answer(request: bytes) -> bytes:
        response = types.make(f"{TRIGGER}_Response", success=True, message="stopped")
        return types.encode(f"{TRIGGER}_Response", response)

    server.serve("estop", TRIGGER, answer)
    request = types.encode(f"{TRIGGER}_Request", types.make(f"{TRIGGER}_Request"))
    response = await client.call("/estop", TRIGGER, request, 20)
    assert types.decode(f"{TRIGGER}_Response", response).message == "stopped"
    with pytest.raises(NoAnswer):
        await client.call("/release", TRIGGER, request, 0.3)

    def kinds() -> set[tuple[str, str, str]]:
        return {
            (each.kind, each.node, each.type)
            for each in client.endpoints()
            if each.topic == "/estop"
        }

    await until(
        lambda: kinds() == {("server", "/server", TRIGGER), ("client", "/client", TRIGGER)},
        "both sides",
    )


async def test_an_unknown_type_and_an_invalid_name_are_rejected(nodes: Nodes) -> None:
    node = await nodes.node()
    with pytest.raises(ConfigError, match="Strin"):
        node.publisher("/chatter", "std_msgs/msg/Strin")
    with pytest.raises(ConfigError, match="ROS name"):
        node.subscribe("a b", STRING, Qos(), lambda _: None)


async def test_no_callback_is_called_after_closing(nodes: Nodes) -> None:
    delivered: list[Received] = []
    talker = await nodes.node("talker")
    async with nodes.opened("listener") as listener:
        listener.subscribe("/chatter", STRING, Qos(), delivered.append)
        publisher = talker.publisher("/chatter", STRING)
        await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: delivered)
    received = len(delivered)
    for _ in range(10):
        publisher.publish(nodes.string("hi"))
        await asyncio.sleep(0.01)
    assert len(delivered) == received


async def test_publishers_may_be_closed_after_their_node(nodes: Nodes) -> None:
    async with nodes.opened("talker") as talker:
        publisher = talker.publisher("/chatter", STRING)
        close = talker.subscribe("/cmd_vel", STRING, Qos(), lambda _: None)
    publisher.close()
    close()
    publisher.publish(nodes.string("hi"))
    assert talker.counts["not sent"] == 0
