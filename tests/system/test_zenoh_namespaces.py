from collections.abc import AsyncIterator

import pytest

from gigabrain_schemas.examples import example
from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import DESCRIBE, HEALTH, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.processes import SampleCollector, ZenohNetwork, repeat, robot
from gigabrain_zenoh.testing.waiting import until


@pytest.fixture
async def net() -> AsyncIterator[ZenohNetwork]:
    async with robot() as made:
        yield made


async def describe(_: DescribeRequest) -> Description:
    return example(Description)


async def test_two_robots_on_one_router_do_not_receive_each_others_messages(
    net: ZenohNetwork,
) -> None:
    await net.router()
    red, blue = await net.client("red"), await net.client("blue")
    red_ear, blue_ear = (
        SampleCollector(await net.client("red"), "robot/*"),
        SampleCollector(blue, "robot/*"),
    )

    def send() -> None:
        red.publish(TELEOP, "robot/teleop", b"red", "")
        blue.publish(TELEOP, "robot/teleop", b"blue", "")

    await repeat(send, lambda: red_ear.samples and blue_ear.samples)
    assert set(red_ear.samples) == {("robot/teleop", b"red")}
    assert set(blue_ear.samples) == {("robot/teleop", b"blue")}


async def test_the_fleet_receives_each_robot_under_its_name(net: ZenohNetwork) -> None:
    await net.router()
    red, fleet = await net.client("red"), await net.client()
    ear = SampleCollector(fleet, "red/robot/*")
    await repeat(lambda: red.publish(TELEOP, "robot/teleop", b"x", ""), lambda: ear.samples)
    assert set(ear.samples) == {("red/robot/teleop", b"x")}


async def test_a_query_stays_within_its_robot(net: ZenohNetwork) -> None:
    await net.router()
    red, blue = Bus(await net.client("red"), Clock()), Bus(await net.client("blue"), Clock())
    asker = Bus(await net.client("red"), Clock())
    red.serve(DESCRIBE, describe, name="driver")
    blue.serve(DESCRIBE, describe, name="driver")
    replies: list[Description] = []
    while not replies:
        replies = await asker.ask(DESCRIBE, DescribeRequest(), name="*", timeout_s=5)
    assert replies == [example(Description)]


async def test_a_router_in_a_namespace_is_one_of_the_robots_processes(net: ZenohNetwork) -> None:
    """It replies and publishes in its namespace, and still connects those of other namespaces."""
    router = Bus(await net.router("red"), Clock(), "router")
    red, fleet = Bus(await net.client("red"), Clock()), await net.client()
    received: list[tuple[str, Health]] = []
    red.subscribe(HEALTH, lambda key, health: received.append((key, health)))
    of_fleet = SampleCollector(fleet, "red/robot/health/*")
    await repeat(
        lambda: router.publish(HEALTH, example(Health), name="router"),
        lambda: received and of_fleet.samples,
    )
    assert received[0][0] == "robot/health/router"
    assert of_fleet.samples[0][0] == "red/robot/health/router"
    router.serve(DESCRIBE, describe, name="router")
    while not await red.ask(DESCRIBE, DescribeRequest(), name="router", timeout_s=20):
        pass

    blue, blue_ear = await net.client("blue"), SampleCollector(await net.client("blue"), "robot/*")
    await repeat(lambda: blue.publish(TELEOP, "robot/teleop", b"b", ""), lambda: blue_ear.samples)
    assert not await Bus(blue, Clock()).ask(DESCRIBE, DescribeRequest(), name="router")


async def test_a_router_in_a_namespace_receives_its_robot(net: ZenohNetwork) -> None:
    router, red = await net.router("red"), await net.client("red")
    ear = SampleCollector(router, "robot/teleop")
    await repeat(lambda: red.publish(TELEOP, "robot/teleop", b"x", ""), lambda: ear.samples)
    await until(lambda: ear.samples[0] == ("robot/teleop", b"x"))
