"""Keeps an arm busy, for faults and benchmarks."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.sim.worlds import mission_file
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import ConfigError

LOOK_S = 0.5  # between two requests of the mission's state


@asynccontextmanager
async def repeated_mission(bus: Bus, body: str) -> AsyncIterator[asyncio.Task[None]]:
    """Let an arm execute the mission of its demo, again and again, during the block.

    The yielded task ends with an error when the robot refuses. Raises ConfigError for a body
    without a mission.
    """
    mission = load_robot(body).demo.mission
    if not mission:
        raise ConfigError(f"{body} has no mission; expected demo: mission in its file")
    tasks, path = Tasks(bus), Path(mission_file(mission, robot_path(body).parent))

    async def repeat() -> None:
        while True:
            if not (await tasks.status()).current:
                await tasks.carry_out(path)
            await asyncio.sleep(LOOK_S)

    repeating = asyncio.create_task(repeat())
    try:
        yield repeating
    finally:
        repeating.cancel()
