"""A body whose way is worked out elsewhere, behind the gate and the driver's own process."""

import functools
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Protocol

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import SCAN
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.runtime.replay import Node


class Plant(Protocol):
    """Whoever works it out."""

    def advance(self, velocity: Velocity) -> None:
        """Go on by 20 ms."""
        ...

    def state(self) -> RobotState:
        """What the body measures of itself now."""
        ...

    def scan(self) -> LaserScan | None:
        """What its lidar sees now; None in ticks without a scan."""
        ...


class Planted(Driver):
    """Hands on what the gate lets through, a tick at a time."""

    def __init__(self, robot: RobotFile, plant: Plant) -> None:
        super().__init__(robot, None, Run(folder=Path()))
        self._plant, self._velocity = plant, ZERO

    async def open(self) -> None:
        """There is nothing to connect to."""

    async def close(self) -> None:
        """There is nothing to let go of."""

    async def stop(self) -> None:
        """Be told zero from the next tick on."""
        self._velocity = ZERO

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """By the clock; a scan comes between two states, as a lidar keeps no step with them."""
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
        """From the next tick on."""
        self._velocity = self.bounded(linear_x, linear_y, angular_z)
        return self._velocity

    async def read_state(self) -> RobotState:
        """As worked out."""
        return self._plant.state()


def node_of(body: BodyDescription, plant: Plant, folder: str) -> Node:
    """The driver's process for a body; what latches its gate is kept in `folder`."""
    names = BodyDescription.__struct_fields__
    robot = RobotFile(summary="", **{name: getattr(body, name) for name in names})
    config = DriverConfig(body=body.robot_type, resume="auto", state_dir=folder)
    return functools.partial(_run, config, robot, plant)


async def _run(
    config: DriverConfig, robot: RobotFile, plant: Plant, bus: Bus, ready: Callable[[], None]
) -> None:
    await DriverProcess(config, robot, Planted(robot, plant), bus).run(ready)
