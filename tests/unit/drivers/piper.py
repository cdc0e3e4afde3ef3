"""A Piper driver with an emulated arm in memory, and time by hand."""

from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import cast

import pytest

from gigabrain_drivers.bodies.piper.driver import PiperDriver, PiperOptions
from gigabrain_drivers.bodies.piper.emulator import STEP_S, Piper
from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.links.can_link import CanDecoder, CanFrame
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.sim.locomotion import Motor
from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.clock import Clock, FakeClock

MS = 1_000_000
ROBOT = load_robot("piper")
OPTIONS = PiperOptions(driver="piper", port="memory")
ARM = [f"joint{number}" for number in range(1, 7)]
STEP_MS = 10


class Cable(Link):
    """A bus in memory. Both ways can be cut."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.to_arm: Callable[[bytes], None] = lambda data: None
        self.sent: list[CanFrame] = []
        self.cut = False  # nothing comes from the arm

    def __str__(self) -> str:
        return "memory"

    def open(self) -> None:
        self.plug()

    def plug(self) -> None:
        self._fd, self.problem = 0, ""
        self.on_open()

    def write(self, data: bytes) -> bool:
        if self._fd is None:
            return False
        self.sent += CanDecoder().feed(data)
        self.to_arm(data)
        return True

    def arrive(self, data: bytes) -> bool:
        if self._fd is not None and not self.cut:
            self.on_bytes(data)
        return True

    def drop(self, reason: str) -> None:
        if self._fd is not None:
            self._fd, self.problem = None, reason
            self.on_lost(reason)

    async def close(self) -> None:
        self.drop("closed")

    async def _connect(self) -> int:
        raise NotImplementedError

    def _shut(self) -> None:
        raise NotImplementedError

    def _cut_short(self) -> None:
        raise NotImplementedError


class Body:
    """The body of the arm: servos reach their targets at once, and gravity acts where none hold."""

    def __init__(self, *angles: float) -> None:
        self.places = dict.fromkeys((*ARM, "gripper"), 0.0) | dict(zip(ARM, angles, strict=False))
        self.speeds = dict.fromkeys(self.places, 0.0)
        self.robot, self.resumed = ROBOT, False

    @property
    def joints(self) -> tuple[Motor, ...]:
        return tuple(
            Motor(name, place, self.speeds[name], 0.5, 32.0) for name, place in self.places.items()
        )

    def aim(self, positions: Mapping[str, float]) -> None:
        ways = {name: place - self.places[name] for name, place in positions.items()}
        self.speeds = {name: way / STEP_S for name, way in ways.items()}
        self.places.update(positions)

    def let_go(self) -> None:
        falling = {name: 0.99 * self.places[name] for name in ("joint2", "joint3")}
        self.aim(self.places | falling)


class Wire:
    def __init__(self, cable: Cable) -> None:
        self._cable = cable

    def write(self, data: bytes) -> bool:
        return self._cable.arrive(data)


class Rig:
    """Driver, cable and arm on one clock that the test moves."""

    def __init__(self, *angles: float) -> None:
        """`angles`: where the arm is at first, from the first joint on [rad]."""
        self.clock = FakeClock()
        self.cable = Cable(self.clock)
        self.body = Body(*angles)
        self.arm = Piper(cast(EmulatedBody, self.body), None, Wire(self.cable))
        self.cable.to_arm = self.arm.feed
        run = Run(folder=Path(), link="real")
        self.driver = PiperDriver(ROBOT, OPTIONS, run, clock=self.clock, link=self.cable)

    @property
    def angles(self) -> list[float]:
        return [self.body.places[name] for name in ARM]

    async def wait(self, milliseconds: int) -> None:
        """The arm's time goes on in its own steps."""
        for _ in range(milliseconds // STEP_MS):
            self.arm.step(self.clock.now_ns())
            await self.clock.advance(STEP_MS * MS)

    async def move(self, milliseconds: int, **positions: float) -> RobotState:
        """As the driver's process does: read, then command."""
        for _ in range(milliseconds // 20):
            state = await self.driver.read_state()
            await self.driver.set_joint_positions(positions)
            await self.wait(20)
        return state

    def frames(self, id_: int) -> list[bytes]:
        return [frame.data for frame in self.cable.sent if frame.id == id_]


@pytest.fixture(name="rig")
async def make_rig() -> AsyncIterator[Rig]:
    """An arm at its rest, all joints at zero."""
    rig = Rig()
    async with rig.driver:
        await rig.wait(400)
        yield rig
