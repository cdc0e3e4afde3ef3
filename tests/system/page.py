"""A robot with an operator page, a browser that shows it, and a plain WebSocket client."""

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
# no sandbox, no GPU, no QUIC, no first-run page; the rest keep it from using the network
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
    """A simulated robot whose page requires a token."""

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
        """Wait until its page is served."""
        await until(lambda: listens(self.port), "the page is served")


class Served(Protocol):
    """A robot, real or fake, with a page."""

    @property
    def origin(self) -> str: ...


class Browser:
    """One Chromium. Its faults are errors of its pages, and requests to other machines."""

    def __init__(self, context: BrowserContext, robot: Served) -> None:
        self._context, self._robot = context, robot
        self.faults: list[str] = []

    async def open(
        self, token: str = OPERATOR, *, width: int = 1280, height: int = 800, before: str = ""
    ) -> Page:
        """Open a page and wait for its connection; the script `before` runs before its own."""
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
        """Let the next request for a file of the page fail."""
        await self._context.route(f"**/{file}", lambda route: route.abort(), times=1)

    async def close_pages(self) -> None:
        """Close all pages that a test opened."""
        for page in self._context.pages[1:]:  # the browser ends with its last page
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
            ignore_https_errors=robot.origin.startswith("https"),  # the certificate is self-signed
        )
        try:
            chromium = Browser(context, robot)
            yield chromium
            assert chromium.faults == []
        finally:
            await context.close()


@contextlib.asynccontextmanager
async def client(
    robot: Robot, token: str = OPERATOR, origin: str | None = None
) -> AsyncIterator[ClientConnection]:
    """Connect a WebSocket without a browser, and log in."""
    url = f"ws://127.0.0.1:{robot.port}/ws"
    async with connect(url, origin=origin or robot.origin, max_queue=None) as socket:  # type: ignore[arg-type]
        await socket.send(frames.as_json(frames.LOGIN, frames.Login(token=token)))
        yield socket
