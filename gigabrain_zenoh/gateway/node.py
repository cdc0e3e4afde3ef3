"""The process `ros2`: the robot as a node of ROS 2.

It imports what the extra `ros2` installs only when it runs; `ros2` says what is missing.
"""

import asyncio
from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Endpoint, Ros2Config
from gigabrain_zenoh.plugins import find

if TYPE_CHECKING:
    from gigabrain_zenoh.ros2.transport import RosTransport
    from gigabrain_zenoh.ros2.types import Types


async def run(config: Ros2Config, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve ROS until the process ends. Raises ConfigError, and BusError without a router."""
    from gigabrain_zenoh.gateway.gateway import serve
    from gigabrain_zenoh.ros2.types import Types

    types = await asyncio.to_thread(Types, [Path(file) for file in config.types])
    async with transport(config, types) as ros:
        await serve(config, bus, ros, types, ready)


def transport(config: Ros2Config, types: "Types") -> AbstractAsyncContextManager["RosTransport"]:
    """Return the transport of the settings, to be opened. Raises ConfigError."""
    if config.transport == "dds":
        make = find("gigabrain_zenoh.ros2.dds:DdsTransport")
        return make(config, types)  # type: ignore[no-any-return]
    from gigabrain_zenoh.ros2.rmw_zenoh import RmwZenohTransport

    endpoint = Endpoint(connect=(config.router,)) if config.router else None
    return RmwZenohTransport(config, types, endpoint)
