"""A commander of a body: its lease, and the commands that it repeats with each state."""

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator

from msgspec.structs import asdict

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.topics import BODY, JOINT_CMD, STATE, command_topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import arrival
from gigabrain_zenoh.client.arm import JointStream
from gigabrain_zenoh.client.lease import ControlLease
from gigabrain_zenoh.client.requests import ANSWER_S, enable, press_estop, release, still_open
from gigabrain_zenoh.errors import BodyLost, NotConfirmed, Refused, StillStopping
from gigabrain_zenoh.gate.gate import STILL_TICKS
from gigabrain_zenoh.geometry.limits import ZERO, at_rest
from gigabrain_zenoh.security.identity_files import may_not_ask

HOLD_TICKS = 50  # a requested velocity lasts one second of the robot's time
REST_TICKS = 150  # timeout for a body to come to rest before a release
BODY_TICKS = 100  # timeout for `robot/body`, which is published once a second


class Commander:
    """Asks the gate for a body, and repeats the newest command with each state."""

    def __init__(self, bus: Bus, *, take: bool = False, keys: str = "") -> None:
        self._given_bus, self._take, self._keys = bus, take, keys
        self._states = bus.latest(STATE, self._repeat)
        self._bodies = bus.latest(BODY)
        self._target: Velocity | None = None
        self._until_tick = self._boot = 0
        self._joints: JointStream | None = None  # after the first command for joints
        self._pressed = 0  # the number of this script's newest e-stop
        self._lease = ControlLease(bus.process)
        self._arrived = asyncio.Event()

    @property
    def _bus(self) -> Bus:
        """The bus. Raises BusError once it is closed."""
        return still_open(self._given_bus)

    @property
    def state(self) -> RobotState | None:
        """The newest state; None while the robot is silent."""
        return self._states.fresh()

    async def read_state(self) -> RobotState:
        """Return the newest state. Raises BodyLost if none arrives within a second."""
        still_open(self._given_bus)
        if self._states.fresh() is None:
            await self._wait_ticks(1)
        state = self._states.fresh()
        if state is None:
            raise BodyLost("no robot/state; is the driver running?")
        return state

    async def read_body(self) -> BodyDescription:
        """Return the body's description: limits, footprint, sensors. Raises BodyLost."""
        still_open(self._given_bus)
        for _ in range(BODY_TICKS):
            if body := self._bodies.current:
                return body.description
            await self._wait_ticks(1)
        raise BodyLost("no robot/body; is the driver running?")

    async def enable(self, source: str = "", *, take: bool = False) -> GateReply:
        """Ask the gate for the body, for this script or for `source`, once it no longer brakes.

        Raises Refused and BodyLost.
        """
        source = source or self._bus.process
        reply = await self._ask_when_stopped(
            lambda: enable(self._bus, source, take=take, keys=self._keys)
        )
        if source == self._bus.process:
            self._lease.granted(self._bus.time.boot, reply.gate)
        return reply

    async def release(self) -> GateReply:
        """Release a latched gate once the body is at rest; `enable` is still needed to move.

        Raises Refused.
        """
        gate = (await self.read_state()).gate
        known = max(self._pressed, gate.estop_generation)
        if gate.mode in ("latched", "stopping") or known > gate.estop_generation:
            await self._wait_for_rest()
        return await self._ask_when_stopped(lambda: release(self._bus, known, self._keys))

    async def estop(self, reason: str = "") -> GateReply:
        """Stop at once and latch; this script's own commands stop first.

        Raises NotConfirmed if no body confirms it within two seconds.
        """
        self._target = self._joints = None
        try:
            reply = await press_estop(self._bus, reason)
        except NotConfirmed as error:
            raise NotConfirmed(f"{error}{may_not_ask(self._keys)}") from None
        self._pressed = reply.gate.estop_generation
        return reply

    async def stop(self) -> None:
        """Brake to rest, if this script drives the base; it keeps the body."""
        self._brake()
        if self._target is None:
            return
        for _ in range(HOLD_TICKS):
            state = self._states.fresh()
            if state is None or at_rest(state.velocity):
                break
            await self._wait_ticks(1)

    def _brake(self) -> None:
        """Make base and joints brake at the next command, if this script moves them."""
        if self._joints:
            self._joints.rest()
        if self._target is not None:
            self._target = ZERO

    @contextlib.contextmanager
    def _braking_on_error(self) -> Iterator[None]:
        """Brake if the block is interrupted: by an error, a timeout or Ctrl-C."""
        try:
            yield
        except BaseException:
            self._brake()
            raise

    async def _acquire(self) -> None:
        """Ask the gate for the body, unless this script lost it. Raises Refused."""
        if self._lease.lost:
            state = await self.read_state()
            commander = state.gate.commander
            reason = f"{commander} drives" if commander else "the gate has stopped the robot"
            if self._lease.restarted(state):
                reason = "the driver was restarted"
            raise Refused(f"{state.robot_type}: {reason}; ask again with enable(take=True)")
        await self.enable(take=self._take)

    async def _joint_stream(self, body: BodyDescription) -> JointStream:
        """Return the stream of commands for joints, after this script has the body."""
        state = await self.read_state()
        if not self._lease.has(state):
            self._joints = None
            await self._acquire()
        if self._joints is None:
            self._joints = JointStream(body, await self.read_state(), self._bus.process)
        return self._joints

    def _repeat(self, state: RobotState) -> None:
        self._lease.update(state)
        if self._lease.lost or state.boot != self._boot:  # a stopped motion does not continue
            self._target = self._joints = None
        self._boot = state.boot
        self._arrived.set()
        self._send()
        self._send_joints(state)

    def _send_joints(self, state: RobotState) -> None:
        if self._joints and (command := self._joints.step(state)):
            self._bus.publish(JOINT_CMD, command)

    def _send(self) -> None:
        target, body = self._target, self._bodies.current
        if target is None or body is None:
            return
        if self._bus.time.tick > self._until_tick:
            target = ZERO
        command = CmdVel(**asdict(target), source=self._bus.process)
        self._bus.publish(command_topic(body.description), command)

    async def _ask_when_stopped(self, ask: Callable[[], Awaitable[GateReply]]) -> GateReply:
        """Ask the gate once it no longer brakes, according to its newest state and its reply."""
        for _ in range(HOLD_TICKS):
            if (await self.read_state()).gate.mode != "stopping":
                with contextlib.suppress(StillStopping):  # the reply is newer than the state
                    return await ask()
            await self._wait_ticks(1)
        return await ask()

    async def _wait_for_rest(self) -> None:
        """Wait until the body rests as long as a release needs, or REST_TICKS have passed."""
        still_ticks = 0
        for _ in range(REST_TICKS):
            still_ticks = still_ticks + 1 if at_rest((await self.read_state()).velocity) else 0
            if still_ticks > STILL_TICKS:
                break
            await self._wait_ticks(1)

    async def _wait_ticks(self, count: int) -> None:
        """Wait for `count` states. Raises BodyLost after a second without one."""
        for _ in range(count):
            self._arrived.clear()
            try:
                await arrival(self._arrived, ANSWER_S)
            except TimeoutError:
                raise BodyLost("robot/state has stopped; is the driver running?") from None
