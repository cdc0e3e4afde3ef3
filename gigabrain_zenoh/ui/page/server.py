"""The page's server: a process of its own, which the robot never waits for."""

import asyncio
import contextlib
import itertools
import logging
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.routing import Mount, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ui.page.access import Access, check, token_file, wants_login
from gigabrain_zenoh.ui.page.operator import Operator
from gigabrain_zenoh.ui.page.patience import Impatient
from gigabrain_zenoh.ui.page.scene import Scene
from gigabrain_zenoh.ui.page.sessions import Sessions
from gigabrain_zenoh.ui.seat import Seat

log = logging.getLogger(__name__)

STATIC = Path(__file__).parent / "static"
MOST = 512  # connections of all kinds
FRAME_NS = 100_000_000  # viewers see ten moments a second
HEADERS = {
    b"content-security-policy": b"default-src 'self'; connect-src 'self'; img-src 'self' blob: "
    b"data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cache-control": b"no-cache",
}


class Guarded:
    """Answers only those who ask for the page by its own name, and says what it may load."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] == "http" and not self._access.named(Headers(scope=scope)):
            response = PlainTextResponse("this page goes by another name\n", 421)
            await response(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *HEADERS.items()]
            await send(message)

        await self._app(scope, receive, send_guarded)


class _Server(uvicorn.Server):
    """Uvicorn without signals of its own: the process around it has them."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def listen(config: PageConfig) -> socket.socket:
    """The socket of the page. Raises ConfigError where it cannot be had."""
    family = socket.AF_INET6 if ":" in config.listen else socket.AF_INET
    try:
        return socket.create_server((config.listen, config.port), family=family)
    except OSError as error:
        raise ConfigError(
            f"page: cannot listen on {config.listen} port {config.port}: {error.strerror}; "
            "choose another with --port, or `page: {port: …}` in the deployment file"
        ) from None


async def run(config: PageConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve the page until the process ends. Raises ConfigError."""
    check(config)
    with listen(config) as door:
        port = door.getsockname()[1]
        access = Access(config, port)
        sessions = Sessions(access)
        scene = Scene(bus, sessions.tell)
        sessions.serve(scene, Seat(scene), Operator(bus))
        server = _server(config, access, sessions)
        serving = asyncio.ensure_future(server.serve(sockets=[door]))
        showing = asyncio.ensure_future(_show(bus, scene, sessions))
        scheme = "https" if config.certificate else "http"
        host = f"[{config.listen}]" if ":" in config.listen else config.listen
        log.info("operator page at %s://%s:%d", scheme, host, port)
        if wants_login(config):
            log.info("it wants a token of %s", token_file(config.tokens))
        if config.tell_tokens and access.made:
            print(access.told(), flush=True)
        ready()
        try:
            ends = (serving, showing, bus.failed)
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        finally:
            showing.cancel()
            sessions.close()
            server.should_exit = True
            await serving
        for end in (showing, bus.failed):
            if end.done() and not end.cancelled():
                end.result()


def _server(config: PageConfig, access: Access, sessions: Sessions) -> _Server:
    files = StaticFiles(directory=STATIC, html=True)
    routes = [WebSocketRoute("/ws", sessions.talk), Mount("/", files)]
    return _Server(
        uvicorn.Config(
            Guarded(Starlette(routes=routes), access),
            log_config=None,
            log_level="warning",
            access_log=False,
            lifespan="off",
            http=Impatient,
            ws="websockets-sansio",
            ws_max_size=4096,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            limit_concurrency=MOST,
            server_header=False,
            ssl_certfile=config.certificate or None,
            ssl_keyfile=config.certificate_key or None,
        )
    )


async def _show(bus: Bus, scene: Scene, sessions: Sessions) -> None:
    """Ten times a second, to whoever looks."""
    numbers = itertools.count()
    async for _ in bus.clock.every(FRAME_NS):
        bus.counters["frames"] = next(numbers)
        if sessions.viewers:
            sessions.tell("moment", sessions.moment())
            for slot, frame in scene.news():
                sessions.tell(slot, frame)
