"""The network in memory matches endpoints and delivers messages as DDS does."""

import pytest

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import ConfigError, NoAnswer, Refused
from gigabrain_zenoh.ros2.memory import MemoryNetwork
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.ros2.types import Types

STRING = "std_msgs/msg/String"


@pytest.fixture(scope="session")
def types() -> Types:
    return Types()


@pytest.fixture
def network(types: Types) -> MemoryNetwork:
    return MemoryNetwork(types, lambda: 5)


@pytest.mark.long
def test_a_message_reaches_readers_of_other_nodes_only(
    network: MemoryNetwork, types: Types
) -> None:
    ours, theirs = network.transport(), network.transport(Ros2Link(node="rviz"))
    received: list[Received] = []
    own: list[Received] = []
    theirs.subscribe("/chat", STRING, Qos(), received.append)
    ours.subscribe("/chat", STRING, Qos(), own.append)
    ours.publisher("chat", STRING).publish(types.encode(STRING, types.make(STRING, data="hi")))
    assert [types.decode(STRING, each.payload).data for each in received] == ["hi"]
    assert received[0].source_ns == 5
    assert own == []


def test_each_change_of_the_number_of_readers_is_reported(network: MemoryNetwork) -> None:
    counts: list[int] = []
    publisher = network.transport().publisher("/chat", STRING, on_readers=counts.append)
    reader = network.transport(Ros2Link(node="rviz"))
    close = reader.subscribe("/chat", STRING, Qos(), lambda _: None)
    assert publisher.readers == 1
    close()
    close()
    assert (publisher.readers, counts) == (0, [1, 0])


def test_a_reliable_reader_does_not_match_a_best_effort_publisher(network: MemoryNetwork) -> None:
    publisher = network.transport().publisher("/scan", STRING, SENSOR_DATA)
    network.transport(Ros2Link(node="rviz")).subscribe("/scan", STRING, Qos(), lambda _: None)
    assert publisher.readers == 0


def test_a_late_reader_receives_the_last_message_of_a_latched_topic(network: MemoryNetwork) -> None:
    publisher = network.transport().publisher("/map", STRING, LATCHED)
    publisher.publish(b"1")
    publisher.publish(b"2")
    late, volatile = [], []
    reader = network.transport(Ros2Link(node="rviz"))
    reader.subscribe("/map", STRING, LATCHED, late.append)
    reader.subscribe("/map", STRING, Qos(), volatile.append)
    assert ([each.payload for each in late], volatile) == ([b"2"], [])


async def test_a_call_returns_the_response_of_its_service(network: MemoryNetwork) -> None:
    async def answer(request: bytes) -> bytes:
        if request == b"no":
            raise Refused("no")
        return request * 2

    trigger = "std_srvs/srv/Trigger"
    client = network.transport(Ros2Link(node="client"))
    async with network.transport(Ros2Link(namespace="/robot1")) as server:
        server.serve("estop", trigger, answer)
        assert await client.call("/robot1/estop", trigger, b"ab", 1) == b"abab"
        with pytest.raises(NoAnswer):
            await client.call("/robot1/estop", trigger, b"no", 1)
    with pytest.raises(NoAnswer):
        await client.call("/robot1/estop", trigger, b"ab", 1)


def test_the_graph_names_nodes_and_endpoints(network: MemoryNetwork) -> None:
    node = network.transport(Ros2Link(namespace="/robot1"))
    node.publisher("scan", STRING, SENSOR_DATA)
    (endpoint,) = network.transport(Ros2Link(node="rviz")).endpoints()
    assert (endpoint.node, endpoint.topic) == ("/robot1/gigabrain", "/robot1/scan")
    assert (endpoint.kind, endpoint.qos, endpoint.ours) == ("publisher", SENSOR_DATA, False)
    assert endpoint.hash.startswith("RIHS01_df668c74")


@pytest.mark.parametrize("topic", ["", "/", "a b", "a//b", "1a", "/a/"])
def test_a_topic_with_an_invalid_name_is_rejected(network: MemoryNetwork, topic: str) -> None:
    with pytest.raises(ConfigError):
        network.transport().publisher(topic, STRING)
