"""Tests of `rmw_zenoh`: our nodes, and plain Zenoh sessions as other nodes."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
import zenoh

from gigabrain_zenoh.bus.zenoh.session import open_session
from gigabrain_zenoh.config.settings import Endpoint, Ros2Link
from gigabrain_zenoh.errors import BusError, ConfigError, NoAnswer, Refused
from gigabrain_zenoh.ros2 import rmw_zenoh
from gigabrain_zenoh.ros2.actions import ActionServer, Goal, GoalState, Outcome
from gigabrain_zenoh.ros2.opening import open_transport
from gigabrain_zenoh.ros2.qos import LATCHED, Qos
from gigabrain_zenoh.ros2.rmw_names import NodeName, parse_attachment
from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.testing.processes import free_endpoint, repeat, robot
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.nodes import STRING, TRIGGER, ZenohNodes, types, zenoh_nodes

NAVIGATE = "nav2_msgs/action/NavigateToPose"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
KEY = f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"


@pytest.fixture
async def nodes() -> AsyncIterator[ZenohNodes]:
    async with zenoh_nodes() as made:
        yield made


async def test_keys_and_bytes_are_those_of_rmw_zenoh(nodes: ZenohNodes) -> None:
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


async def test_a_new_publisher_without_a_reader_counts_none(nodes: ZenohNodes) -> None:
    told: list[int] = []
    talker = await nodes.node("talker")
    publisher = talker.publisher("/chatter", STRING, on_readers=told.append)
    latched = talker.publisher("/map", STRING, Qos(transient_local=True), told.append)
    await until(lambda: len(talker.endpoints()) == 2, "our own tokens")
    assert (publisher.readers, latched.readers, told) == (0, 0, [])


async def test_a_volatile_reader_receives_new_messages_of_a_latched_topic(
    nodes: ZenohNodes,
) -> None:
    publisher = (await nodes.node("talker")).publisher("/map", STRING, LATCHED)
    publisher.publish(nodes.string("old"))
    got: list[Received] = []
    (await nodes.node("listener")).subscribe("/map", STRING, Qos(), got.append)
    await repeat(lambda: publisher.publish(nodes.string("map")), lambda: got)
    assert {nodes.text(each.payload) for each in got} == {"map"}


async def test_each_response_of_a_service_belongs_to_its_request(nodes: ZenohNodes) -> None:
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


async def test_a_client_waits_for_its_server(nodes: ZenohNodes) -> None:
    client = await nodes.node("client")
    with pytest.raises(NoAnswer, match="/estop"):
        await client.call("estop", TRIGGER, b"a", 0.3)
    asking = asyncio.create_task(client.call("/estop", TRIGGER, b"a", 20))
    await asyncio.sleep(0.2)

    async def answer(request: bytes) -> bytes:
        return request

    (await nodes.node("server")).serve("/estop", TRIGGER, answer)
    assert await asking == b"a"


async def test_a_reply_carries_the_attachment_of_its_request(nodes: ZenohNodes) -> None:
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


async def test_messages_without_a_valid_attachment_are_counted_and_delivered(
    nodes: ZenohNodes,
) -> None:
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


async def test_the_tokens_of_sixty_nodes_are_found_and_lost(nodes: ZenohNodes) -> None:
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


async def test_a_malformed_token_is_counted(nodes: ZenohNodes) -> None:
    node = await nodes.node()
    token = nodes.net.raw().liveliness().declare_token("@ros2_lv/0/x/y")
    await until(lambda: node.counts["malformed token"] == 1, "the token")
    token.undeclare()
    assert node.endpoints() == ()


async def test_nodes_of_different_domains_do_not_communicate(nodes: ZenohNodes) -> None:
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


async def test_humble_communicates_only_with_humble(nodes: ZenohNodes) -> None:
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


async def test_an_action_is_served(nodes: ZenohNodes) -> None:
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


async def test_nodes_find_each_other_again_after_a_restart_of_the_router() -> None:
    async with robot() as net:
        nodes = ZenohNodes(net)
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


async def test_without_a_router_the_error_names_the_option() -> None:
    with pytest.raises(ConfigError, match="router: tcp"):
        RmwZenohTransport(Ros2Link(), types())


async def test_a_closed_node_keeps_no_publisher(nodes: ZenohNodes) -> None:
    async with nodes.opened("talker") as node:
        publisher = node.publisher("/map", STRING, LATCHED)
        assert publisher._put
    assert publisher._put is None


async def test_a_missing_router_is_reported_and_waited_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(rmw_zenoh, "WARN_AFTER_S", 0.05)
    here = free_endpoint()
    link = Ros2Link(router=here)
    with pytest.raises(BusError, match=f"^no router answers at {here}; start it, or correct"):
        async with open_transport(link, types(), timeout_s=0.05):
            pass
    joining = asyncio.ensure_future(RmwZenohTransport(link, types()).__aenter__())
    await until(lambda: f"no router answers at {here}" in caplog.text)
    router = await open_session(Endpoint(listen=(here,)))
    await (await joining).__aexit__(None, None, None)
    await asyncio.to_thread(router.close)
