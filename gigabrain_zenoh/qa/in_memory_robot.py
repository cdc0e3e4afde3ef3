"""A robot's nodes in this process, in fake time, with an external plant as its body."""

import asyncio
import functools
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Protocol, Self, TypeVar

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_schemas.base import TICK_NS, Message, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN, Service
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.runtime.replay import Node

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

ANSWER_TIMEOUT_S = 30.0  # wall time: a reply may need work in a thread


class InMemoryRobot:
    """Nodes on a network in memory; the last one publishes the ticks. Use it in `async with`."""

    def __init__(self, nodes: Mapping[str, Node]) -> None:
        self._nodes = nodes
        self._network, self._clock = LocalNetwork(), FakeClock()
        self._running: dict[str, tuple[asyncio.Future[None], Bus]] = {}

    async def __aenter__(self) -> Self:
        self.operator = Bus(self._network.transport(), self._clock, "operator")
        for name, node in self._nodes.items():
            ready, bus = asyncio.Event(), Bus(self._network.transport(), self._clock, name)
            running = asyncio.ensure_future(node(bus, ready.set))
            self._running[name] = running, bus
            waiting = asyncio.ensure_future(ready.wait())
            await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            self._check()
        return self

    async def __aexit__(self, *_: object) -> None:
        for running, bus in reversed(self._running.values()):
            running.cancel()
            await asyncio.wait((running,))
            await bus.close()
        await self.operator.close()

    async def tick(self) -> None:
        """Advance time by 20 ms. Raises the error that ended a node."""
        await self._clock.advance(TICK_NS)
        self._network.sent.clear()
        self._check()

    async def ask(self, service: Service[Q, R], request: Q) -> list[R]:
        """Send a request to the nodes; time does not advance. Raises Refused."""
        return await self.operator.ask(service, request, timeout_s=ANSWER_TIMEOUT_S)

    def _check(self) -> None:
        for running, _ in self._running.values():
            if running.done():
                running.result()


class ExternalPlant(Protocol):
    """A body that is computed outside the driver."""

    def advance(self, velocity: Velocity) -> None:
        """Advance by 20 ms."""
        ...

    def state(self) -> RobotState:
        """Return the body's measured state."""
        ...

    def scan(self) -> LaserScan | None:
        """Return the lidar's scan; None in ticks without one."""
        ...


class ExternalPlantDriver(Driver):
    """Drives an external plant tick by tick."""

    def __init__(self, robot: RobotFile, plant: ExternalPlant) -> None:
        super().__init__(robot, None, Run(folder=Path()))
        self._plant, self._velocity = plant, ZERO

    async def open(self) -> None:
        """Do nothing: there is no connection."""

    async def close(self) -> None:
        """Do nothing: there is no connection."""

    async def stop(self) -> None:
        """Command zero from the next tick on."""
        self._velocity = ZERO

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """Yield ticks by the clock; publish scans between two states, like a real lidar."""
        async for passed in super().ticks(clock):
            for _ in range(passed):
                self._plant.advance(self._velocity)
            yield passed
            await clock.sleep_ns(TICK_NS // 2)
            scan = self._plant.scan()
            if scan:
                self.emit(SCAN, scan)

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Command a velocity from the next tick on."""
        self._velocity = self.bounded(linear_x, linear_y, angular_z)
        return self._velocity

    async def read_state(self) -> RobotState:
        """Return the plant's state."""
        return self._plant.state()


def node_of(body: BodyDescription, plant: ExternalPlant, folder: str) -> Node:
    """Return the driver's process of a body; `folder` holds the gate's saved state."""
    names = BodyDescription.__struct_fields__
    robot = RobotFile(summary="", **{name: getattr(body, name) for name in names})
    config = DriverConfig(body=body.robot_type, resume="auto", state_dir=folder)
    return functools.partial(_run, config, robot, plant)


async def _run(
    config: DriverConfig,
    robot: RobotFile,
    plant: ExternalPlant,
    bus: Bus,
    ready: Callable[[], None],
) -> None:
    await DriverProcess(config, robot, ExternalPlantDriver(robot, plant), bus).run(ready)
