"""A TurtleBot3 driver with a board in memory, and time by hand."""

import struct
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import pytest

from gigabrain_drivers.bodies.turtlebot3.driver import OpenCrDriver, OpenCrOptions
from gigabrain_drivers.bodies.turtlebot3.emulator import OpenCr
from gigabrain_drivers.bodies.turtlebot3.protocol import DynamixelDecoder, DynamixelPacket
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.emulator import emulated_body
from gigabrain_drivers.links.link import Link
from gigabrain_schemas.base import Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import Imu
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.clock import Clock, FakeClock

MS = 1_000_000
WAFFLE = load_robot("turtlebot3_waffle")
OPTIONS = OpenCrOptions(driver="opencr", port="memory")


class Cable(Link):
    """A link in memory. Both ways can be cut, or hold back what is sent."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.to_board: Callable[[bytes], None] = lambda data: None
        self.sent: list[DynamixelPacket] = []
        self.held: list[bytes] | None = None  # answers on their way, while they are held back
        self.drops: list[str] = []
        self._decoder = DynamixelDecoder()

    def __str__(self) -> str:
        return "Cable"

    def open(self) -> None:
        self.plug()

    def plug(self) -> None:
        self._fd, self.problem = 0, ""
        self.on_open()

    def write(self, data: bytes) -> bool:
        """To the board."""
        if self._fd is None:
            return False
        self.sent += self._decoder.feed(data)
        self.to_board(data)
        return True

    def arrive(self, data: bytes) -> bool:
        if self.held is None:
            self.on_bytes(data)
        else:
            self.held.append(data)
        return True

    def drop(self, why: str) -> None:
        if self._fd is not None:
            self._fd, self.problem = None, why
            self.drops.append(why)
            self.on_lost(why)

    async def close(self) -> None:
        self.drop("closed")

    async def _connect(self) -> int:
        raise NotImplementedError

    def _shut(self) -> None:
        raise NotImplementedError

    def _cut_short(self) -> None:
        raise NotImplementedError

    def velocities(self) -> list[tuple[int, int]]:
        """Return linear x [0.01 m/s] and angular z [0.01 rad/s] of each write to address 150."""
        goals = [struct.unpack("<6i", p.params[2:]) for p in self.sent if p.params[:2] == b"\x96\0"]
        return [(goal[0], goal[5]) for goal in goals]


class Wire:
    def __init__(self, cable: Cable) -> None:
        self._cable = cable

    def write(self, data: bytes) -> bool:
        return self._cable.arrive(data)


class Rig:
    """Driver, cable and board on one clock that the test moves."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.cable = Cable(self.clock)
        self.body = emulated_body("turtlebot3_waffle", Run(folder=Path()))
        self.board = OpenCr(self.body, None, Wire(self.cable))
        self.cable.to_board = self.board.feed
        run = Run(folder=Path(), link="real")
        self.driver = OpenCrDriver(WAFFLE, OPTIONS, run, clock=self.clock, link=self.cable)
        self.published: list[tuple[Topic[Imu], Message]] = []
        self.driver.emit = lambda topic, message: self.published.append((topic, message))

    async def wait(self, milliseconds: int) -> None:
        """The board's time goes on in its own steps."""
        for _ in range(milliseconds // 20):
            self.board.step(self.clock.now_ns())
            await self.clock.advance(20 * MS)

    async def drive(self, forward: float, turn: float, milliseconds: int) -> RobotState:
        """As the driver's process does: read, then command."""
        for _ in range(milliseconds // 20):
            state = await self.driver.read_state()
            await self.driver.set_base_velocity(forward, 0.0, turn)
            await self.wait(20)
        return state


@pytest.fixture(name="rig")
async def make_rig() -> AsyncIterator[Rig]:
    rig = Rig()
    async with rig.driver:
        await rig.wait(40)
        yield rig
