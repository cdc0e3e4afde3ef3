import itertools
import time
from collections.abc import AsyncIterator
from typing import Any

import pytest
import zenoh

from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, OccupancyGrid, Twist
from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.safety import Health
from gigabrain_schemas.sensors import Imu
from gigabrain_schemas.topics import (
    CMD_VEL,
    HEALTH,
    IMAGE,
    IMU,
    INTENT,
    MAP,
    PERCEIVED,
    STATE,
    TELEOP,
    Topic,
)
from gigabrain_zenoh.bus.bridge import Mailbox
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh import transport as zenoh_transport
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.processes import SampleCollector, ZenohNetwork, repeat, robot
from gigabrain_zenoh.testing.waiting import until

REPLY = GateReply(ok=True, text="stopped", robot_type="mock", gate=GateStatus())


@pytest.fixture
async def net() -> AsyncIterator[ZenohNetwork]:
    async with robot() as made:
        await made.router()
        yield made


async def test_payloads_arrive_unchanged(net: ZenohNetwork) -> None:
    sender, receiver = await net.client(), await net.client()
    ear, star = (
        SampleCollector(receiver, "robot/teleop"),
        SampleCollector(receiver, "robot/image/*"),
    )
    payload = bytes(range(256)) * 3

    def send() -> None:
        sender.publish(TELEOP, "robot/teleop", payload, "application/x")
        sender.publish(IMAGE, "robot/image/front", b"", "application/x")
        sender.publish(IMAGE, "robot/image/rear", payload, "application/x")

    await repeat(send, lambda: ear.samples and len(set(star.samples)) == 2)
    assert set(ear.samples) == {("robot/teleop", payload)}
    assert set(star.samples) == {("robot/image/front", b""), ("robot/image/rear", payload)}


async def test_a_message_of_a_megabyte_arrives_whole(net: ZenohNetwork) -> None:
    sender, receiver = await net.client(), await net.client()
    ear = SampleCollector(receiver, "robot/map")
    payload = bytes(range(256)) * 4096
    await repeat(lambda: sender.publish(MAP, "robot/map", payload, ""), lambda: ear.samples)
    assert set(ear.payloads) == {payload}


async def test_messages_keep_their_order(net: ZenohNetwork) -> None:
    sender, receiver = await net.client(), await net.client()
    ear = SampleCollector(receiver, "robot/cmd_vel")
    count = itertools.count()

    def send() -> None:
        for _ in range(10):
            sender.publish(CMD_VEL, "robot/cmd_vel", b"%d" % next(count), "")

    await repeat(send, lambda: len(ear.samples) >= 100)
    numbers = [int(payload) for payload in ear.payloads]
    assert numbers == sorted(set(numbers))


async def test_each_topic_is_sent_with_its_own_quality_of_service(
    net: ZenohNetwork,
) -> None:
    samples: dict[str, zenoh.Sample] = {}
    net.raw().declare_subscriber("robot/**", lambda s: samples.update({str(s.key_expr): s}))
    bus = Bus(await net.client(), Clock())

    def send() -> None:
        bus.publish(CMD_VEL, CmdVel(linear_x=0.2))
        bus.publish(TELEOP, Twist(linear_x=0.2))
        bus.publish(INTENT, example(Intent))
        bus.publish(HEALTH, example(Health), name="control")

    await repeat(send, lambda: len(samples) == 4)

    def qos(key: str) -> tuple[Any, ...]:
        sample = samples[key]
        return sample.priority, sample.congestion_control, sample.express, str(sample.encoding)

    drop, kind = zenoh.CongestionControl.DROP, "application/msgpack;gigabrain."
    assert qos("robot/cmd_vel") == (zenoh.Priority.INTERACTIVE_HIGH, drop, False, kind + "CmdVel")
    assert qos("robot/teleop") == (zenoh.Priority.INTERACTIVE_HIGH, drop, False, kind + "Twist")
    assert qos("robot/intent") == (zenoh.Priority.DATA, drop, False, kind + "Intent")
    assert qos("robot/health/control") == (zenoh.Priority.BACKGROUND, drop, False, kind + "Health")


