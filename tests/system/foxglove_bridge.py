"""A Foxglove bridge in memory, beside a robot whose messages the test publishes."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path

from websockets.asyncio.client import connect

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import Body
from gigabrain_schemas.brain import Twist
from gigabrain_schemas.topics import BODY, TELEOP
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import FoxgloveConfig
from gigabrain_zenoh.testing.processes import free_port
from gigabrain_zenoh.testing.waiting import PATIENCE_S
from gigabrain_zenoh.ui.foxglove.node import run
from tests.system.foxglove_viewer import Viewer


class Bridge:
    """The robot's bus, for the test, and the bridge beside it."""

    def __init__(self, folder: Path) -> None:
        self.config = FoxgloveConfig(port=free_port(), secret=str(folder / "secret"))
        network = self._network = LocalNetwork()
        self.robot = Bus(network.transport(), Clock(), "driver")
        self.bus = Bus(network.transport(), Clock(), "foxglove")
        self.steered: list[Twist] = []
        self.robot.subscribe(TELEOP, lambda _key, twist: self.steered.append(twist))
        body = load_robot("turtlebot3_waffle").description()
        self.robot.publish(BODY, Body(description=body, link="sim"))

    @property
    def patterns(self) -> list[str]:
        """Return the subscribed keys of the bus."""
        return [key for key, _ in self._network._listeners]

    @property
    def turns(self) -> list[float]:
        return [twist.angular_z for twist in self.steered]

    @contextlib.asynccontextmanager
    async def viewer(self) -> AsyncIterator[Viewer]:
        url = f"ws://127.0.0.1:{self.config.port}"
        async with connect(url, subprotocols=["foxglove.sdk.v1"]) as socket:  # type: ignore[list-item]
            yield Viewer(socket)


@contextlib.asynccontextmanager
async def bridged(folder: Path) -> AsyncIterator[Bridge]:
    """Run a bridge; stop it at the end."""
    made, ready = Bridge(folder), asyncio.Event()
    serving = asyncio.ensure_future(run(made.config, made.bus, ready.set))
    await ready.wait()
    yield made
    serving.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await serving


async def hold(
    viewer: Viewer, content: object, done: Callable[[], object], seconds: float = PATIENCE_S
) -> None:
    """Publish `content` repeatedly until `done`, as the Teleop panel does for a held button.

    Raises TimeoutError after `seconds`.
    """
    async with asyncio.timeout(seconds):
        while True:
            await viewer.publish(content)
            await asyncio.sleep(0.04)
            if done():
                return
