"""Runs the page as a process, or with a demo; imports its libraries only when it starts."""

import contextlib
from collections.abc import Callable
from importlib.util import find_spec

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.network import reserve_port
from gigabrain_zenoh.ui.page.access import token_file, tokens

LIBRARIES = ("starlette", "uvicorn", "websockets")
INSTALL = "the operator page needs more packages: pip install 'gigabrain-zenoh[page]'"
HOST = "127.0.0.1"


def installed() -> bool:
    """Return whether the page's libraries are installed."""
    return all(find_spec(name) for name in LIBRARIES)


async def run(config: PageConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve the page until the process ends. Raises ConfigError if that is impossible."""
    if not installed():
        raise ConfigError(INSTALL)
    from gigabrain_zenoh.ui.page.server import run as serve

    await serve(config, bus, ready)


def page_address(config: PageConfig) -> str:
    """Return the address of a page on this machine, with the operator's token if it has a login."""
    key = f"/#{tokens(token_file(''))[0].operator}" if config.login else ""
    return f"http://{HOST}:{config.port}{key}"


def free_port(port: int) -> int:
    """Return `port` if it is free, else any free port."""
    for wanted in (port, 0):
        with contextlib.suppress(OSError):
            return reserve_port(HOST, wanted)
    return port
