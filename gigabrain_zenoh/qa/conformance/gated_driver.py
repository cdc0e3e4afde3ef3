"""A driver in its real process, behind the real gate, on a network inside this program."""

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Any, NamedTuple, Self

import msgspec

from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.process import DriverProcess
from gigabrain_schemas.base import TICK_S, Message, Velocity
from gigabrain_schemas.body import Joint, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import EnableRequest, ReleaseRequest
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.topics import ENABLE, RELEASE, SAFETY, SCAN, STATE, Topic, command_topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import DriverConfig
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.qa.conformance.robot import CheckedRobot, Timeline
from gigabrain_zenoh.qa.judging import Failed


class TappedCall(NamedTuple):
    """One command, as the gate let it through and as the driver sent it."""

    asked: Velocity
    sent: Velocity


class DriverTap(Driver):
    """Between the driver's process and `inner`, which it does not change."""

    def __init__(self, inner: Driver) -> None:
        super().__init__(inner.robot, inner.options, inner.run)
        self.inner, self.lockstep = inner, inner.lockstep
        self.calls: list[TappedCall] = []
        self.speaking = False  # whether a command is on its way through the driver now
        inner.emit = self._hand_on

    async def open(self) -> None:
        """Of the inner one, as all that follows."""
        await self.inner.open()

    async def close(self) -> None:
        """Let go of the body."""
        await self.inner.close()

    async def stop(self) -> None:
        """Bring the body to rest."""
        await self.inner.stop()

    async def hold(self) -> None:
        """Keep the present position."""
        await self.inner.hold()

    async def park(self) -> None:
        """Take up the inner one's posture for being left alone."""
        await self.inner.park()

    async def limp(self) -> None:
        """Let go of the inner one's joints."""
        await self.inner.limp()

    async def read_state(self) -> RobotState:
        """What the body measures."""
        return await self.inner.read_state()

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """The inner one's."""
        async for passed in self.inner.ticks(clock):
            yield passed

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive, and remember it."""
        self.speaking = True
        try:
            sent = await self.inner.set_base_velocity(linear_x, linear_y, angular_z)
        finally:
            self.speaking = False
        asked = Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)
        self.calls.append(TappedCall(asked, sent))
        return sent

    async def set_joint_position(self, joint_name: str, position: float) -> float:
        """Move one joint."""
        return await self.inner.set_joint_position(joint_name, position)

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """All joints as measured."""
        return await self.inner.get_joint_states()

    async def get_sensor_data(self, sensor_name: str) -> Message | None:
        """The newest reading of a sensor."""
        return await self.inner.get_sensor_data(sensor_name)

    def report(self) -> Mapping[str, float | int | str | None]:
        """The inner one's figures."""
        return self.inner.report()

    def _hand_on(self, topic: Topic[Any], message: Message) -> None:
        self.emit(topic, message)


KIT = "kit"  # the commander
ENABLE_TICKS = 250
MOVE_TICKS = 100
SETTLE_TICKS = 15  # of the body, after the ramp of its commands
STEP_TICKS = 30  # of a body that walks
ATTEMPTS = 3  # a machine that stands still for 100 ms has the gate shut
SHARE = 0.5  # of the body's greatest speed, which the checks drive at
MOVING = 0.6  # of the wanted speed, from which the body counts as moving


