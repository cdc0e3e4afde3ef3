"""A body on an emulated serial line, moved by kinematics alone."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from gigabrain_drivers.bodies.line.driver import LineDriver
from gigabrain_drivers.bodies.line.emulator import LineBase
from gigabrain_drivers.driver import catalog
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.emulators.base import Snapshot
from gigabrain_drivers.emulators.emulator import Station
from gigabrain_drivers.emulators.faults import NO_FAULTS
from gigabrain_drivers.kinematics.wheels import Twist, advance_pose, wheels_of
from gigabrain_drivers.sim.locomotion import Charge, Motor, OdometryReading
from gigabrain_drivers.sim.sensors import ImuSample
from gigabrain_schemas.base import TICK_S, Pose
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.testing.waiting import PATIENCE_S, until

BARE = """\
summary: a base for tests
robot_type: tested
drive_type: differential
wheel_separation: 0.5
wheel_radius: 0.08
max_linear_speed: 0.4
max_angular_speed: 1.2
footprint: [[0.2, 0.3], [-0.2, 0.3], [-0.2, -0.3], [0.2, -0.3]]
real:
  driver: line
  port: "{port}"
  command: "V,{linear_x:.3f},{angular_z:.3f}\\n"
  state: ["S,{wheel_left_position|tick},{wheel_right_position|tick},{flags:02x}*{crc16}\\n"]
  ticks_per_turn: 4096
  flags: [watchdog, estop, bumper_left, bumper_right]
"""


class IdealBody:
    """A body that has its commanded speed at once, in real time."""

    def __init__(self, robot: RobotFile) -> None:
        self.robot, self.bumper = robot, False
        self._base = wheels_of(robot)
        self._pose, self._yaw = Pose(x=0.0, y=0.0, yaw=0.0), 0.0
        self._angles = [0.0] * (len(self._base.wheels) if self._base else 0)
        self.commanded = (0.0, 0.0, 0.0)
        self._updated_ns = Clock().now_ns()

    def command(self, linear_x: float, linear_y: float, angular_z: float) -> None:
        """Set its velocity [m/s], [rad/s]."""
        self._advance()
        self.commanded = (linear_x, linear_y, angular_z)

    @property
    def snapshot(self) -> Snapshot:
        """Its state now."""
        self._advance()
        x, _, turn = self.commanded
        names = self._base.wheels if self._base else ()
        speeds = self._base.to_wheels(Twist(*self.commanded)) if self._base else ()
        wheels = zip(names, self._angles, speeds, strict=True)
        return Snapshot(
            time_ns=self._updated_ns,
            odometry=OdometryReading(self._pose.x, self._pose.y, self._yaw, x, turn),
            wheels=tuple(Motor(f"wheel_{n}_joint", a, s, 0.0, 30.0) for n, a, s in wheels),
            imu=ImuSample((0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81)),
            battery=Charge(12.0, 80.0, 0.5),
            bumper=self.bumper,
        )

    def _advance(self) -> None:
        now_ns = Clock().now_ns()
        seconds, self._updated_ns = (now_ns - self._updated_ns) / 1e9, now_ns
        step = Twist(*(part * seconds for part in self.commanded))
        self._pose = advance_pose(self._pose, step)
        self._yaw += step.angular_z
        if self._base:
            for i, angle in enumerate(self._base.to_wheels(step)):
                self._angles[i] += angle


class EmulatedLine:
    """A line driver and emulated firmware, joined by a pty."""

    def __init__(self, folder: Path, text: str = BARE) -> None:
        port = folder / "base"
        (folder / "robot.yaml").write_text(text.replace("{port}", str(port)))
        run = Run(folder=folder, link="real")
        self.robot, driver = catalog.make_driver(str(folder / "robot.yaml"), run)
        assert isinstance(driver, LineDriver)
        self.driver: LineDriver = driver
        self.body: Any = IdealBody(self.robot)
        options = driver.options
        self.station = Station(
            lambda wire: LineBase(self.body, options, wire), LineBase.port(options), Clock()
        )

    @property
    def firmware(self) -> LineBase:
        """The emulated firmware."""
        device = self.station.device
        assert isinstance(device, LineBase)
        return device

    async def connected(self) -> bool:
        """Return whether the driver has a link."""
        return (await self.driver.read_state()).link.connected

    async def until_connected(self, wanted: bool = True) -> None:
        """Wait until the driver has a link, or has none if not `wanted`."""
        async with asyncio.timeout(PATIENCE_S):
            while await self.connected() is not wanted:  # noqa: ASYNC110
                await asyncio.sleep(0.002)

    async def drive_until(
        self, condition: Callable[[RobotState], object], *velocity: float
    ) -> None:
        """Command a velocity until the reported state fulfils `condition`."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition(await self.driver.read_state()):
                await self.drive(0.02, *velocity)

    async def reported(self, condition: Callable[[RobotState], object]) -> RobotState:
        """Return the first reported state that fulfils `condition`."""
        async with asyncio.timeout(PATIENCE_S):
            while not condition(state := await self.driver.read_state()):  # noqa: ASYNC110
                await asyncio.sleep(0.005)
        return state

    async def at_rest(self) -> RobotState:
        """Wait until the body rests and its odometry is reported; return that state."""
        await until(lambda: self.body.commanded == (0.0, 0.0, 0.0))
        actual = self.body.snapshot.odometry
        return await self.reported(
            lambda state: math.hypot(state.pose.x - actual.x, state.pose.y - actual.y) < 0.002
        )

    async def drive(self, seconds: float, linear_x: float, angular_z: float = 0.0) -> None:
        """Command a velocity every 20 ms, as the driver's process does."""
        for _ in range(math.ceil(seconds / TICK_S)):
            await self.driver.set_base_velocity(linear_x, 0.0, angular_z)
            await asyncio.sleep(0.02)


@asynccontextmanager
async def bench(
    folder: Path, text: str = BARE, plugged: bool = True
) -> AsyncIterator[EmulatedLine]:
    """Start driver and firmware, and wait until they are connected unless not `plugged`."""
    line = EmulatedLine(folder, text)
    line.station.start()
    if not plugged:
        line.station.set(type(NO_FAULTS)(unplugged=True))
    try:
        async with line.driver:
            if plugged:
                await line.until_connected()
            yield line
    finally:
        await line.station.close()
