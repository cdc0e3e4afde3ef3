"""The bridge as a process; its library is looked for only when it is started."""

from collections.abc import Callable
from importlib.util import find_spec

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.errors import ConfigError

INSTALL = "the bridge to Foxglove needs more: pip install 'gigabrain-zenoh[record]'"


async def run(config: FoxgloveConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve viewers until the process ends. Raises ConfigError where that cannot be."""
    if not find_spec("foxglove"):
        raise ConfigError(INSTALL)
    from gigabrain_zenoh.ui.foxglove.server import run as serve

    await serve(config, bus, ready)
