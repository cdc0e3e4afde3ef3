"""Number of browsers at the operator page: an operator replaces a viewer."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from pathlib import Path

import msgspec
import pytest
from starlette.websockets import WebSocket, WebSocketDisconnect

from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.waiting import settle, until
from gigabrain_zenoh.ui.page import frames, sessions
from gigabrain_zenoh.ui.page.access import Access, tokens
from gigabrain_zenoh.ui.page.sessions import Sessions

HOST = "127.0.0.1:8080"


class Socket(WebSocket):
    """A browser's end of a WebSocket, in memory."""

    def __init__(self) -> None:
        scope = {"type": "websocket", "path": "/ws", "query_string": b""}
        scope |= {"headers": [(b"host", HOST.encode()), (b"origin", f"http://{HOST}".encode())]}
        super().__init__(scope, self.receive, self.send)
        self.to_server: asyncio.Queue[bytes] = asyncio.Queue()
        self.received: list[bytes] = []
        self.code = 0
        self.ended = asyncio.Event()

    async def accept(self, *_: object) -> None:  # type: ignore[override]
        pass

    async def receive(self) -> dict[str, bytes]:  # type: ignore[override]
        return {"type": "websocket.receive", "bytes": await self.to_server.get()}  # type: ignore[dict-item]

    async def send_bytes(self, data: bytes) -> None:
        self.received.append(data)

    async def close(self, code: int = 1000, reason: str | None = None) -> None:
        if self.code:
            raise WebSocketDisconnect
        self.code = code


class Page:
    """The sessions of a page that requires a token."""

    def __init__(self, folder: Path) -> None:
        config = PageConfig(login=True, tokens=str(folder / "tokens.json"))
        self.tokens, _ = tokens(folder / "tokens.json")
        self.net = Net()
        self.sessions = Sessions(self.net.one, Access(config, 8080))
        self._talks: list[asyncio.Task[None]] = []

    async def connect(self, token: str = "") -> Socket:
        """Connect a browser. Without a token, it sends nothing."""
        socket = Socket()
        if token:
            socket.to_server.put_nowait(frames.as_json(frames.LOGIN, frames.Login(token=token)))
        self._talks.append(asyncio.ensure_future(self.sessions.talk(socket)))
        for _ in range(3):
            await settle()
        return socket

    async def close(self) -> None:
        for talk in self._talks:
            talk.cancel()
        for talk in self._talks:
            with contextlib.suppress(asyncio.CancelledError):
                await talk


@pytest.fixture
async def page(tmp_path: Path) -> AsyncIterator[Page]:
    page = Page(tmp_path)
    yield page
    await page.close()


async def test_an_operator_replaces_the_oldest_of_20_viewers(page: Page) -> None:
    viewers = [await page.connect(page.tokens.viewer) for _ in range(20)]
    assert [viewer.code for viewer in viewers] == [0] * 16 + [4429] * 4
    operator = await page.connect(page.tokens.operator)
    assert operator.code == 0
    assert operator.received
    assert [viewer.code for viewer in viewers[:3]] == [4429, 0, 0]
    assert len(page.sessions.viewers) == 16
    assert (await page.connect(page.tokens.viewer)).code == 4429  # the page is full again


@pytest.mark.long
async def test_64_operators_are_admitted(page: Page) -> None:
    operators = [await page.connect(page.tokens.operator) for _ in range(65)]
    assert [operator.code for operator in operators] == [0] * 64 + [4429]


async def test_an_operator_is_admitted_beside_200_browsers_without_a_login(page: Page) -> None:
    silent = [await page.connect() for _ in range(200)]
    assert [each.code for each in silent] == [4429] * 136 + [0] * 64
    operator = await page.connect(page.tokens.operator)
    assert (operator.code, len(page.sessions.viewers)) == (0, 1)


async def test_a_browser_that_logs_in_late_is_asked_to_retry_with_its_token(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "LOGIN_TIMEOUT_S", 0.01)
    late = await page.connect()
    await until(lambda: late.code)
    assert late.code == 4429
    wrong = await page.connect("not-a-token-of-this-page")
    await until(lambda: wrong.code)
    assert wrong.code == 4401


TRIANGLE = [[0, 0], [1, 0], [1, 1]]


@pytest.mark.parametrize(
    ("wanted", "text"),
    [
        (
            {"what": "zones", "zones": {"place": {"name": "desk #1", "x": 0, "y": 0}}},
            "zones.place.name: expected a string of letters, digits, spaces, - _ and ., "
            "a letter or digit first",
        ),
        (
            {
                "what": "zones",
                "zones": {
                    "zone": {"name": "z", "kind": "speed", "points": TRIANGLE, "max_speed": 0}
                },
            },
            "zones.zone.max_speed: expected a number >= 0.05",
        ),
        (
            {
                "what": "zones",
                "zones": {"zone": {"name": "z", "kind": "keepout", "points": [[0, 0]] * 300}},
            },
            "zones.zone.points: expected a list of length <= 256",
        ),
        (
            {"what": "set", "process": "driver", "name": "speed_limit", "value": "1" * 501},
            "value: expected a string of length <= 500",
        ),
    ],
    ids=["name", "speed", "corners", "setting"],
)
async def test_a_value_out_of_bounds_is_refused_and_the_browser_stays_connected(
    page: Page, wanted: dict[str, object], text: str
) -> None:
    operator = await page.connect(page.tokens.operator)
    operator.to_server.put_nowait(frames.as_json(frames.ASK, {"id": 3, **wanted}))
    for _ in range(5):
        await settle()
    assert operator.code == 0
    replies = [frame for frame in operator.received if frame[0] == frames.REPLY]
    assert [msgspec.json.decode(reply[1:], type=frames.PageReply) for reply in replies] == [
        frames.PageReply(id=3, what=str(wanted["what"]), ok=False, text=text)
    ]
