"""The page as a process; its libraries are looked for only when it is started."""

from collections.abc import Callable
from importlib.util import find_spec

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import ConfigError

NEEDS = ("starlette", "uvicorn", "websockets")
INSTALL = "the operator page needs more: pip install 'gigabrain-zenoh[page]'"


def installed() -> bool:
    """Whether everything is there that the page needs."""
    return all(find_spec(name) for name in NEEDS)


async def run(config: PageConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve the page until the process ends. Raises ConfigError where it cannot be served."""
    if not installed():
        raise ConfigError(INSTALL)
    from gigabrain_zenoh.ui.page.server import run as serve

    await serve(config, bus, ready)
