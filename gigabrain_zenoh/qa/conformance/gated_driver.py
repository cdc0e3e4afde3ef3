"""A driver in its real process, behind the real gate, on a network inside this program."""

import asyncio
from collections.abc import Mapping
from typing import Any, Self

import msgspec

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_schemas.base import TICK_S, Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import CmdVel, JointCommand
from gigabrain_schemas.requests import EnableRequest, EstopRequest, ReleaseRequest
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import (
    ENABLE,
    ESTOP,
    JOINT_CMD,
    RELEASE,
    SAFETY,
    SCAN,
    STATE,
    command_topic,
)
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot, Timeline
from gigabrain_zenoh.qa.judging import Failed

KIT = "kit"  # the commander
ENABLE_TICKS = 250
MOVE_TICKS = 100
SETTLE_TICKS = 15  # of the body, after the ramp of its commands
STEP_TICKS = 30  # of a walking body
ATTEMPTS = 3  # because the gate shuts when the machine stalls for 100 ms
SPEED_SHARE = 0.5  # of the body's greatest speed
MOVING = 0.6  # least share of the wanted speed of a moving body


class DriverTap:
    """Records the velocities that the gate lets through to a driver.

    It wraps the driver's `set_base_velocity`.
    """

    def __init__(self, driver: Driver) -> None:
        self.driver = driver
        self.asked: list[Velocity] = []
        self.sending = False  # while a command passes through the driver
        self._set_base_velocity = driver.set_base_velocity
        driver.set_base_velocity = self._recorded  # type: ignore[method-assign]

    async def _recorded(self, linear_x: float, linear_y: float, angular_z: float) -> Velocity:
        self.asked.append(Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z))
        self.sending = True
        try:
            return await self._set_base_velocity(linear_x, linear_y, angular_z)
        finally:
            self.sending = False


