"""Nodes over `rmw_zenoh`: two sessions of ours, and bare Zenoh sessions in place of others."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
import zenoh

from gigabrain_zenoh.config.settings import Ros2Link
from gigabrain_zenoh.errors import ConfigError, NoAnswer, Refused
from gigabrain_zenoh.ros2.actions import ActionServer, Goal, GoalState, Outcome
from gigabrain_zenoh.ros2.qos import LATCHED, SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.rmw_names import NodeName, parse_attachment
from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.testing.processes import ZenohNetwork, repeat, robot
from gigabrain_zenoh.testing.waiting import until

STRING = "std_msgs/msg/String"
TRIGGER = "std_srvs/srv/Trigger"
NAVIGATE = "nav2_msgs/action/NavigateToPose"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
KEY = f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"


class Nodes:
    """Makes nodes on one router."""

    def __init__(self, net: ZenohNetwork, types: Types) -> None:
        self.net, self.types = net, types
        self.stack = contextlib.AsyncExitStack()

    async def node(self, name: str = "gigabrain", **fields: Any) -> RmwZenohTransport:
        link = Ros2Link(node=name, router=self.net.endpoint, **fields)
        return await self.stack.enter_async_context(RmwZenohTransport(link, self.types))

    def string(self, data: str) -> bytes:
        return self.types.encode(STRING, self.types.make(STRING, data=data))

    def text(self, payload: bytes) -> str:
        return str(self.types.decode(STRING, payload).data)


@pytest.fixture(scope="module")
def types() -> Types:
    return Types()


@pytest.fixture
async def nodes(types: Types) -> AsyncIterator[Nodes]:
    async with robot() as net:
        await net.router()
        made = Nodes(net, types)
        async with made.stack:
            yield made


async def test_a_message_arrives_with_its_time_and_sender(nodes: Nodes) -> None:
    talker, listener = await nodes.node("talker"), await nodes.node("listener")
    got: list[Received] = []
    listener.subscribe("/chatter", STRING, Qos(), got.append)
    publisher = talker.publisher("/chatter", STRING)
    await until(lambda: publisher.readers == 1, "the reader")
    await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: len(got) > 1)
    assert {nodes.text(each.payload) for each in got} == {"hi"}
    assert got[0].source_ns is not None
    assert got[1].source_ns is not None
    assert 0 < got[0].source_ns < got[1].source_ns
    assert (got[0].gid, len(got[0].gid)) == (publisher.entity.gid, 16)


async def test_the_wire_is_that_of_rmw_zenoh(nodes: Nodes) -> None:
    samples: list[zenoh.Sample] = []
    session = nodes.net.raw()
    session.declare_subscriber("0/**", samples.append)
    publisher = (await nodes.node("talker")).publisher("/chatter", STRING, Qos(depth=7))
    await until(lambda: publisher.readers == 1, "a reader without a token")
    await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: samples)
    assert str(samples[0].key_expr) == KEY
    assert samples[0].payload.to_bytes() == bytes.fromhex("0001000003000000686900")
    assert samples[0].attachment is not None
    attachment = parse_attachment(samples[0].attachment.to_bytes())
    assert attachment.sequence >= 1
    assert attachment.gid == publisher.entity.gid
    tokens = {
        str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/**") if reply.ok
    }
    (zid,) = {token.split("/")[2] for token in tokens}
    node = NodeName(0, zid, "/", "talker")
    made = node.endpoint_token(1, "publisher", "/chatter", STRING, HASH, Qos(depth=7))
    assert tokens == {node.token, made}


async def test_without_a_reader_there_is_none_from_the_start(nodes: Nodes) -> None:
    told: list[int] = []
    talker = await nodes.node("talker")
    publisher = talker.publisher("/chatter", STRING, on_readers=told.append)
    latched = talker.publisher("/map", STRING, Qos(transient_local=True), told.append)
    await until(lambda: len(talker.endpoints()) == 2, "our own tokens")
    assert (publisher.readers, latched.readers, told) == (0, 0, [])


async def test_a_reader_is_told_as_it_comes_and_goes(nodes: Nodes) -> None:
    told: list[int] = []
    talker = await nodes.node("talker")
    publisher = talker.publisher("/chatter", STRING, on_readers=told.append)
    async with RmwZenohTransport(
        Ros2Link(node="listener", router=nodes.net.endpoint), nodes.types
    ) as listener:
        closes = [
            listener.subscribe("/chatter", STRING, SENSOR_DATA, lambda _: None) for _ in range(2)
        ]
        await until(lambda: publisher.readers == 2, "two readers")
        closes[0]()
        await until(lambda: publisher.readers == 1, "one reader")
    await until(lambda: publisher.readers == 0, "no reader")
    assert told[-1] == 0


async def test_a_node_does_not_hear_itself(nodes: Nodes) -> None:
    node, other = await nodes.node("talker"), await nodes.node("listener")
    own: list[Received] = []
    got: list[Received] = []
    node.subscribe("/chatter", STRING, Qos(), own.append)
    publisher = node.publisher("/chatter", STRING)
    await until(lambda: node.endpoints(), "our own tokens")
    assert publisher.readers == 0
    other.subscribe("/chatter", STRING, Qos(), got.append)
    await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: got)
    assert own == []
    assert publisher.readers == 1


@pytest.mark.parametrize("first", ["publisher", "subscriber"])
async def test_a_latched_message_reaches_late_joiners_in_either_order(
    nodes: Nodes, first: str
) -> None:
    got: list[Received] = []
    if first == "subscriber":
        listener = await nodes.node("listener")
        listener.subscribe("/map", STRING, LATCHED, got.append)
        await until(lambda: listener.endpoints(), "the subscriber's token")
    talker = await nodes.node("talker")
    publisher = talker.publisher("/map", STRING, LATCHED)
    publisher.publish(nodes.string("old"))
    publisher.publish(nodes.string("map"))
    if first == "publisher":
        (await nodes.node("listener")).subscribe("/map", STRING, LATCHED, got.append)
    await until(lambda: got and nodes.text(got[-1].payload) == "map", "the map")


async def test_a_volatile_reader_gets_what_a_latched_topic_sends_from_now_on(nodes: Nodes) -> None:
    publisher = (await nodes.node("talker")).publisher("/map", STRING, LATCHED)
    publisher.publish(nodes.string("old"))
    got: list[Received] = []
    (await nodes.node("listener")).subscribe("/map", STRING, Qos(), got.append)
    await repeat(lambda: publisher.publish(nodes.string("map")), lambda: got)
    assert {nodes.text(each.payload) for each in got} == {"map"}


async def test_a_service_answers_and_correlates(nodes: Nodes) -> None:
    server, client = await nodes.node("server"), await nodes.node("client")

    async def answer(request: bytes) -> bytes:
        if request == b"no":
            raise Refused("not now")
        return request[::-1]

    server.serve("/estop", TRIGGER, answer)
    assert await client.call("/estop", TRIGGER, b"abc", 10) == b"cba"
    answers = await asyncio.gather(
        *(client.call("/estop", TRIGGER, b"%d" % n, 10) for n in range(10, 30))
    )
    assert answers == [(b"%d" % n)[::-1] for n in range(10, 30)]
    with pytest.raises(NoAnswer):
        await client.call("/estop", TRIGGER, b"no", 1)


async def test_a_client_waits_for_its_server(nodes: Nodes) -> None:
    client = await nodes.node("client")
    with pytest.raises(NoAnswer, match="/estop"):
        await client.call("estop", TRIGGER, b"a", 0.3)
    asking = asyncio.create_task(client.call("/estop", TRIGGER, b"a", 20))
    await asyncio.sleep(0.2)

    async def answer(request: bytes) -> bytes:
        return request

    (await nodes.node("server")).serve("/estop", TRIGGER, answer)
    assert await asking == b"a"


async def test_a_reply_carries_the_attachment_of_its_request(nodes: Nodes) -> None:
    async def answer(request: bytes) -> bytes:
        return request

    server = await nodes.node("server")
    server.serve("/estop", TRIGGER, answer)
    session = nodes.net.raw()
    key = f"0/estop/std_srvs::srv::dds_::Trigger_/{nodes.types.hash(TRIGGER)}"
    request = (7).to_bytes(8, "little") + bytes(8) + b"\x10" + bytes(range(16))
    replies: list[zenoh.Sample] = []

    def ask() -> None:
        for reply in session.get(
            key, payload=b"x", attachment=request, target=zenoh.QueryTarget.ALL_COMPLETE
        ):
            if reply.ok:
                replies.append(reply.ok)

    while not replies:
        await asyncio.to_thread(ask)
    assert replies[0].attachment is not None
    attachment = parse_attachment(replies[0].attachment.to_bytes())
    assert (attachment.sequence, attachment.gid) == (7, bytes(range(16)))
    assert attachment.source_ns > 0


async def test_messages_without_a_good_attachment_are_counted_and_delivered(nodes: Nodes) -> None:
    listener = await nodes.node("listener")
    got: list[Received] = []
    listener.subscribe("/chatter", STRING, Qos(), got.append)
    session, counts = nodes.net.raw(), listener.counts
    await repeat(lambda: session.put(KEY, b"a"), lambda: counts["missing attachment"])
    await repeat(
        lambda: session.put(KEY, b"b", attachment=bytes(40)),
        lambda: counts["malformed attachment"],
    )
    assert (got[-1].payload, got[-1].source_ns, got[-1].gid) == (b"b", None, b"")


async def test_the_graph_names_both_robots_of_two_namespaces(nodes: Nodes) -> None:
    rviz = await nodes.node("rviz")
    for name in ("robot1", "robot2"):
        node = await nodes.node("gigabrain", namespace=f"/{name}")
        node.publisher("scan", STRING, SENSOR_DATA)
    await until(lambda: len(rviz.endpoints()) == 2, "both scans")
    assert set(rviz.nodes()) == {"/rviz", "/robot1/gigabrain", "/robot2/gigabrain"}
    assert {(each.node, each.topic, each.qos) for each in rviz.endpoints()} == {
        ("/robot1/gigabrain", "/robot1/scan", SENSOR_DATA),
        ("/robot2/gigabrain", "/robot2/scan", SENSOR_DATA),
    }


async def test_the_tokens_of_sixty_nodes_are_found_and_lost(nodes: Nodes) -> None:
    session = nodes.net.raw()
    tokens = []
    for number in range(60):
        name = NodeName(0, f"{number:x}", "/", f"node_{number}")
        tokens.append(session.liveliness().declare_token(name.token))
        for id in range(1, 11):
            made = name.endpoint_token(id, "publisher", f"/t{id}", STRING, HASH, Qos())
            tokens.append(session.liveliness().declare_token(made))
    node = await nodes.node()
    await until(lambda: len(node.endpoints()) == 600, "the endpoints of 60 nodes")
    assert len(node.nodes()) == 61
    for token in tokens:
        token.undeclare()
    await until(lambda: node.nodes() == ("/gigabrain",), "their end")


async def test_a_malformed_token_is_counted(nodes: Nodes) -> None:
    node = await nodes.node()
    token = nodes.net.raw().liveliness().declare_token("@ros2_lv/0/x/y")
    await until(lambda: node.counts["malformed token"] == 1, "the token")
    token.undeclare()
    assert node.endpoints() == ()


async def test_another_domain_is_another_world(nodes: Nodes) -> None:
    talker, listener = await nodes.node("talker", domain=1), await nodes.node("listener", domain=2)
    other = await nodes.node("other", domain=1)
    got: list[Received] = []
    listener.subscribe("/chatter", STRING, Qos(), got.append)
    other.subscribe("/chatter", STRING, Qos(), lambda _: None)
    publisher = talker.publisher("/chatter", STRING)
    await until(lambda: publisher.readers == 1, "the reader in the same domain")
    publisher.publish(b"a")
    await until(lambda: len(other.nodes()) == 2, "the nodes")
    assert listener.nodes() == ("/listener",)
    assert got == []


async def test_humble_meets_humble_only(nodes: Nodes) -> None:
    humble = await nodes.node("humble", distro="humble")
    jazzy, old = await nodes.node("jazzy"), await nodes.node("old", distro="humble")
    got: list[Received] = []
    jazzy.subscribe("/chatter", STRING, Qos(), lambda _: None)
    old.subscribe("/chatter", STRING, Qos(), got.append)
    publisher = humble.publisher("/chatter", STRING)
    await until(lambda: publisher.readers == 1, "the reader of the same age")
    await repeat(lambda: publisher.publish(nodes.string("hi")), lambda: got)


class Instant:
    """An action that succeeds at once."""

    def accept(self, message: Any) -> bool:
        return True

    def cancel(self, goal: Goal) -> bool:
        return False

    async def run(self, goal: Goal, feedback: Callable[[Any], None]) -> Outcome:
        return Outcome(GoalState.SUCCEEDED, {"error_msg": goal.message.behavior_tree})


async def test_an_action_is_served(nodes: Nodes) -> None:
    types = nodes.types
    node, client = await nodes.node("robot"), await nodes.node("client")
    server = ActionServer(node, types, "/navigate_to_pose", NAVIGATE, Instant())

    async def ask(service: str, kind: str, **fields: Any) -> Any:
        request = types.encode(f"{kind}_Request", types.make(f"{kind}_Request", **fields))
        name = f"/navigate_to_pose/_action/{service}"
        return types.decode(f"{kind}_Response", await client.call(name, kind, request, 60))

    id = {"uuid": bytes(range(16))}
    sent = await ask(
        "send_goal", f"{NAVIGATE}_SendGoal", goal_id=id, goal={"behavior_tree": "here"}
    )
    assert sent.accepted
    got = await ask("get_result", f"{NAVIGATE}_GetResult", goal_id=id)
    assert (got.status, got.result.error_msg) == (GoalState.SUCCEEDED, "here")
    await server.close()


async def test_all_is_found_again_after_the_routers_restart(types: Types) -> None:
    async with robot() as net:
        nodes = Nodes(net, types)
        async with nodes.stack:
            router = await net.router()
            talker, listener = await nodes.node("talker"), await nodes.node("listener")
            got: list[Received] = []
            maps: list[Received] = []
            listener.subscribe("/chatter", STRING, Qos(), got.append)
            listener.subscribe("/map", STRING, LATCHED, maps.append)
            publisher = talker.publisher("/chatter", STRING)
            latched = talker.publisher("/map", STRING, LATCHED)
            await until(lambda: publisher.readers == 1, "the reader")
            await router.close()
            await until(lambda: publisher.readers == 0 and not talker.nodes(), "the loss")
            latched.publish(nodes.string("lost"))
            await net.router()
            await until(lambda: publisher.readers == 1, "the reader again")
            await repeat(lambda: publisher.publish(nodes.string("again")), lambda: got)
            await repeat(lambda: latched.publish(nodes.string("map")), lambda: maps)
            await until(lambda: len(talker.nodes()) == 2, "both nodes")
            assert nodes.text(got[-1].payload) == "again"


async def test_without_a_router_the_error_names_the_option(types: Types) -> None:
    with pytest.raises(ConfigError, match="router: tcp"):
        RmwZenohTransport(Ros2Link(), types)
