"""Web server of the page: a process of its own, for which the robot never waits."""

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
from uvicorn.protocols.http.h11_impl import H11Protocol

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.ui.page.access import Access, check, token_file, wants_login
from gigabrain_zenoh.ui.page.sessions import Sessions

log = logging.getLogger(__name__)

STATIC = Path(__file__).parent / "static"
MAX_CONNECTIONS = 512  # of all kinds
MAX_SILENT = 64  # connections without a request; a new one replaces the oldest
MAX_FRAME_BYTES = 16_384  # from a browser: a zone with all its corners
REQUEST_TIMEOUT_S = 5.0
FRAME_INTERVAL_NS = 100_000_000
HEADERS = {
    b"content-security-policy": b"default-src 'self'; connect-src 'self'; img-src 'self' blob: "
    b"data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    b"x-content-type-options": b"nosniff",
    b"referrer-policy": b"no-referrer",
    b"cache-control": b"no-cache",
}


class ImpatientProtocol(H11Protocol):
    """HTTP that closes connections without a request, so that browsers can always connect."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Watch a new connection; close the oldest silent one if there are too many."""
        super().connection_made(transport)
        self._opened_s = self.loop.time()
        self._timer = self.loop.call_later(REQUEST_TIMEOUT_S, self._check)
        silent = [c for c in self.connections if isinstance(c, ImpatientProtocol) and c.silent]
        if len(silent) > MAX_SILENT:
            min(silent, key=lambda connection: connection._opened_s).transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop watching."""
        self._timer.cancel()
        super().connection_lost(exc)

    @property
    def silent(self) -> bool:
        """Return whether no request is under way."""
        return not self.transport.is_closing() and (
            self.cycle is None or self.cycle.response_complete
        )

    def _check(self) -> None:
        if self.transport.get_protocol() is not self:
            return  # it is a WebSocket now, and its login has its own timeout
        if self.silent:
            self.transport.close()
        self._timer = self.loop.call_later(REQUEST_TIMEOUT_S, self._check)


class GuardedApp:
    """Answers only requests for the page's own names, and adds security headers."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] == "http" and not self._access.named(Headers(scope=scope)):
            text = "unknown name or port of this page; add a name with --name, and keep the port\n"
            response = PlainTextResponse(text, 421)
            await response(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *HEADERS.items()]
            await send(message)

        await self._app(scope, receive, send_guarded)


class _Server(uvicorn.Server):
    """Uvicorn without signal handlers: the process has its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


def listen(config: PageConfig) -> socket.socket:
    """Open the page's socket. Raises ConfigError."""
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
    with listen(config) as listener:
        access = Access(config, listener.getsockname()[1])
        sessions = Sessions(bus, access)
        server = _server(config, access, sessions)
        serving = asyncio.ensure_future(server.serve(sockets=[listener]))
        sending = asyncio.ensure_future(_send_frames(bus, sessions))
        _announce(config, access, listener.getsockname()[1])
        ready()
        try:
            ends = (serving, sending, bus.failed)
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
        finally:
            sending.cancel()
            sessions.close()
            server.should_exit = True
            await serving
        for end in (sending, bus.failed):
            if end.done() and not end.cancelled():
                end.result()


def _announce(config: PageConfig, access: Access, port: int) -> None:
    scheme = "https" if config.certificate else "http"
    host = f"[{config.listen}]" if ":" in config.listen else config.listen
    log.info("operator page at %s://%s:%d", scheme, host, port)
    if wants_login(config):
        log.info("its tokens are in %s", token_file(config.tokens))
    if config.tell_tokens and access.tokens_are_new:
        print(access.new_tokens_text(), flush=True)


def _server(config: PageConfig, access: Access, sessions: Sessions) -> _Server:
    files = StaticFiles(directory=STATIC, html=True)
    routes = [WebSocketRoute("/ws", sessions.talk), Mount("/", files)]
    return _Server(
        uvicorn.Config(
            GuardedApp(Starlette(routes=routes), access),
            log_config=None,
            log_level="warning",
            access_log=False,
            lifespan="off",
            http=ImpatientProtocol,
            ws="websockets-sansio",
            ws_max_size=MAX_FRAME_BYTES,
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=1,
            limit_concurrency=MAX_CONNECTIONS,
            server_header=False,
            ssl_certfile=config.certificate or None,
            ssl_keyfile=config.certificate_key or None,
        )
    )


async def _send_frames(bus: Bus, sessions: Sessions) -> None:
    numbers = itertools.count()
    async for _ in bus.clock.every(FRAME_INTERVAL_NS):
        bus.counters["frames"] = next(numbers)
        sessions.send_new_frames()
