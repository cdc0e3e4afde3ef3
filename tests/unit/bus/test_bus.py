import asyncio
import logging
from typing import Any

import msgspec
import pytest

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel, OccupancyGrid, Twist, WorldModel
from gigabrain_schemas.examples import EXAMPLES, example
from gigabrain_schemas.requests import (
    EstopRequest,
    GateReply,
)
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import (
    CMD_VEL,
    ESTOP,
    HEALTH,
    MAP,
    STATE,
    TELEOP,
    TOPICS,
    WORLD,
    Topic,
)
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import settle

SECOND_NS = 1_000_000_000
GRID = example(OccupancyGrid)
REPLY = GateReply(ok=True, text="stopped", robot_type="mock", gate=GateStatus())


@pytest.fixture
async def net() -> Net:
    return Net()


async def test_a_message_crosses_with_its_header_filled_in(net: Net) -> None:
    worlds = net.two.latest(WORLD)
    net.one.time.boot, net.one.time.tick = 7, 206
    sent = net.one.publish(WORLD, WorldModel(scan_ok=True, obstacle_ahead=False), basis=205)
    assert worlds.newest == sent
    assert (sent.stamp_ns, sent.seq, sent.boot, sent.tick, sent.basis) == (
        1_000_000_000_000_000_000, 1, 7, 206, 205,
    )  # fmt: skip


async def test_seq_counts_per_key_and_sender(net: Net) -> None:
    twist = Twist(linear_x=0.1)
    assert [net.one.publish(TELEOP, twist).seq for _ in range(3)] == [1, 2, 3]
    assert net.two.publish(TELEOP, twist).seq == 1
    health = example(Health)
    assert net.one.publish(HEALTH, health, name="a").seq == 1
    assert net.one.publish(HEALTH, health, name="b").seq == 1
    assert dict(net.one.sent) == {"robot/teleop": 3, "robot/health/a": 1, "robot/health/b": 1}


async def test_the_state_moves_the_robots_time_for_whoever_listens(net: Net) -> None:
    heard: list[str] = []
    net.two.subscribe(STATE, lambda key, _: heard.append(key))
    net.one.time.boot, net.one.time.tick = 7, 50
    net.one.publish(STATE, example(RobotState))
    assert heard == ["robot/state"]
    assert (net.two.time.boot, net.two.time.tick) == (7, 50)


async def test_on_new_is_not_called_for_what_is_not_kept(net: Net) -> None:
    seen: list[int] = []
    net.two.latest(WORLD, lambda world: seen.append(world.tick))
    net.two.time.boot = net.one.time.boot = 7
    for tick in (100, 99, 101):
        net.two.time.tick = max(net.two.time.tick, tick)
        net.one.time.tick = tick
        net.one.publish(WORLD, WorldModel(scan_ok=True, obstacle_ahead=False))
    assert seen == [100, 101]


async def test_json_is_read_beside_messagepack(net: Net) -> None:
    twists = net.two.latest(TELEOP)
    net.network.deliver("robot/teleop", b'{"linear_x": 0.2}')
    assert twists.fresh() == Twist(linear_x=0.2)
    net.network.deliver("robot/teleop", b"\x81\xa8linear_x\x01")
    assert twists.fresh() == Twist(linear_x=1.0)
    assert net.two.rejected.total() == 0


@pytest.mark.parametrize("topic", TOPICS, ids=lambda topic: topic.key)
async def test_garbage_on_any_key_is_dropped_counted_and_handed_to_who_asked(
    net: Net, topic: Topic[Any]
) -> None:
    seen: list[Message] = []
    bad: list[bytes] = []
    net.two.subscribe(topic, lambda _, message: seen.append(message), bad.append)
    garbage = [b"", b"\xc1", b"nonsense", bytes(2_000_000), b'{"a": 1}']
    for payload in garbage:
        net.network.deliver(topic.at("x"), payload)
    assert seen == []
    assert bad == garbage
    assert net.two.rejected[topic.at("*")] == 5
    assert net.two.received[topic.at("*")] == 5
    assert not net.two.failed.done()
    net.network.deliver(topic.at("x"), msgspec.msgpack.encode(EXAMPLES[topic.type.__name__]))
    assert len(seen) == 1


