"""A robot with an operator page, a browser that looks at it, and a client that misbehaves."""

import contextlib
import shutil
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Protocol

import pytest
from playwright.async_api import BrowserContext, Page, TimeoutError, async_playwright, expect
from websockets.asyncio.client import ClientConnection, connect

from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.launch.deployment import ROBOT
from gigabrain_zenoh.testing.processes import CommandProcess, Home, endpoint_of, free_port, listens
from gigabrain_zenoh.testing.waiting import until
from gigabrain_zenoh.ui.page import frames

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
# the first four as its sandbox, GPU and network are none of ours; the rest keep it from the network
FLAGS = [
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",  # WebGL without a graphics card
]  # fmt: skip
OPERATOR, VIEWER = "operator-token-of-the-tests", "viewer-token-of-the-tests"
TIMEOUT_MS = 60_000
expect.set_options(timeout=TIMEOUT_MS)

needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")


class Robot:
    """A simulated robot whose page wants a token."""

    def __init__(self, home: Home, **values: object) -> None:
        tokens = home.folder / "tokens.json"
        tokens.touch(0o600)
        tokens.write_text(f'{{"operator": "{OPERATOR}", "viewer": "{VIEWER}"}}')
        self.port, self.home = free_port(), home
        page = {"port": self.port, "login": True, "tokens": str(tokens)}
        hosts = {"robot": [*ROBOT, "page"]}
        self.file = home.deployment(resume="auto", hosts=hosts, page=page, **values)
        self.command: CommandProcess = home.start("up", str(self.file))

    @property
    def endpoint(self) -> Endpoint:
        return endpoint_of(self.file)

    @property
    def origin(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    async def served(self) -> None:
        """Wait until its page is there."""
        await until(lambda: listens(self.port), "the page is served")


class Served(Protocol):
    """Whoever serves a page."""

    @property
    def origin(self) -> str: ...


class Browser:
    """One Chromium; nothing that its pages do may fail, nor leave this machine."""

    def __init__(self, context: BrowserContext, robot: Served) -> None:
        self._context, self._robot = context, robot
        self.faults: list[str] = []

    async def open(
        self, token: str = OPERATOR, *, width: int = 1280, height: int = 800, before: str = ""
    ) -> Page:
        """A page that has a connection; `before` is a script that runs ahead of its own."""
        page = await self._context.new_page()
        if before:
            await page.add_init_script(before)
        page.set_default_timeout(TIMEOUT_MS)
        await page.set_viewport_size({"width": width, "height": height})
        page.on("pageerror", lambda error: self.faults.append(str(error)))
        page.on("request", lambda request: self._check(request.url))
        lost: list[str] = []
        page.on("requestfailed", lambda request: lost.append(f"{request.url} {request.failure}"))
        await page.goto(f"{self._robot.origin}/#{token}")
        try:
            await page.wait_for_selector("#link.live")
        except TimeoutError as error:
            error.add_note(f"{self.faults=}, {lost=}, {await page.inner_text('#doing')!r}")
            raise
        return page

    async def lose(self, file: str) -> None:
        """Let the next request for one of the page's files fail."""
        await self._context.route(f"**/{file}", lambda route: route.abort(), times=1)

    async def close_pages(self) -> None:
        """Close what a test has opened; the browser stays."""
        for page in self._context.pages[1:]:  # it ends with its last one
            await page.close()
        assert self.faults == []

    def _check(self, url: str) -> None:
        if not url.startswith((self._robot.origin, "blob:", "data:")):
            self.faults.append(f"asked for {url}")


@contextlib.asynccontextmanager
async def browser(robot: Served, folder: Path) -> AsyncIterator[Browser]:
    async with async_playwright() as playwright:
        context = await playwright.chromium.launch_persistent_context(
            folder,
            executable_path=CHROMIUM,
            headless=True,
            args=FLAGS,
            ignore_https_errors=robot.origin.startswith("https"),  # its certificate is its own
        )
        try:
            made = Browser(context, robot)
            yield made
            assert made.faults == []
        finally:
            await context.close()


@contextlib.asynccontextmanager
async def client(
    robot: Robot, token: str = OPERATOR, origin: str | None = None
) -> AsyncIterator[ClientConnection]:
    """A WebSocket of no browser."""
    url = f"ws://127.0.0.1:{robot.port}/ws"
    async with connect(url, origin=origin or robot.origin, max_queue=None) as socket:  # type: ignore[arg-type]
        await socket.send(frames.as_json(frames.LOGIN, frames.Login(token=token)))
        yield socket
