import asyncio
import gc
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Awaitable, Callable

import pytest

from gigabrain_schemas.topics import SCAN, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import BodyLost, BusError, ConfigError
from gigabrain_zenoh.testing.processes import (
    SampleCollector,
    free_endpoint,
    repeat,
    robot,
    router_process,
    session_threads,
)
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until


def client_of(endpoint: str) -> Awaitable[ZenohTransport]:
    return ZenohTransport.open(Endpoint(connect=(endpoint,)))


async def echo(payload: bytes) -> tuple[bytes, str]:
    return payload, ""


async def test_a_router_port_in_use_is_reported_in_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(BusError) as caught:
            await ZenohTransport.open(Endpoint(listen=(endpoint,)))
    assert str(caught.value) == (
        f"the router's port is taken ({endpoint}); stop what uses it, or choose another"
    )


async def test_a_router_that_cannot_listen_reports_the_reason_in_one_line() -> None:
    with pytest.raises(BusError) as caught:
        await ZenohTransport.open(Endpoint(listen=("unixsock-stream//nowhere/at/all",)))
    assert str(caught.value).startswith("the router cannot listen on unixsock-stream//nowhere")
    assert "\n" not in str(caught.value)
    assert ".rs:" not in str(caught.value)


@pytest.mark.parametrize(
    "text",
    ["foo", "", "tcp/127.0.0.1", "tcp/127.0.0.1:99999", "tcp/127.0.0.1:x", "http/127.0.0.1:80",
     "127.0.0.1:7447", "tcp//127.0.0.1:7447", "unixsock-stream/"],
)  # fmt: skip
async def test_an_invalid_endpoint_is_refused_at_once(text: str) -> None:
    with pytest.raises(ConfigError, match=r"is not a Zenoh endpoint; expected one like tcp/127"):
        await ZenohTransport.open(Endpoint(connect=(text,)))


async def test_a_client_without_any_endpoint_is_refused() -> None:
    with pytest.raises(ConfigError, match="no router to connect to"):
        await ZenohTransport.open(Endpoint())


@pytest.mark.parametrize("namespace", ["a//b", "/a", "a/", "a*", "robot/*", "a#b", "a?b"])
async def test_an_invalid_namespace_is_refused_in_one_line(namespace: str) -> None:
    with pytest.raises(ConfigError) as caught:
        await ZenohTransport.open(Endpoint(listen=(free_endpoint(),), namespace=namespace))
    text = str(caught.value)
    assert text.startswith(f"namespace = '{namespace}' is refused by Zenoh: ")
    assert "\n" not in text
    assert ".rs" not in text


async def test_a_client_waits_for_its_router() -> None:
    endpoint = free_endpoint()
    opening = asyncio.ensure_future(client_of(endpoint))
    await asyncio.sleep(0.3)
    assert not opening.done()
    with router_process(endpoint):
        async with asyncio.timeout(20):
            client = await opening
        await client.close()


async def test_waiting_for_a_router_can_be_cancelled_and_closes_its_session() -> None:
    others = session_threads()
    async with robot() as net:
        opening = asyncio.ensure_future(client_of(net.endpoint))
        await asyncio.sleep(0.1)
        opening.cancel()
        with pytest.raises(asyncio.CancelledError):
            await opening
        await net.router()
        # the remaining thread finds the router and closes its session
        await until(lambda: session_threads() <= others)


async def test_a_session_that_opens_during_its_cancellation_is_closed() -> None:
    others = session_threads()
    async with robot() as net:
        router = await net.router()
        for turns in range(40):
            opening = asyncio.ensure_future(client_of(net.endpoint))
            for _ in range(turns):
                await asyncio.sleep(0.0005)
            opening.cancel()
            try:
                await (await opening).close()
            except asyncio.CancelledError:
                continue
        await until(lambda: session_threads() <= others)
        await until(lambda: not router._lines.now.session.info.transports())


def test_a_process_that_stops_waiting_for_a_router_ends() -> None:
    program = f"""
import asyncio
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
async def main():
    endpoint = Endpoint(connect=("{free_endpoint()}",))
    try:
        await asyncio.wait_for(ZenohTransport.open(endpoint), 0.1)
    except TimeoutError:
        print("gave up")
asyncio.run(main())
"""
    ended = subprocess.run(
        (sys.executable, "-c", program), capture_output=True, text=True, timeout=120, check=False
    )
    assert (ended.stdout, ended.stderr, ended.returncode) == ("gave up\n", "", 0)


async def test_data_and_queries_work_again_after_a_restart_of_the_router() -> None:
    endpoint = free_endpoint()
    with router_process(endpoint) as router:
        sender, receiver = await client_of(endpoint), await client_of(endpoint)
        ear = SampleCollector(receiver, "robot/scan")
        receiver.serve("robot/goal", echo)
        await repeat(lambda: sender.publish(SCAN, "robot/scan", b"1", ""), lambda: ear.samples)
        router.kill()
        sender.publish(SCAN, "robot/scan", b"lost", "")
        assert await sender.query("robot/goal", b"", "", 0.2, "data") == []
    with router_process(endpoint):
        await repeat(
            lambda: sender.publish(SCAN, "robot/scan", b"2", ""), lambda: b"2" in ear.payloads
        )
        replies: list[bytes | str] = []
        async with asyncio.timeout(30):
            while not replies:
                replies = await sender.query("robot/goal", b"x", "", 1.0, "data")
        assert replies == [b"x"]
        await sender.close()
        await receiver.close()
    assert b"lost" not in ear.payloads


