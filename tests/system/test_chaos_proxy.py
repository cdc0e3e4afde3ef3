"""The chaos proxy for TCP links: its faults, and its cleanup."""

import asyncio
import functools
import os
from collections.abc import AsyncIterator

import pytest

from gigabrain_schemas.topics import TELEOP
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.proxy.chaos import CALM, Chaos
from gigabrain_zenoh.qa.proxy.tcp import TcpProxy
from gigabrain_zenoh.testing.processes import SampleCollector, repeat, robot
from gigabrain_zenoh.testing.waiting import until
from tests.system.server import Server, serving

LONG = bytes(range(256)) * 400  # more than one read returns


@pytest.fixture
async def server() -> AsyncIterator[tuple[Server, int]]:
    async with serving() as made:
        yield made


@pytest.fixture
async def proxy(server: tuple[Server, int]) -> AsyncIterator[TcpProxy]:
    async with TcpProxy(("127.0.0.1", server[1]), seed=1) as made:
        yield made


async def call(proxy: TcpProxy) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    return await asyncio.open_connection(*proxy.address)


async def test_a_calm_proxy_changes_no_bytes_in_both_directions(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    reader, writer = await call(proxy)
    writer.write(LONG)
    await until(lambda: server[0].received == LONG, "all of it")
    server[0].writers[0].write(LONG)
    assert await reader.readexactly(len(LONG)) == LONG
    assert (proxy.figures["up"].taken, proxy.figures["up"].handed_on) == (102400, 102400)
    assert proxy.figures["down"].handed_on == 102400
    writer.close()
    await until(lambda: server[0].ends == ["fin"], "the end")
    await until(lambda: proxy.open_calls == 0, "nothing open")


async def test_a_half_closed_connection_still_receives(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    proxy.set(Chaos(delay_ms=50))
    reader, writer = await call(proxy)
    await until(lambda: server[0].writers, "the call")
    server[0].writers[0].write(b"late")
    writer.write(b"last")
    writer.write_eof()
    assert await reader.read() == b"late"
    assert (bytes(server[0].received), server[0].ends) == (b"last", ["fin"])
    writer.close()


async def test_a_hole_delays_all_bytes_until_it_ends(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    _, writer = await call(proxy)
    writer.write(b"before")
    await until(lambda: server[0].received, "before")
    proxy.set(Chaos(hole=True))
    writer.write(b" during")
    _, second = await call(proxy)  # accepted, but gets no reply
    second.write(b" another")
    await asyncio.sleep(0.1)
    assert (bytes(server[0].received), len(server[0].writers)) == (b"before", 1)
    proxy.set()
    await until(lambda: len(server[0].received) == 21, "all of it")
    assert server[0].received[:13] == b"before during"
    writer.close()
    second.close()


async def test_a_hole_in_one_direction_leaves_the_other_open(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    reader, writer = await call(proxy)
    await until(lambda: server[0].writers, "the call")
    proxy.set(Chaos(hole=True), "down")
    server[0].writers[0].write(b"answer")
    writer.write(b"question")
    await until(lambda: server[0].received == b"question", "the question")
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(reader.read(1), 0.1)
    proxy.set(CALM, "down")
    assert await reader.readexactly(6) == b"answer"
    writer.close()


async def test_a_hole_hides_a_closed_connection(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    _, writer = await call(proxy)
    await until(lambda: server[0].writers, "the call")
    proxy.set(Chaos(hole=True))
    writer.close()
    await writer.wait_closed()
    await asyncio.sleep(0.1)
    assert server[0].ends == []
    proxy.set()
    await until(lambda: server[0].ends == ["fin"], "the end")


@pytest.mark.parametrize(("reset", "end"), [(True, "rst"), (False, "fin")])
async def test_a_cut_ends_both_sides_with_reset_or_fin(
    server: tuple[Server, int], proxy: TcpProxy, reset: bool, end: str
) -> None:
    reader, writer = await call(proxy)
    await until(lambda: server[0].writers, "the call")
    proxy.cut(reset=reset)
    await until(lambda: server[0].ends == [end], "the end")
    if reset:
        with pytest.raises(ConnectionResetError):
            await reader.read()
    else:
        assert await reader.read() == b""
    assert (proxy.cuts, proxy.open_calls) == (1, 0)
    writer.close()


async def test_an_unplugged_proxy_refuses_callers_and_returns_at_the_same_port(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    _, first = await call(proxy)
    before = proxy.endpoint
    await proxy.unplug()
    assert (proxy.open_calls, proxy.endpoint) == (0, before)
    with pytest.raises(ConnectionRefusedError):
        await call(proxy)
    await proxy.plug()
    _, second = await call(proxy)
    second.write(b"back")
    await until(lambda: server[0].received == b"back", "it is back")
    first.close()
    second.close()


async def test_a_caller_is_reset_if_the_server_is_down(proxy: TcpProxy) -> None:
    async with TcpProxy(("127.0.0.1", 1)) as leads_nowhere:
        reader, writer = await call(leads_nowhere)
        with pytest.raises(ConnectionResetError):
            await reader.read()
        writer.close()


async def test_delay_and_jitter_keep_the_order(server: tuple[Server, int], proxy: TcpProxy) -> None:
    proxy.set(Chaos(delay_ms=20, jitter_ms=20))
    loop = asyncio.get_running_loop()
    _, writer = await call(proxy)
    began_s = loop.time()
    for number in range(20):
        writer.write(bytes([number]))
        await asyncio.sleep(0.002)
    await until(lambda: len(server[0].received) == 20, "all of it")
    assert loop.time() - began_s >= 0.02
    assert bytes(server[0].received) == bytes(range(20))
    writer.close()


async def test_a_full_proxy_makes_the_sender_wait(
    server: tuple[Server, int], proxy: TcpProxy
) -> None:
    _, writer = await call(proxy)
    await until(lambda: server[0].writers, "the call")
    proxy.set(Chaos(delay_ms=60_000))

    async def write_on() -> None:
        while True:
            writer.write(bytes(1 << 20))
            await writer.drain()

    writing = asyncio.ensure_future(write_on())
    await until(lambda: proxy.figures["up"].waiting >= 4 << 20, "it is full")
    await asyncio.sleep(0.5)
    assert proxy.figures["up"].waiting < 5 << 20
    assert not writing.done()
    writing.cancel()
    writer.transport.abort()


async def test_a_closed_proxy_leaves_no_socket_or_task(server: tuple[Server, int]) -> None:
    before, tasks = len(os.listdir("/dev/fd")), len(asyncio.all_tasks())
    for chaos in (CALM, Chaos(hole=True), Chaos(delay_ms=1000)):
        async with TcpProxy(("127.0.0.1", server[1])) as proxy:
            proxy.set(chaos)
            writers = [(await call(proxy))[1] for _ in range(5)]
            for writer in writers:
                writer.write(b"x" * 1000)
            await asyncio.sleep(0.02)
        for writer in writers:
            writer.transport.abort()
    await until(lambda: len(os.listdir("/dev/fd")) <= before, "no socket is left")
    await until(lambda: len(asyncio.all_tasks()) <= tasks, "no task is left")


@pytest.mark.parametrize("fault", ["hole", "rst", "unplugged"])
async def test_zenoh_recovers_from_network_faults(fault: str) -> None:
    async with robot() as net:
        router = await net.router()
        host, _, port = net.endpoint.removeprefix("tcp/").rpartition(":")
        async with TcpProxy((host, int(port))) as proxy:
            client = await ZenohTransport.open(Endpoint(connect=(proxy.endpoint,)))
            collector = SampleCollector(router, "robot/teleop")
            publish = functools.partial(client.publish, TELEOP, "robot/teleop")
            await repeat(lambda: publish(b"before", ""), lambda: collector.samples)
            calls = proxy.calls
            if fault == "hole":  # both ends drop the link after its lease
                proxy.set(Chaos(hole=True))
                await until(lambda: proxy.calls > calls, "Zenoh calls again")
                proxy.set()
            elif fault == "rst":
                proxy.cut(reset=True)
            else:
                await proxy.unplug()
                await proxy.plug()
            await repeat(lambda: publish(b"after", ""), lambda: b"after" in collector.payloads)
            assert proxy.calls > calls
            await client.close()