async def test_a_fault_is_reported_once_and_its_end_once(
    net: Net, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    net.two.latest(TELEOP)
    for _ in range(50):
        net.network.deliver("robot/teleop", b"{}")
    assert caplog.messages == [
        "dropped a message on robot/teleop: Object missing required field `linear_x`"
    ]
    await net.clock.advance(SECOND_NS)
    for _ in range(50):
        net.network.deliver("robot/teleop", b'{"linear_x": 0}')
    assert caplog.messages[1:] == ["robot/teleop is valid again"]
    net.network.deliver("robot/teleop", b"{}")
    assert len(caplog.messages) == 3
    assert net.two.rejected["robot/teleop"] == 51


async def test_a_bad_sender_beside_a_good_one_does_not_fill_the_log(
    net: Net, caplog: pytest.LogCaptureFixture
) -> None:
    net.two.latest(TELEOP)
    for _ in range(100):
        net.network.deliver("robot/teleop", b"{}")
        net.network.deliver("robot/teleop", b'{"linear_x": 0}')
        await net.clock.advance(SECOND_NS - 1)
    assert len(caplog.messages) == 1


async def test_a_late_joiner_gets_the_kept_value(net: Net) -> None:
    sent = net.one.publish(MAP, GRID)
    maps = net.two.latest(MAP)
    assert maps.newest is None
    await settle()
    assert maps.newest == sent


async def test_a_late_joiner_gets_the_last_of_the_kept_values(net: Net) -> None:
    net.one.publish(MAP, GRID)
    sent = net.one.publish(MAP, GRID)
    seen: list[OccupancyGrid] = []
    net.two.subscribe(MAP, lambda _, grid: seen.append(grid))
    await settle()
    assert seen == [sent]
    assert sent.seq == 2


async def test_a_kept_value_whose_message_was_lost_is_asked_for_again(
    net: Net, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = net.two.latest(MAP)
    await settle()
    with monkeypatch.context() as lost:
        lost.setattr(net.one.transport, "publish", lambda *_: None)
        sent = net.one.publish(MAP, GRID)
    await net.clock.advance(SECOND_NS - 1)
    assert maps.newest is None
    await net.clock.advance(1)
    await settle()
    assert maps.newest == sent


async def test_a_subscription_that_has_ended_asks_for_no_kept_value(net: Net) -> None:
    asked: list[bytes] = []

    async def answer(payload: bytes) -> tuple[bytes, str]:
        asked.append(payload)
        return b"", ""

    close = net.two.subscribe(MAP, lambda _, __: None)
    await settle()
    close()
    net.network.transport().serve("robot/map", answer)
    await net.clock.advance(60 * SECOND_NS)
    assert asked == []


async def test_a_stream_is_not_kept(net: Net) -> None:
    net.one.publish(TELEOP, Twist(linear_x=0.2))
    twists = net.two.latest(TELEOP)
    await settle()
    assert twists.newest is None


async def test_a_kept_value_that_makes_a_node_fail_ends_its_process_too(net: Net) -> None:
    net.one.publish(MAP, GRID)

    def fail(_key: str, _grid: Message) -> None:
        raise ZeroDivisionError

    net.two.subscribe(MAP, fail)
    await settle()
    assert isinstance(net.two.failed.exception(), ZeroDivisionError)


async def test_a_subscription_ends_when_it_is_told_to(net: Net) -> None:
    seen: list[Twist] = []
    close = net.two.subscribe(TELEOP, lambda _, twist: seen.append(twist))
    net.one.publish(TELEOP, Twist(linear_x=0.2))
    assert net.two.listens == ["robot/teleop"]
    close()
    net.one.publish(TELEOP, Twist(linear_x=0.3))
    assert [twist.linear_x for twist in seen] == [0.2]
    assert net.two.listens == []


async def test_an_exception_in_a_subscriber_ends_its_process_and_no_other(net: Net) -> None:
    def fail(_: Twist) -> None:
        raise ZeroDivisionError

    net.one.latest(TELEOP, fail)
    twists = net.two.latest(TELEOP)
    net.two.publish(TELEOP, Twist(linear_x=0.2))
    assert twists.newest
    with pytest.raises(ZeroDivisionError):
        await net.one.failed
    assert not net.two.failed.done()


async def test_the_first_exception_is_the_one_that_is_raised(net: Net) -> None:
    def fail(twist: Twist) -> None:
        raise ValueError(str(twist.linear_x))

    net.one.latest(TELEOP, fail)
    for speed in (0.1, 0.2):
        net.two.publish(TELEOP, Twist(linear_x=speed))
    with pytest.raises(ValueError, match=r"^0\.1$"):
        await net.one.failed


async def test_who_has_left_hears_and_answers_no_more(net: Net) -> None:
    async def answer(_: EstopRequest) -> GateReply:
        return REPLY

    net.one.serve(ESTOP, answer)
    twists = net.one.latest(TELEOP)
    await net.one.close()
    await net.one.close()
    net.two.publish(TELEOP, Twist(linear_x=0.2))
    assert twists.newest is None
    assert await net.two.ask(ESTOP, EstopRequest()) == []


async def test_leaving_gives_up_what_is_still_being_fetched(net: Net) -> None:
    async def never(_: bytes) -> tuple[bytes, str]:
        await asyncio.sleep(60)
        return b"", ""

    net.network.transport().serve("robot/map", never)
    net.two.latest(MAP)
    await settle()
    await net.two.close()
    await settle()
    assert not [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]


async def test_what_is_sent_while_something_is_delivered_comes_after_it(net: Net) -> None:
    order: list[tuple[str, float]] = []

    def echo(twist: Twist) -> None:
        order.append(("teleop", twist.linear_x))
        if twist.linear_x < 0.3:
            net.one.publish(CMD_VEL, CmdVel(linear_x=twist.linear_x))
            order.append(("done", twist.linear_x))

    net.one.latest(TELEOP, echo)
    net.two.latest(CMD_VEL, lambda command: order.append(("cmd_vel", command.linear_x)))
    net.two.publish(TELEOP, Twist(linear_x=0.2))
    assert order == [("teleop", 0.2), ("done", 0.2), ("cmd_vel", 0.2)]


async def test_a_kept_value_does_not_replace_what_has_been_said_meanwhile(net: Net) -> None:
    net.one.publish(MAP, msgspec.structs.replace(GRID, resolution=0.1))
    net.bus("stranger").publish(MAP, GRID)
    maps = net.two.latest(MAP)
    net.one.publish(MAP, msgspec.structs.replace(GRID, resolution=0.2))
    for _ in range(4):  # two answers to wait for
        await settle()
    assert maps.newest
    assert maps.newest.resolution == 0.2