class GatedDriver(Timeline):
    """Plays the brain and the safety process: a command per state while `wanted` is not None."""

    def __init__(self, robot: CheckedRobot) -> None:
        super().__init__()
        self.checked, self.robot = robot, robot.file
        self.speed = SHARE * self.robot.max_linear_speed
        self.wanted: Velocity | None = None
        self.state: RobotState | None = None
        self.states = self.scans = 0
        self.scan: LaserScan | None = None
        self.tap = DriverTap(robot.driver())
        self.network, clock = LocalNetwork(), Clock()
        self.topic = command_topic(self.robot)
        self._bus = Bus(self.network.transport(), clock, KIT)
        self._bus.subscribe(STATE, self._see)
        self._bus.subscribe(SCAN, self._scanned)
        self._driver_bus = Bus(self.network.transport(), clock, "driver")
        config = DriverConfig(
            body=robot.name, link=robot.link, state_dir=str(robot.folder / "state")
        )
        self._process = DriverProcess(config, self.robot, self.tap, self._driver_bus)
        self._running: asyncio.Task[None] | None = None
        self.last: CmdVel | None = None  # what was commanded last, as it went out

    async def __aenter__(self) -> Self:
        self._running = asyncio.create_task(self._process.run(lambda: None), name="driver process")
        return self

    async def __aexit__(self, *_: object) -> None:
        self.wanted = None
        if self._running:
            self._running.cancel()
            await asyncio.gather(self._running, return_exceptions=True)  # told by `check_alive`
        for bus in (self._bus, self._driver_bus):
            await bus.close()

    def check_alive(self) -> None:
        """Raise what has ended the driver's process."""
        for ended in (self._running, self._driver_bus.failed, self._bus.failed):
            if ended and ended.done():
                ended.result()
                raise Failed("the driver's process has ended")

    @property
    def causes(self) -> list[str]:
        """Why the gate holds the body back, as codes."""
        return [cause.code for cause in self.state.gate.causes] if self.state else []

    @property
    def mode(self) -> str:
        """The gate's."""
        return self.state.gate.mode if self.state else ""

    @property
    def rests(self) -> bool:
        """Whether the body stands still."""
        return self.checked.rests(self.state)

    @property
    def refused(self) -> dict[str, int]:
        """Commands that the gate did not let through, by reason."""
        counters = self._driver_bus.counters
        return {k.removeprefix("refused_"): n for k, n in counters.items() if "refused_" in k}

    def command(self, velocity: Velocity) -> None:
        """One command, as a brain sends it."""
        fields: dict[str, Any] = msgspec.structs.asdict(velocity)
        self.last = self._bus.publish(self.topic, CmdVel(**fields, source=KIT))

    def deliver(self, command: CmdVel | dict[str, Any]) -> None:
        """A command as it is, header and all."""
        self.network.deliver(self.topic.at(), codec.encode(command))

    async def drive(self) -> Velocity:
        """Have the gate opened and the body moving, to and fro in turn.

        Returns the velocity that is commanded from then on.
        """
        wanted = Velocity(linear_x=self.checked.next_direction() * self.speed)
        for _ in range(ATTEMPTS):
            self.wanted = ZERO
            await self._enable()
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

    async def _enable(self) -> None:
        """Release and enable as soon as the gate agrees."""
        why = "no state from the driver"
        begin = self.tick
        while not self.state or self.mode != "enabled" or self.state.gate.commander != KIT:
            if self.state:
                why = await self._ask(self.state)
            if self.tick - begin > ENABLE_TICKS:
                raise Failed(f"the gate did not open: {why}")
            await self.until(lambda: False, 5)

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
        told = self.checked.commanded(self.state)[0]
        measured = self.state.velocity.linear_x if self.state else 0.0
        return min(told / wanted.linear_x, measured / wanted.linear_x) >= MOVING

    def _see(self, _key: str, state: RobotState) -> None:
        self.state, self.tick = state, state.tick
        self.states += 1
        self._bus.time.see(state)
        if self.states % 2:
            self._bus.publish(SAFETY, SafetyState(verdict="ok"))
        if self.wanted is not None:
            self.command(self.wanted)

    def _scanned(self, _key: str, scan: LaserScan) -> None:
        self.scan, self.scans = scan, self.scans + 1


def stop_ticks(gated: GatedDriver, reaction: int) -> int:
    """The most ticks from a cause to standstill: until it is seen, the ramp, and the body's own.

    What walks has to end its step, and to settle.
    """
    ramp = gated.speed / gated.robot.max_linear_deceleration / TICK_S
    own = STEP_TICKS if gated.robot.drive_type == "quadruped" else SETTLE_TICKS
    return reaction + round(ramp + 0.5) + own
