"""Connections to the Foxglove bridge: origins, the limit of 16, and viewers that do not read."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from gigabrain_zenoh.ui.foxglove import access
from gigabrain_zenoh.ui.foxglove.access import Front, hidden_host
from tests.system.foxglove_bridge import Bridge, bridged

HEAD = "GET / HTTP/1.1\r\nHost: 127.0.0.1:8765\r\nUpgrade: websocket\r\n{}\r\n\r\n"


def refusal(*fields: str) -> str:
    return Front(("https://Viewer.example",), ("", 0)).refusal(
        HEAD.format("\r\n".join(fields)).encode()
    )


@pytest.mark.parametrize(
    "origin",
    [
        "http://localhost:8080", "http://127.0.0.1", "https://[::1]:9000", "file://",
        "https://app.foxglove.dev", "https://viewer.example", "HTTPS://VIEWER.example",
    ],
)  # fmt: skip
def test_pages_of_this_machine_and_of_known_viewers_are_admitted(origin: str) -> None:
    assert refusal(f"Origin: {origin}") == ""


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.com", "null", "", "http://localhost.evil.com", "http://127.0.0.1.evil.com",
        "http://app.foxglove.dev", "https://app.foxglove.dev.evil.com", "http://evil.com\x1b[2J",
    ],
)  # fmt: skip
def test_pages_of_other_sites_are_refused(origin: str) -> None:
    assert refusal(f"Origin: {origin}").startswith("403 pages of ")
    assert refusal("Origin: http://localhost", f"oRIGIN:{origin}").startswith("403 ")
    assert "\x1b" not in refusal(f"Origin: {origin}")


def test_programs_without_an_origin_are_admitted_if_they_request_a_websocket() -> None:
    assert refusal() == ""
    no_socket = HEAD.format("").replace("Upgrade: websocket\r\n", "")
    assert Front((), ("", 0)).refusal(no_socket.encode()) == "400 expected a WebSocket"


def test_the_inner_server_has_a_new_random_address_each_time() -> None:
    hosts = {hidden_host() for _ in range(10)}
    assert len(hosts) == 10 or hosts == {"127.0.0.1"}
    assert all(host.startswith("127.") for host in hosts)


class Talker:
    """A server that sends a lot to every connection."""

    def __init__(self) -> None:
        self.there = 0
        self._server: asyncio.Server

    async def start(self) -> int:
        self._server = await asyncio.start_server(self._talk, "127.0.0.1", 0)
        return int(self._server.sockets[0].getsockname()[1])

    async def _talk(self, _reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.there += 1
        with contextlib.suppress(OSError):
            while True:
                writer.write(bytes(100_000))
                await writer.drain()
        self.there -= 1

    def stop(self) -> None:
        self._server.close()


@pytest.fixture
async def talker() -> AsyncIterator[tuple[Talker, int, Front]]:
    made = Talker()
    stands = Front((), ("127.0.0.1", await made.start()))
    yield made, await stands.listen(0), stands
    await stands.close()
    made.stop()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access, "STALL_TIMEOUT_S", 1.0)


async def connect_and_read(port: int) -> tuple[bytes, asyncio.StreamWriter]:
    """Connect as a viewer. Return the first bytes (at most 20), and the writer."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(HEAD.format("X: y").encode())
    return await reader.read(20), writer


@pytest.mark.usefixtures("impatient")
async def test_of_200_viewers_that_do_not_read_16_are_admitted_and_then_cut_off(
    talker: tuple[Talker, int, Front],
) -> None:
    made, port, stands = talker
    received = [await connect_and_read(port) for _ in range(200)]
    starts = [data[:12] for data, _ in received]
    assert set(starts) == {bytes(12), b"HTTP/1.1 503"}
    assert starts[:16] == [bytes(12)] * 16
    assert made.there <= 16
    async with asyncio.timeout(20):
        while stands.viewers or made.there:  # noqa: ASYNC110 - until all are cut off
            await asyncio.sleep(0.01)
    data, writer = await connect_and_read(port)  # a new viewer is admitted
    assert data == bytes(20)
    for _, each in (*received, (b"", writer)):
        each.transport.abort()


@pytest.fixture
async def bridge(tmp_path: Path) -> AsyncIterator[Bridge]:
    async with bridged(tmp_path) as made:
        yield made


async def test_a_web_page_of_another_site_cannot_connect(bridge: Bridge) -> None:
    url = f"ws://127.0.0.1:{bridge.config.port}"
    with pytest.raises(InvalidStatus) as refused:
        async with connect(url, origin="http://evil.com", subprotocols=["foxglove.sdk.v1"]):  # type: ignore[arg-type, list-item]
            pass
    assert refused.value.response.status_code == 403
    async with connect(url, origin="http://localhost:1", subprotocols=["foxglove.sdk.v1"]):  # type: ignore[arg-type, list-item]
        pass


async def test_100_silent_connections_do_not_block_a_viewer(
    talker: tuple[Talker, int, Front],
) -> None:
    _, port, stands = talker
    silent = [await asyncio.open_connection("127.0.0.1", port) for _ in range(100)]
    data, writer = await connect_and_read(port)
    assert data == bytes(20)
    assert len(stands._arriving) <= 64
    for each in (*(each for _, each in silent), writer):
        each.transport.abort()
