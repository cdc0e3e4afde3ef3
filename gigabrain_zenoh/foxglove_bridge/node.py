"""The bridge as a process; its library is looked for only when it is started."""

from collections.abc import Callable
from importlib.util import find_spec

from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.settings import FoxgloveConfig

INSTALL = "the bridge to Foxglove needs more: pip install 'gigabrain-zenoh[record]'"


async def run(config: FoxgloveConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve viewers until the process ends. Raises ConfigError where that cannot be."""
    if not find_spec("foxglove"):
        raise ConfigError(INSTALL)
    from gigabrain_zenoh.foxglove_bridge.server import run as serve

    await serve(config, bus, ready)
