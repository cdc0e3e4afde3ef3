"""Hostile WebSocket clients of the page's server are disconnected, and move nothing."""

import asyncio
import contextlib
import re
import signal
import socket
import struct
import urllib.request
from collections.abc import Iterator

import pytest
from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed, InvalidStatus

from gigabrain_schemas.topics import JOINT_TELEOP, TELEOP
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import AVOID, Home
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.page import frames
from tests.system.page import OPERATOR, VIEWER, Robot, client

DRIVE = struct.pack("<4B3f", frames.DRIVE, 0, 0, 0, 0.1, 0.0, 0.0)
REST = struct.pack("<4B3f", frames.DRIVE, 0, 0, 0, 0.0, 0.0, 0.0)
ESTOP = frames.as_json(frames.ASK, {"id": 1, "what": "estop"})


@pytest.fixture(scope="module")
def robot(shared_home: Home) -> Iterator[Robot]:
    robot = Robot(shared_home)
    yield robot
    robot.command.close()


async def first_frame_kind(robot: Robot, token: str = OPERATOR) -> int:
    """Return the kind of the first frame that a new client receives."""
    async with client(robot, token) as socket:
        frame = await asyncio.wait_for(socket.recv(), 20)
        assert isinstance(frame, bytes)
        return frame[0]


async def receive_all(socket: ClientConnection) -> None:
    while True:
        await asyncio.wait_for(socket.recv(), 20)


async def send_endlessly(socket: ClientConnection) -> None:
    while True:
        await socket.send(REST)
        await asyncio.sleep(0)


@pytest.fixture
async def served(robot: Robot) -> None:
    await robot.served()


@pytest.mark.usefixtures("served")
@pytest.mark.parametrize(
    ("token", "frame"),
    [
        (OPERATOR, b""),
        (OPERATOR, b"\xff" * 100),
        (OPERATOR, bytes((frames.ASK,)) + b"{not json"),
        (OPERATOR, frames.as_json(frames.ASK, {"id": 1, "what": "explode"})),
        (OPERATOR, frames.as_json(frames.ASK, {"id": 1, "what": "estop", "more": 1})),
        (OPERATOR, struct.pack("<4B3f", frames.DRIVE, 0, 0, 0, float("nan"), 0.0, 0.0)),
        (OPERATOR, DRIVE[:-1]),
        (OPERATOR, b"x" * 5000),
        (OPERATOR, frames.as_json(frames.JOG, {"speeds": {"pan": "fast"}})),
        (OPERATOR, frames.as_json(frames.JOG, {"speeds": {"pan": 20_000.0}})),
        (VIEWER, DRIVE),
        (VIEWER, frames.as_json(frames.JOG, {"speeds": {"pan": 1.0}})),
        (VIEWER, ESTOP),
    ],
    ids=[
        "empty",
        "noise",
        "json",
        "unknown",
        "more",
        "nan",
        "short",
        "long",
        "jog",
        "racing",
        "looker",
        "jogger",
        "stop",
    ],
)
async def test_a_frame_that_the_page_never_sends_ends_the_connection_and_moves_nothing(
    robot: Robot, token: str, frame: bytes
) -> None:
    async with probing(robot.endpoint) as seen:
        steered: list[object] = []
        for topic in (TELEOP, JOINT_TELEOP):
            seen.bus.subscribe(topic, lambda _key, wanted: steered.append(wanted))
        generation = seen.state.gate.estop_generation
        async with client(robot, token) as socket:
            await socket.send(frame)
            with pytest.raises(ConnectionClosed):
                await receive_all(socket)
        await seen.ticks(10)
        assert steered == []
        assert seen.state.gate.estop_generation == generation
    assert await first_frame_kind(robot) == frames.ABOUT


@pytest.mark.usefixtures("served")
async def test_a_flooding_client_is_disconnected_and_others_are_served(robot: Robot) -> None:
    async with client(robot, VIEWER) as other, client(robot) as flood:
        with pytest.raises(ConnectionClosed):
            await send_endlessly(flood)
        assert await asyncio.wait_for(other.recv(), 20)


@pytest.mark.usefixtures("served")
@pytest.mark.parametrize(
    "begun",
    [
        pytest.param(b"", id="silent"),
        pytest.param(b"GET / HTTP/1.1\r\nHost: ", id="half", marks=pytest.mark.slow),
    ],
)
async def test_browsers_can_connect_beside_silent_connections(robot: Robot, begun: bytes) -> None:
    with contextlib.ExitStack() as stack:
        for _ in range(100):
            silent = socket.create_connection(("127.0.0.1", robot.port), timeout=20)
            stack.enter_context(silent).sendall(begun)
        page = await asyncio.to_thread(urllib.request.urlopen, robot.origin, timeout=20)
        assert page.status == 200
        page.close()
        silent.settimeout(30)
        assert await asyncio.to_thread(silent.recv, 1) == b""  # the last one is closed as well


@pytest.mark.usefixtures("served")
async def test_only_its_own_pages_with_a_token_may_connect(robot: Robot) -> None:
    with pytest.raises(InvalidStatus):
        async with client(robot, origin="http://evil.example"):
            pass
    with pytest.raises(ConnectionClosed) as closed:
        await first_frame_kind(robot, "a guess")
    assert closed.value.rcvd
    assert closed.value.rcvd.code == 4401


@pytest.mark.usefixtures("served")
async def test_a_request_with_another_host_name_is_refused(robot: Robot) -> None:
    """It prevents DNS rebinding, in which another site's name resolves to this address."""
    reader, writer = await asyncio.open_connection("127.0.0.1", robot.port)
    writer.write(b"GET / HTTP/1.1\r\nHost: evil.example\r\nConnection: close\r\n\r\n")
    assert b" 421 " in await reader.readline()
    writer.close()
    await writer.wait_closed()


@pytest.mark.slow
@pytest.mark.usefixtures("served")
async def test_a_viewer_that_never_reads_slows_neither_robot_nor_others(robot: Robot) -> None:
    reader, writer = await asyncio.open_connection("127.0.0.1", robot.port, limit=1024)
    head = (
        f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{robot.port}\r\nOrigin: {robot.origin}\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    )
    login = frames.as_json(frames.LOGIN, frames.Login(token=VIEWER))
    writer.write(head.encode())
    assert b" 101 " in await reader.readline()
    writer.write(bytes((0x82, 0x80 | len(login), 0, 0, 0, 0)) + login)  # masked by zeros
    async with client(robot, VIEWER) as other, probing(robot.endpoint) as seen:
        begin = seen.state.tick
        states = 0
        while states < 50:
            frame = await asyncio.wait_for(other.recv(), 20)
            states += frame[0] == frames.STATE
        assert seen.state.boot != 0
        await until(lambda: seen.state.tick - begin >= 200, "the robot's time advances as well")
    writer.close()


async def test_a_demo_prints_the_address_of_its_page_and_avoids_a_taken_port(
    home: Home,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        demo = home.start(*AVOID, "--headless", "--page", "--port", str(port))
        await until(
            lambda: "operator page: http://127.0.0.1:" in demo.err, "the address of the page"
        )
        address = re.search(r"http://127\.0\.0\.1:(\d+)\n", demo.err)
        assert address
        assert int(address[1]) != port
        reader, writer = await asyncio.open_connection("127.0.0.1", int(address[1]))
        writer.write(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{address[1]}\r\n\r\n".encode())
        assert b" 200 " in await reader.readline()
        writer.close()
        demo.send(signal.SIGINT)
        assert await demo.ended() == 0
