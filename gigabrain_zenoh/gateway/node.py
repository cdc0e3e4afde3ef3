"""The process `ros2`: the robot as a node of ROS 2."""

import asyncio
from collections.abc import Callable

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import Ros2Config


async def run(config: Ros2Config, bus: Bus, ready: Callable[[], None]) -> None:
    """Serve ROS until the process ends. Raises ConfigError, and BusError."""
    # imported here: `ros2` reports missing packages
    from gigabrain_zenoh.gateway.gateway import serve
    from gigabrain_zenoh.ros2.opening import load_types, open_transport

    types = await asyncio.to_thread(load_types, config)
    async with open_transport(config, types) as ros:
        await serve(config, bus, ros, types, ready)
