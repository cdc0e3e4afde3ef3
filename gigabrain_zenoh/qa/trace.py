"""The bytes on a body's line, both ways, while its driver runs here."""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import BASE, SCAN, Emulator
from gigabrain_drivers.links import link as links
from gigabrain_drivers.links.wording import of_command
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.qa.conformance.subject import link_of

PARTS = (BASE, SCAN)


class _Shown(logging.Handler):
    """Keeps what the lines log, until it is shown: the body's own line, or that of its lidar."""

    def __init__(self, driver: Driver, part: str) -> None:
        super().__init__(logging.DEBUG)
        self._base, self._wanted = link_of(driver), part == BASE
        self.lines: deque[str] = deque()
        self.received = False  # whether anything has come

    def emit(self, record: logging.LogRecord) -> None:
        """One frame."""
        if isinstance(record.args, tuple) and len(record.args) == 2:
            line, text = record.args
            if (line is self._base) is self._wanted:
                self.lines.append(str(text))
                self.received |= str(text).startswith("rx")

    def show(self, say: Callable[[str], None]) -> None:
        """All that has come since the last time."""
        while self.lines:
            say(self.lines.popleft())


async def run(
    name: str,
    link: LinkName,
    folder: Path,
    *,
    part: str,
    seconds: float,
    wanted: Velocity,
    say: Callable[[str], None],
) -> bool:
    """Open the driver and command `wanted` for so long; whether anything was received.

    Raises ConfigError.
    `folder` is for the ports of the emulator, which runs here as well where the link is emulated.
    """
    if link == "real" and wanted != ZERO:
        raise ConfigError("a real body is not moved without its gate; trace it at speed 0")
    where = Run(folder=folder, link=link, emulator=str(folder))
    async with contextlib.AsyncExitStack() as stack:
        if link == "emulated":
            await stack.enter_async_context(Emulator(name, where))
        _, driver = catalog.make_driver(name, where)
        shown = _Shown(driver, part)
        stack.enter_context(_logged(shown))
        await stack.enter_async_context(driver)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await _drive(driver, wanted, shown, say)
    shown.show(say)
    return shown.received


async def _drive(
    driver: Driver, wanted: Velocity, shown: _Shown, say: Callable[[str], None]
) -> None:
    told = ""
    async for _ in driver.ticks(Clock()):
        await driver.read_state()
        shown.show(say)
        sent = await driver.set_base_velocity(wanted.linear_x, wanted.linear_y, wanted.angular_z)
        text = of_command(wanted, sent)
        if text != told:
            told = text
            say(text)


@contextlib.contextmanager
def _logged(handler: logging.Handler) -> Iterator[None]:
    """Listen to the lines alone, and leave all as it was."""
    before, propagates = links.log.level, links.log.propagate
    links.log.addHandler(handler)
    links.log.setLevel(logging.DEBUG)
    links.log.propagate = False
    try:
        yield
    finally:
        links.log.removeHandler(handler)
        links.log.setLevel(before)
        links.log.propagate = propagates