class GatedDriver(Timeline):
    """Plays the brain and the safety process.

    It commands once per state while `wanted` is not None, and joints while there are
    `joint_speeds`.
    """

    def __init__(self, robot: CheckedRobot) -> None:
        super().__init__()
        self.checked, self.robot = robot, robot.file
        self.speed = SPEED_SHARE * self.robot.max_linear_speed
        self.wanted: Velocity | None = None
        self.joint_speeds: Mapping[str, float] = {}  # [rad/s] or [m/s]
        self.state: RobotState | None = None
        self.states = self.scans = 0
        self.scan: LaserScan | None = None
        self.tap = DriverTap(robot.driver())
        self.network, clock = LocalNetwork(), Clock()
        self.topic = command_topic(self.robot)
        self._bus = Bus(self.network.transport(), clock, KIT)
        self._bus.subscribe(STATE, self._on_state)
        self._bus.subscribe(SCAN, self._on_scan)
        self._driver_bus = Bus(self.network.transport(), clock, "driver")
        config = DriverConfig(
            body=robot.name, link=robot.link, state_dir=str(robot.folder / "state")
        )
        self._process = DriverProcess(config, self.robot, self.tap.driver, self._driver_bus)
        self._running: asyncio.Task[None] | None = None
        self.last: CmdVel | None = None  # newest command, as it was published

    async def __aenter__(self) -> Self:
        self._running = asyncio.create_task(self._process.run(lambda: None), name="driver process")
        return self

    async def __aexit__(self, *_: object) -> None:
        self.wanted = None
        if self._running:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)  # `check_alive` raises them
        for bus in (self._bus, self._driver_bus):
            await bus.close()

    def check_alive(self) -> None:
        """Raise the error that ended the driver's process."""
        for ended in (self._running, self._driver_bus.failed, self._bus.failed):
            if ended and ended.done():
                ended.result()
                raise Failed("the driver's process has ended")

    @property
    def causes(self) -> list[str]:
        """Codes of the causes for which the gate is shut."""
        return [cause.code for cause in self.state.gate.causes] if self.state else []

    @property
    def mode(self) -> str:
        """The gate's mode."""
        return self.state.gate.mode if self.state else ""

    @property
    def rests(self) -> bool:
        """True while the body stands still."""
        return self.checked.rests(self.state)

    @property
    def refused(self) -> dict[str, int]:
        """Number of commands that the gate refused, by reason."""
        counters = self._driver_bus.counters
        return {k.removeprefix("refused_"): n for k, n in counters.items() if "refused_" in k}

    def command(self, velocity: Velocity) -> None:
        """Publish a command as a brain does."""
        fields: dict[str, Any] = msgspec.structs.asdict(velocity)
        self.last = self._bus.publish(self.topic, CmdVel(**fields, source=KIT))

    def deliver(self, command: CmdVel | dict[str, Any]) -> None:
        """Deliver a command with its own header."""
        self.network.deliver(self.topic.at(), codec.encode(command))

    async def drive(self) -> Velocity:
        """Open the gate and drive, forward and backward in turn; return the commanded velocity."""
        wanted = Velocity(linear_x=self.checked.next_direction() * self.speed)
        for _ in range(ATTEMPTS):
            self.wanted = ZERO
            await self.enable()
            self.wanted = wanted
            if await self.until(lambda: self._moves(wanted), MOVE_TICKS) is not None:
                return wanted
            if self.mode == "enabled":
                break
        raise Failed(f"the body did not move; gate {self.mode}: {', '.join(self.causes)}")

    async def pause(self) -> None:
        """Command zero until the body stands."""
        self.wanted = ZERO
        if await self.until(lambda: self.rests, MOVE_TICKS) is None:
            raise Failed("the body did not come to rest on commands of zero")

    async def press_estop(self) -> None:
        """Press the e-stop."""
        await self._bus.ask(ESTOP, EstopRequest(source=KIT))

    async def enable(self) -> None:
        """Release and enable as soon as the gate allows it."""
        why = "no state from the driver"
        begin = self.tick
        while not self.state or self.mode != "enabled" or self.state.gate.commander != KIT:
            if self.state:
                why = await self._ask(self.state)
            if self.tick - begin > ENABLE_TICKS:
                raise Failed(f"the gate did not open: {why}")
            await self.run_for(5)

    async def _ask(self, state: RobotState) -> str:
        try:
            if state.gate.mode == "latched":
                generation = state.gate.estop_generation
                release = ReleaseRequest(estop_generation=generation, source=KIT)
                replies = await self._bus.ask(RELEASE, release)
            else:
                replies = await self._bus.ask(ENABLE, EnableRequest(source=KIT, take=True))
        except Refused as error:
            return str(error)
        return replies[0].text if replies else "the driver does not answer"

    def _moves(self, wanted: Velocity) -> bool:
        commanded = self.checked.commanded(self.state)[0]
        measured = self.state.velocity.linear_x if self.state else 0.0
        return min(commanded / wanted.linear_x, measured / wanted.linear_x) >= MOVING

    def _on_state(self, _key: str, state: RobotState) -> None:
        self.state, self.tick = state, state.tick
        self.states += 1
        self._bus.time.observe(state)
        if self.states % 2:
            self._bus.publish(SAFETY, SafetyState(verdict="ok"))
        if self.wanted is not None:
            self.command(self.wanted)
        if self.joint_speeds:
            names, speeds = zip(*self.joint_speeds.items(), strict=True)
            command = JointCommand(name=names, velocity=speeds, source=KIT)
            self._bus.publish(JOINT_CMD, command, basis=state.tick)

    def _on_scan(self, _key: str, scan: LaserScan) -> None:
        self.scan, self.scans = scan, self.scans + 1


def stop_ticks(gated: GatedDriver, reaction: int) -> int:
    """Return the ticks within which the body must stand still, `reaction` included.

    They are the gate's reaction, its ramp and the body's own lag. A leg ends its step first.
    """
    ramp = gated.speed / gated.robot.max_linear_deceleration / TICK_S
    own = STEP_TICKS if gated.robot.drive_type == "quadruped" else SETTLE_TICKS
    return reaction + round(ramp + 0.5) + own