@pytest.fixture
def arrived(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """Collect the payloads that reached a mailbox."""
    payloads: list[bytes] = []

    class Watched(Mailbox[zenoh.Sample]):
        def put(self, sample: zenoh.Sample, key: str = "") -> None:
            super().put(sample, key)
            payloads.append(sample.payload.to_bytes())

    monkeypatch.setattr(zenoh_transport, "Mailbox", Watched)
    return payloads


def publish_200_without_leaving_the_loop(
    sender: ZenohTransport, topic: Topic[Any], keys: list[str], arrived: list[bytes]
) -> None:
    """Publish 200 numbers from the loop, each after the one before reached the mailbox."""
    deadline = time.monotonic() + 60
    for number in range(200):
        while b"%d" % number not in arrived and time.monotonic() < deadline:
            sender.publish(topic, keys[number % len(keys)], b"%d" % number, "")
            for _ in range(200):
                if b"%d" % number in arrived:
                    break
                time.sleep(0.0005)
    assert set(arrived) == {b"%d" % number for number in range(200)}


@pytest.mark.parametrize("depth", [1, 16])
async def test_a_busy_loop_gets_the_newest_and_not_the_backlog(
    net: ZenohNetwork, depth: int, arrived: list[bytes]
) -> None:
    sender, receiver = await net.client(), await net.client()
    ear = SampleCollector(receiver, "robot/cmd_vel", depth)
    publish_200_without_leaving_the_loop(sender, CMD_VEL, ["robot/cmd_vel"], arrived)
    newest = arrived[-depth:]
    await until(lambda: ear.samples)
    assert ear.payloads[:depth] == newest


async def test_a_busy_loop_gets_the_newest_of_each_key_of_a_pattern(
    net: ZenohNetwork, arrived: list[bytes]
) -> None:
    sender, receiver = await net.client(), await net.client()
    ear = SampleCollector(receiver, "robot/perceived/*", 1)
    keys = ["robot/perceived/door", "robot/perceived/person"]
    publish_200_without_leaving_the_loop(sender, PERCEIVED, keys, arrived)
    await until(lambda: ear.samples)
    assert ear.samples[:2] == [(keys[0], b"198"), (keys[1], b"199")]


def wait_without_leaving_the_loop(arrived: list[bytes], count: int) -> None:
    deadline = time.monotonic() + 60
    while len(arrived) < count and time.monotonic() < deadline:
        time.sleep(0.0005)


async def test_a_busy_process_loses_no_imu_sample(net: ZenohNetwork, arrived: list[bytes]) -> None:
    sender, bus = Bus(await net.client(), Clock()), Bus(await net.client(), Clock())
    received: list[int] = []
    bus.subscribe(IMU, lambda _, imu: received.append(imu.seq))
    await repeat(lambda: sender.publish(IMU, example(Imu)), lambda: received)
    first, taken = sender.sent[IMU.key] + 1, len(received)
    for _ in range(4):  # two ticks
        sender.publish(IMU, example(Imu))
    wait_without_leaving_the_loop(arrived, first + 3)
    await until(lambda: received[-1] == first + 3)
    assert received[taken:] == [first, first + 1, first + 2, first + 3]


async def test_a_lazy_message_is_received_before_the_next_one_that_wakes(
    net: ZenohNetwork, arrived: list[bytes]
) -> None:
    sender, bus = Bus(await net.client(), Clock()), Bus(await net.client(), Clock())
    received: list[str] = []
    bus.subscribe(INTENT, lambda key, _: received.append(key), lazy=True)
    bus.subscribe(TELEOP, lambda key, _: received.append(key))
    await repeat(lambda: sender.publish(INTENT, example(Intent)), lambda: arrived)
    assert received == []
    await repeat(lambda: sender.publish(TELEOP, example(Twist)), lambda: received)
    assert received[:2] == ["robot/intent", "robot/teleop"]


async def test_a_closed_subscription_receives_nothing(net: ZenohNetwork) -> None:
    sender, receiver = await net.client(), await net.client()
    ear, other = (
        SampleCollector(receiver, "robot/teleop"),
        SampleCollector(receiver, "robot/teleop"),
    )
    ear.close()
    ear.close()
    await repeat(lambda: sender.publish(TELEOP, "robot/teleop", b"x", ""), lambda: other.samples)
    assert ear.samples == []


async def test_a_bus_message_is_unchanged_over_zenoh(net: ZenohNetwork) -> None:
    one, two = Bus(await net.client(), Clock(), "one"), Bus(await net.client(), Clock(), "two")
    states = two.latest(STATE)
    one.time.boot, one.time.tick = 7, 50
    sent: list[RobotState] = []
    await repeat(
        lambda: sent.append(one.publish(STATE, example(RobotState), basis=50)),
        lambda: states.newest,
    )
    assert states.newest in sent
    assert (two.time.boot, two.time.tick) == (7, 50)


async def test_a_client_of_another_language_may_send_json(net: ZenohNetwork) -> None:
    bus, raw = Bus(await net.client(), Clock()), net.raw()
    seen: set[float] = set()
    bus.subscribe(TELEOP, lambda _, twist: seen.add(twist.linear_x))

    def send() -> None:
        raw.put("robot/teleop", b'{"linear_x": 0.1}', encoding="application/json")
        raw.put("robot/teleop", b'{"linear_x": 0.2}')

    await repeat(send, lambda: seen == {0.1, 0.2})
    assert bus.rejected.total() == 0


@pytest.mark.parametrize(
    "payload",
    [b"\xc1" * 100, b'{"linear_x": NaN}', bytes(1_100), None],
    ids=["random", "nan", "oversized", "delete"],
)
async def test_hostile_payloads_are_dropped_and_counted(
    net: ZenohNetwork, payload: bytes | None
) -> None:
    bus, raw = Bus(await net.client(), Clock()), net.raw()
    twists = bus.latest(TELEOP)

    def send() -> None:
        if payload is None:
            raw.delete("robot/teleop")
        else:
            raw.put("robot/teleop", payload)

    await repeat(send, lambda: bus.rejected["robot/teleop"])
    assert twists.newest is None
    await repeat(lambda: raw.put("robot/teleop", b'{"linear_x": 0.1}'), lambda: twists.newest)
    assert not bus.failed.done()


async def test_far_too_large_payloads_are_dropped_by_the_router(net: ZenohNetwork) -> None:
    bus, raw = Bus(await net.client(), Clock()), net.raw()
    twists = bus.latest(TELEOP)

    def send() -> None:
        raw.put("robot/teleop", bytes(5_000))
        raw.put("robot/teleop", b'{"linear_x": 0.1}')

    await repeat(send, lambda: twists.newest)
    assert bus.rejected["robot/teleop"] == 0


async def test_the_router_sets_the_priority_of_each_key(net: ZenohNetwork) -> None:
    samples: dict[str, zenoh.Sample] = {}
    net.raw().declare_subscriber("red/**", lambda s: samples.update({str(s.key_expr): s}))
    raw = net.raw()

    def send() -> None:
        for key in ("red/robot/cmd_vel", "red/robot/image/front", "red/robot/estop"):
            raw.put(
                key,
                b"x",
                priority=zenoh.Priority.REAL_TIME,
                congestion_control=zenoh.CongestionControl.BLOCK,
                express=True,
            )

    await repeat(send, lambda: len(samples) == 3)
    assert {key: (s.priority, s.congestion_control, s.express) for key, s in samples.items()} == {
        "red/robot/cmd_vel": (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.DROP, False),
        "red/robot/image/front": (zenoh.Priority.DATA, zenoh.CongestionControl.DROP, False),
        "red/robot/estop": (zenoh.Priority.REAL_TIME, zenoh.CongestionControl.DROP, False),
    }


async def test_a_publisher_knows_whether_there_are_subscribers(net: ZenohNetwork) -> None:
    sender, receiver = await net.client(), await net.client()
    has_readers: list[bool] = []
    close = sender.watch_readers("tf", has_readers.append)
    assert has_readers == [False]
    end = receiver.subscribe("tf", lambda *_: None, 1)
    await until(lambda: has_readers[-1], "a reader")
    end()
    await until(lambda: not has_readers[-1], "none")
    close()
    receiver.subscribe("tf", lambda *_: None, 1)
    ear = SampleCollector(receiver, "tf")
    await repeat(lambda: sender.publish(TELEOP, "tf", b"x", ""), lambda: ear.samples)
    assert not has_readers[-1]


async def test_late_joiners_get_the_kept_value(net: ZenohNetwork) -> None:
    one = Bus(await net.client(), Clock(), "one")
    one.publish(MAP, example(OccupancyGrid))
    sent = one.publish(MAP, example(OccupancyGrid))
    late = Bus(await net.client(), Clock(), "late")
    maps = late.latest(MAP)
    await until(lambda: maps.newest)
    assert maps.newest == sent
    assert sent.seq == 2
