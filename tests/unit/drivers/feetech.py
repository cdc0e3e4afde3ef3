"""An SO-101's driver on an emulated servo bus in memory, and time by hand."""

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar, cast

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.driver import FeetechDriver, FeetechOptions
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder, FeetechPacket
from gigabrain_drivers.bodies.feetech.servo import FreeJoint, ServoModel
from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.links.link import Link
from gigabrain_zenoh.clock import Clock, FakeClock

T = TypeVar("T")
MS = 1_000_000
STEP_MS = 10
RUN = Run(folder=Path(), link="emulated", emulator="memory")
ROBOT, _, _OPTIONS, FOLDER = load_link("so101", RUN)
assert isinstance(_OPTIONS, FeetechOptions)
OPTIONS = _OPTIONS
NAMES = [joint.name for joint in ROBOT.joints]


class MemoryLink(Link):
    """A link in memory; what the arm answers arrives at once."""

    def __init__(self, clock: Clock) -> None:
        super().__init__(clock)
        self.to_arm: Callable[[bytes], None] = lambda data: None
        self.disturb: Callable[[bytes], bytes] = lambda data: data  # of the answers
        self.disturb_sent: Callable[[bytes], bytes] = lambda data: data
        self.sent: list[FeetechPacket] = []
        self._decoder = FeetechDecoder()

    def __str__(self) -> str:
        return "memory"

    def open(self) -> None:
        self._fd, self.problem = 0, ""

    def write(self, data: bytes) -> bool:
        if self._fd is None:
            return False
        self.sent += self._decoder.feed(data)
        self.to_arm(self.disturb_sent(data))
        return True

    def arrive(self, data: bytes) -> bool:
        if data := self.disturb(data):
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


class Rig:
    """Driver, line and arm on one clock that the test moves."""

    def __init__(self, **changes: Any) -> None:
        self.clock = FakeClock()
        self.link = MemoryLink(self.clock)
        body = cast(EmulatedBody, SimpleNamespace(robot=ROBOT, run=Run(folder=FOLDER)))
        wire = SimpleNamespace(write=self.link.arrive)
        self.arm = FeetechArm(body, OPTIONS, wire)
        self.link.to_arm = self.arm.feed
        self.driver = self.another_driver(**changes)
        self.arm.reset()

    def another_driver(self, **changes: Any) -> FeetechDriver:
        options = FeetechOptions(
            **{
                "driver": "feetech",
                "port": "memory",
                "servos": OPTIONS.servos,
                "calibration": OPTIONS.calibration,
                **changes,
            }
        )
        run = Run(folder=FOLDER, link="emulated")
        return FeetechDriver(ROBOT, options, run, clock=self.clock, link=self.link)

    def servo(self, name: str) -> ServoModel:
        return self.arm.servos[name]

    def joint(self, name: str) -> FreeJoint:
        return self.arm.joints[name]

    def positions(self) -> dict[str, float]:
        return {name: joint.position for name, joint in self.arm.joints.items()}

    async def wait(self, milliseconds: int) -> None:
        for _ in range(milliseconds // STEP_MS):
            self.arm.step(self.clock.now_ns())
            await self.clock.advance(STEP_MS * MS)

    async def during(self, call: Coroutine[None, None, T]) -> T:
        """Let time pass until the call ends."""
        running = asyncio.ensure_future(call)
        for _ in range(1000):
            await asyncio.sleep(0)
            if running.done():
                break
            await self.wait(STEP_MS)
        return await running

    async def go(self, milliseconds: int, **positions: float) -> None:
        """Command as the driver's process does, every 20 ms."""
        for _ in range(milliseconds // 20):
            await self.driver.read_state()
            await self.during(self.driver.set_joint_positions(positions))
            await self.wait(20)

    def written(self) -> list[FeetechPacket]:
        """Return all instructions that write."""
        kinds = (feetech.WRITE, feetech.SYNC_WRITE, feetech.REG_WRITE)
        return [packet for packet in self.link.sent if packet.instruction in kinds]


@asynccontextmanager
async def opened(rig: Rig) -> AsyncIterator[Rig]:
    """Open the driver; at the end close it, while time passes."""
    await rig.during(rig.driver.open())
    await rig.wait(20)
    try:
        yield rig
    finally:
        await rig.during(rig.driver.close())
