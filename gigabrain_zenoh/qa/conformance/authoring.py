"""Tools for driver authors: the package of a new driver, and the bytes on a body's line."""

import asyncio
import contextlib
import keyword
import logging
import re
from collections import deque
from collections.abc import Callable, Iterator
from importlib import resources
from pathlib import Path
from string import Template

from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.catalog import known_drivers, robot_files
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import BASE, SCAN, Emulator
from gigabrain_drivers.links import link as links
from gigabrain_drivers.links.frames import describe_command
from gigabrain_schemas.base import Velocity
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.host.files import cannot_write
from gigabrain_zenoh.qa.conformance.driver_checks import link_of

PACKAGE_NAME = re.compile(r"[a-z][a-z0-9_]{0,62}[a-z0-9]")
TEMPLATES = {  # source and target of each file
    "pyproject.toml.txt": "pyproject.toml",
    "readme.md.txt": "README.md",
    "init.py.txt": "${name}_driver/__init__.py",
    "driver.py.txt": "${name}_driver/driver.py",
    "robot.yaml.txt": "${name}_driver/robot.yaml",
    "test_driver.py.txt": "tests/test_driver.py",
}


def write_package(name: str, folder: Path) -> Path:
    """Create the folder gigabrain-NAME and return it.

    Raises ConfigError if it exists, or if the name is taken.
    """
    if not PACKAGE_NAME.fullmatch(name) or keyword.iskeyword(name):
        raise ConfigError(
            f"{name!r}: expected lower-case letters, digits and underscores, such as my_robot; "
            "2 to 64 of them, and not a keyword of Python"
        )
    if name in robot_files() or name in known_drivers():
        raise ConfigError(f"a robot or a driver is called {name!r} already; choose another name")
    if name == "zenoh":
        raise ConfigError("the package gigabrain-zenoh is this one; choose another name")
    path = folder / f"gigabrain-{name.replace('_', '-')}"
    words = {
        "name": name,
        "dashed": name.replace("_", "-"),
        "camel": "".join(part.capitalize() for part in name.split("_")),
    }
    try:
        path.mkdir(parents=True)
        for source, target in TEMPLATES.items():
            text = (resources.files(__package__) / "template" / source).read_text(encoding="utf-8")
            file = path / Template(target).substitute(words)
            file.parent.mkdir(exist_ok=True)
            file.write_text(Template(text).substitute(words), encoding="utf-8")
    except FileExistsError:
        raise ConfigError(f"{path} exists; nothing was written") from None
    except OSError as error:
        raise cannot_write(path, error) from None
    return path


PARTS = (BASE, SCAN)


class _LineLog(logging.Handler):
    """Keeps the frames of one line: the base's, or the lidar's."""

    def __init__(self, driver: Driver, part: str) -> None:
        super().__init__(logging.DEBUG)
        self._base, self._wanted = link_of(driver), part == BASE
        self.lines: deque[str] = deque()
        self.received = False  # True once a frame was received

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one frame."""
        if isinstance(record.args, tuple) and len(record.args) == 2:
            line, text = record.args
            if (line is self._base) is self._wanted:
                self.lines.append(str(text))
                self.received |= str(text).startswith("rx")

    def show(self, print_line: Callable[[str], None]) -> None:
        """Print the frames since the last call."""
        while self.lines:
            print_line(self.lines.popleft())


async def trace_line(
    name: str,
    link: LinkName,
    folder: Path,
    *,
    part: str,
    seconds: float,
    wanted: Velocity,
    print_line: Callable[[str], None],
) -> bool:
    """Command `wanted` for `seconds` and print the frames; return whether any was received.

    `folder` holds the ports of the emulator, which runs in this process. Raises ConfigError.
    """
    if link == "real" and wanted != ZERO:
        raise ConfigError("a real body is not moved without its gate; trace it at speed 0")
    where = Run(folder=folder, link=link, emulator=str(folder))
    async with contextlib.AsyncExitStack() as stack:
        if link == "emulated":
            await stack.enter_async_context(Emulator(name, where))
        robot, driver = catalog.make_driver(name, where)
        if part == SCAN and not driver.options.scan:
            raise ConfigError(f"{robot.robot_type} has no lidar on its own line; trace its {BASE}")
        shown = _LineLog(driver, part)
        stack.enter_context(_logged(shown))
        await stack.enter_async_context(driver)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await _drive_traced(driver, wanted, shown, print_line)
    shown.show(print_line)
    return shown.received


async def _drive_traced(
    driver: Driver, wanted: Velocity, shown: _LineLog, print_line: Callable[[str], None]
) -> None:
    newest = ""
    async for _ in driver.ticks(Clock()):
        await driver.read_state()
        shown.show(print_line)
        if driver.robot.drive_type == "arm":
            await driver.stop()  # holds it
            continue
        sent = await driver.set_base_velocity(wanted.linear_x, wanted.linear_y, wanted.angular_z)
        text = describe_command(wanted, sent)
        if text != newest:
            newest = text
            print_line(text)


@contextlib.contextmanager
def _logged(handler: logging.Handler) -> Iterator[None]:
    """Send the frames of all lines to `handler` alone while the block runs."""
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
