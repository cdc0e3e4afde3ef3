"""Tests of the DDS transport, with our participants in this process."""

import asyncio
import contextlib
import socket
from collections.abc import AsyncIterator

import pytest

from gigabrain_zenoh.errors import BusError
from gigabrain_zenoh.ros2 import dds
from gigabrain_zenoh.ros2.qos import SENSOR_DATA, Qos
from gigabrain_zenoh.ros2.rtps_discovery import participant_ports
from gigabrain_zenoh.ros2.transport import Received
from gigabrain_zenoh.testing.waiting import settle, until
from tests.ros2.judge import free_domain
from tests.ros2.nodes import STRING, Nodes, dds_nodes


@pytest.fixture
async def nodes() -> AsyncIterator[Nodes]:
    async with dds_nodes() as made:
        yield made


async def test_a_reliable_reader_does_not_match_a_best_effort_publisher(nodes: Nodes) -> None:
    talker, listener = await nodes.node("talker"), await nodes.node("listener")
    sensor = talker.publisher("/scan", STRING, SENSOR_DATA)
    other = talker.publisher("/other", STRING)
    listener.subscribe("/scan", STRING, Qos(), lambda _: None)
    listener.subscribe("/other", STRING, Qos(), lambda _: None)
    await until(lambda: other.readers == 1, "the reader that matches")
    assert sensor.readers == 0


@pytest.mark.parametrize("taken", [118, 119])
async def test_beside_many_participants_it_joins_on_the_loopback_or_is_refused(taken: int) -> None:
    with free_domain() as domain, contextlib.ExitStack() as others:
        for index in range(taken):
            for port in participant_ports(domain, index):
                probe = others.enter_context(socket.socket(type=socket.SOCK_DGRAM))
                probe.bind(("127.0.0.1", port))
        opened = Nodes(transport="dds", domain=domain, localhost=True).opened()
        if taken == 119:
            with pytest.raises(BusError, match=f"domain {domain}"):
                await opened.__aenter__()
            return
        async with opened:
            last, _ = participant_ports(domain, 119)
            with (
                pytest.raises(OSError, match="in use"),
                socket.socket(type=socket.SOCK_DGRAM) as probe,
            ):
                probe.bind(("127.0.0.1", last))


@pytest.mark.parametrize("part", ["Bridge", "_StatusWatcher"])
async def test_a_failed_opening_leaves_nothing_open(
    monkeypatch: pytest.MonkeyPatch, part: str
) -> None:
    def fail(*_: object) -> None:
        raise OSError(24, "Too many open files")

    before = asyncio.all_tasks()
    monkeypatch.setattr(dds, part, fail)
    with free_domain() as domain:
        opened = Nodes(transport="dds", domain=domain, localhost=True).opened()
        with pytest.raises(OSError, match="Too many open files"):
            await opened.__aenter__()
        assert asyncio.all_tasks() == before
        await settle()  # sockets are closed in the next turn of the loop
        for port in participant_ports(domain, 0):
            with socket.socket(type=socket.SOCK_DGRAM) as free:
                free.bind(("127.0.0.1", port))


async def test_a_payload_of_another_type_is_not_sent(nodes: Nodes) -> None:
    talker, listener = await nodes.node("talker"), await nodes.node("listener")
    got: list[Received] = []
    listener.subscribe("/chatter", STRING, Qos(), got.append)
    publisher = talker.publisher("/chatter", STRING)
    await until(lambda: publisher.readers == 1, "the reader")
    publisher.publish(b"\0\1\0\0" + b"\xff" * 8)
    assert talker.counts["not sent"] == 1
    publisher.publish(nodes.string("hi") + b"tail")
    await until(lambda: got, "the good one")
    assert [nodes.text(each.payload) for each in got] == ["hi"]


async def test_a_busy_loop_keeps_the_newest_messages(nodes: Nodes) -> None:
    talker, listener = await nodes.node("talker"), await nodes.node("listener")
    got: list[str] = []
    listener.subscribe(
        "/chatter", STRING, Qos(depth=2), lambda r: got.append(nodes.text(r.payload))
    )
    publisher = talker.publisher("/chatter", STRING)
    await until(lambda: publisher.readers == 1, "the reader")
    for number in range(50):
        publisher.publish(nodes.string(str(number)))
    await until(lambda: got and got[-1] == "49", "the newest")