async def test_a_goal_request_is_not_repeated_when_the_router_dies() -> None:
    endpoint, asked = free_endpoint(), asyncio.Event()

    async def never(_: bytes) -> tuple[bytes, str]:
        asked.set()
        await asyncio.sleep(600)
        return b"", ""

    with router_process(endpoint) as router:
        server, client = await client_of(endpoint), await client_of(endpoint)
        server.serve("robot/goal", never)
        tasks = Tasks(Bus(client, Clock(), "script"), starting_s=600)
        goal = asyncio.ensure_future(tasks.go_to(1.0, 0.0, how="queue"))
        await asyncio.wait_for(asked.wait(), PATIENCE_S)
        router.kill()
        with pytest.raises(BodyLost, match="the link was lost before the answer"):
            await goal
        await server.close()
        await client.close()


async def test_a_publisher_knows_its_subscribers_again_after_a_router_restart() -> None:
    endpoint = free_endpoint()
    has_readers: list[bool] = []
    with router_process(endpoint) as router:
        sender, receiver = await client_of(endpoint), await client_of(endpoint)
        sender.watch_readers("tf", has_readers.append)
        ear = SampleCollector(receiver, "tf")
        await until(lambda: has_readers[-1], "a reader")
        router.kill()
    has_readers.append(False)
    with router_process(endpoint):
        await until(lambda: has_readers[-1], "the reader again")
        ear.close()
        await until(lambda: not has_readers[-1], "none")
        await sender.close()
        await receiver.close()


async def test_a_client_rejoins_after_its_router_forgot_its_session() -> None:
    endpoint = free_endpoint()
    with router_process(endpoint) as router:
        client = await client_of(endpoint)
        ear = SampleCollector(client, "robot/teleop")
        first = client._lines.now
        router.kill()
        await until(lambda: client._lines.now is None)
    with router_process(endpoint):
        await repeat(lambda: client.publish(TELEOP, "robot/teleop", b"", ""), lambda: ear.samples)
        second = client._lines.now
        assert first
        assert second
        assert str(first.session.zid()) != str(second.session.zid())
        ear.close()  # undeclares on the second session
        received = len(ear.samples)
        other = SampleCollector(client, "robot/teleop")
        await repeat(lambda: client.publish(TELEOP, "robot/teleop", b"", ""), lambda: other.samples)
        assert len(ear.samples) == received
        await client.close()


async def test_closing_does_not_wait_for_a_reconnection() -> None:
    others = session_threads()
    endpoint = free_endpoint()
    with router_process(endpoint) as router:
        client = await client_of(endpoint)
        router.kill()
        await until(lambda: client._lines.now is None)
        asking = asyncio.ensure_future(client.query("robot/goal", b"", "", 60.0, "data"))
        await asyncio.sleep(0)
        async with asyncio.timeout(5):
            await client.close()
            assert await asking == []
    with router_process(endpoint):  # lets a waiting thread connect and end
        await until(lambda: session_threads() <= others)


def fill_link(sender: ZenohTransport) -> None:
    """Send more than the kernel buffers to a router that does not read."""
    for _ in range(200):
        sender.publish(SCAN, "robot/scan", bytes(100_000), "")


async def close_with_router(router_is: str, use: Callable[[ZenohTransport], None]) -> None:
    others = session_threads()
    endpoint = free_endpoint()
    with router_process(endpoint) as router:
        client = await client_of(endpoint)
        ear = SampleCollector(client, "robot/teleop")
        await repeat(lambda: client.publish(TELEOP, "robot/teleop", b"", ""), lambda: ear.samples)
        (router.freeze if router_is == "frozen" else router.kill)()
        use(client)
        asking = asyncio.ensure_future(client.query("robot/goal", b"", "", 60.0, "data"))
        await asyncio.sleep(0)
        async with asyncio.timeout(5):  # Zenoh's own close takes 10 s
            await client.close()
            assert await asking == []
    await until(lambda: session_threads() <= others)


@pytest.mark.parametrize("router_is", ["killed", "frozen"])
async def test_closing_does_not_wait_for_a_lost_router(router_is: str) -> None:
    await close_with_router(router_is, lambda _: None)


async def test_closing_does_not_wait_for_a_stuck_link() -> None:
    await close_with_router("frozen", fill_link)


async def test_publishing_into_a_stuck_link_does_not_block_the_loop() -> None:
    others = session_threads()
    endpoint = free_endpoint()
    with router_process(endpoint) as router:
        client = await client_of(endpoint)
        router.freeze()
        async with asyncio.timeout(60):  # a blocking publisher would take 5 s each
            fill_link(client)
            await asyncio.sleep(0)
        await client.close()
    await until(lambda: session_threads() <= others)


def handles() -> tuple[int, int]:
    """Return the numbers of open descriptors and of threads; each subscription has a thread."""
    return len(os.listdir("/dev/fd")), threading.active_count()


async def open_and_close_sessions() -> None:
    async with robot() as net:
        await net.router()
        one, two = await net.client(), await net.client("red")
        ears = [SampleCollector(one, f"robot/{name}") for name in ("a", "b", "c")] + [
            SampleCollector(two, "robot/teleop")
        ]
        one.serve("robot/goal", echo)
        await repeat(lambda: one.publish(TELEOP, "robot/a", b"x", ""), lambda: ears[0].samples)
        await one.query("robot/goal", b"x", "", 5.0, "data")


async def test_closed_sessions_leave_no_descriptor_or_thread() -> None:
    threads = threading.active_count()
    await open_and_close_sessions()  # Zenoh keeps some handles for the next session
    await until(lambda: threading.active_count() <= threads)
    gc.collect()
    before = handles()
    for _ in range(5):
        await open_and_close_sessions()
    gc.collect()
    await until(lambda: all(now <= then for now, then in zip(handles(), before, strict=True)))
