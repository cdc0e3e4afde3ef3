"""The robot from a script or a notebook: the primitives of the HAL, over Zenoh."""

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any, TypeVar, overload

from msgspec.structs import asdict

from gigabrain_schemas.audit import AuditRecord
from gigabrain_schemas.base import Message, Velocity
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_schemas.brain import CmdVel, Twist
from gigabrain_schemas.requests import EnableRequest, GateReply, ReleaseRequest
from gigabrain_schemas.tasks import Task
from gigabrain_schemas.topics import (
    BODY,
    ENABLE,
    RELEASE,
    STATE,
    TELEOP,
    Topic,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import listen, topic_named
from gigabrain_zenoh.client.asking import ANSWER_S, ask, audit_log, granted
from gigabrain_zenoh.client.estop import press
from gigabrain_zenoh.client.hold import Hold
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, NotConfirmed, Refused, Unsupported
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of
from gigabrain_zenoh.runtime.running import find_endpoint
from gigabrain_zenoh.security.identity_files import may_not_ask, no_router

M = TypeVar("M", bound=Message)

HOLD_TICKS = 50  # a velocity lasts one second of the robot's time unless it is asked for again
ROUTER_S = 3.0  # how long a router may take to answer
BODY_TICKS = 100  # the driver says twice in that time what the body is


@asynccontextmanager
async def connect(
    connect: str | None = None,
    *,
    namespace: str = "",
    keys: str = "",
    source: str = "",
    take: bool = False,
    wait: bool = True,
) -> AsyncIterator["Robot"]:
    """A robot to drive and to listen to.

    `connect` is its router's Zenoh endpoint; without it, the only robot that runs on this machine.
    `keys` is the folder of this script's identity, for a router that wants one. `source` is the
    name under which the gate knows this script; with `take` it takes the body over from whoever
    drives. With `wait` the body's first state is waited for: without, an e-stop can be sent to a
    body that says nothing. Raises BusError when there is no router, ConfigError when the keys are
    at fault, BodyLost when there is no driver.
    """
    from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport  # takes a while: only when used

    endpoint = find_endpoint(connect, namespace, keys)
    try:
        transport = await asyncio.wait_for(ZenohTransport.open(endpoint), ROUTER_S)
    except TimeoutError:
        raise no_router(endpoint) from None
    bus = Bus(transport, Clock(), source or f"script-{os.getpid()}")
    try:
        robot = Robot(bus, take=take, keys=endpoint.keys)
        if wait:
            await robot.read_state()
        yield robot
        await robot.stop()
    finally:
        await bus.close()


class Robot:
    """One robot. Commands go out at 50 Hz with the echo that the gate asks for."""

    def __init__(self, bus: Bus, *, take: bool = False, keys: str = "") -> None:
        self._bus, self._take, self._keys = bus, take, keys
        self._states = bus.latest(STATE, self._repeat)
        self._bodies = bus.latest(BODY)
        self._target: Velocity | None = None
        self._until_tick = 0
        self._hold = Hold(bus.process)
        self._arrived = asyncio.Event()
        self.tasks = Tasks(bus, keys)

    async def go_to(self, x: float, y: float, yaw: float | None = None) -> Task:
        """Send the robot to a place in its map [m, m, rad]; how that ended, once it has.

        Whoever is cancelled meanwhile leaves the robot without that goal. `tasks` has the rest:
        missions, the queue, progress. Raises Refused, and BodyLost when nobody serves goals.
        """
        name = await self.tasks.go_to(x, y, yaw)
        try:
            return await self.tasks.result(name)
        except asyncio.CancelledError:
            await self.tasks.cancel(name)
            raise

    async def set_base_velocity(
        self, linear_x: float, linear_y: float = 0.0, angular_z: float = 0.0
    ) -> Velocity:
        """Drive [m/s, m/s, rad/s] for one second, or until the next call; returns what was asked.

        What was asked is what the body's limits leave of it. The first call asks the gate for the
        body, which this script then keeps. Raises Refused, with the gate's reason, when it does not
        let this script drive, and when somebody else has taken the body over or latched it.
        """
        state, body = await self.read_state(), await self.read_body()
        wanted = Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)
        wanted = clamp(wanted, limits_of(body))
        if not self._hold.has(state):
            await self._acquire()
        self._target, self._until_tick = wanted, self._bus.time.tick + HOLD_TICKS
        self._send()
        return wanted

    async def drive(self, linear_x: float = 0.0, angular_z: float = 0.0, *, seconds: float) -> None:
        """Drive for `seconds` of the robot's time, then stop. Raises Refused, and BodyLost."""
        start = (await self.read_state()).tick
        last = start + round(seconds * 50)
        while (left := last - self._bus.time.tick) > 0:
            await self.set_base_velocity(linear_x, 0.0, angular_z)
            await self._ticks(min(left, HOLD_TICKS // 2))
        await self.stop()

    def steer(self, wanted: Velocity) -> None:
        """Tell the robot's own control what an operator wants; to be said twenty times a second.

        Control obeys while the gate is open for the brain, and keeps the body until somebody
        enables the brain again.
        """
        self._bus.publish(TELEOP, Twist(**asdict(wanted)))

    async def stop(self) -> None:
        """Come to rest, if this script drives. It keeps the body."""
        if self._target is None:
            return
        self._target, self._until_tick = ZERO, self._bus.time.tick + HOLD_TICKS
        for _ in range(HOLD_TICKS):
            state = self._states.fresh()
            at_rest = state and abs(state.velocity.linear_x) + abs(state.velocity.angular_z) < 0.02
            if state is None or at_rest:
                break
            await self._ticks(1)

    async def enable(self, source: str = "", *, take: bool = False) -> GateReply:
        """Ask the gate for the body, for this script or for `source`. Raises Refused, and why."""
        me = self._bus.process
        request = EnableRequest(source=source or me, take=take, by=me)
        reply = granted(await ask(self._bus, ENABLE, request, self._keys))
        if request.source == self._bus.process:
            self._hold.granted(self._bus.time.boot, reply.gate)
        return reply

    async def release(self) -> GateReply:
        """Let go of a latched gate; it takes an enable as well to move. Raises Refused."""
        generation = (await self.read_state()).gate.estop_generation
        request = ReleaseRequest(estop_generation=generation, source=self._bus.process)
        return granted(await ask(self._bus, RELEASE, request, self._keys))

    async def estop(self, reason: str = "") -> GateReply:
        """Stop at once and latch; this script's own commands stop first.

        Raises NotConfirmed when no body has confirmed it within two seconds.
        """
        self._target = None
        try:
            return await press(self._bus, reason)
        except NotConfirmed as error:
            raise NotConfirmed(f"{error}{may_not_ask(self._keys)}") from None

    async def audit(self, newest: int = 100) -> tuple[AuditRecord, ...]:
        """The newest entries of the audit log, oldest first. Raises BodyLost where nobody has one.

        They are those of every process that keeps one, within a second.
        """
        return await audit_log(self._bus, newest)

    async def read_state(self) -> RobotState:
        """What the body measures. Raises BodyLost when it is silent for a second."""
        if self._states.fresh() is None:
            await self._ticks(1)
        state = self._states.fresh()
        if state is None:
            raise BodyLost("no robot/state; is the driver running?")
        return state

    @property
    def state(self) -> RobotState | None:
        """The newest state, or None when the robot is silent."""
        return self._states.fresh()

    async def read_body(self) -> BodyDescription:
        """What the body is: its limits, its outline, its sensors. Raises BodyLost."""
        for _ in range(BODY_TICKS):
            if body := self._bodies.current:
                return body.description
            await self._ticks(1)
        raise BodyLost("no robot/body; is the driver running?")

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """All joints as measured. Raises BodyLost."""
        return (await self.read_state()).joints

    async def set_joint_position(self, joint_name: str, position: float) -> float:
        """No driver obeys joint commands yet: raises Unsupported."""
        state = await self.read_state()
        raise Unsupported(f"{state.robot_type} has no joint that can be positioned")

    async def get_sensor_data(self, sensor_name: str) -> Message:
        """The next reading of `scan`, `imu` or any other topic. Raises BodyLost after a second."""
        readings = self.topic(sensor_name)
        try:
            reading: Message = await asyncio.wait_for(anext(readings), ANSWER_S)
        except TimeoutError:
            raise BodyLost(f"nobody sends robot/{sensor_name}") from None
        return reading

    @overload
    def topic(self, topic: Topic[M]) -> AsyncIterator[M]: ...

    @overload
    def topic(self, topic: str) -> AsyncIterator[Any]: ...

    def topic(self, topic: Topic[M] | str) -> AsyncIterator[M]:
        """Every message on a topic from now on: `async for scan in robot.topic("scan")`.

        Raises UnknownName for a topic that is not in the table.
        """
        return listen(self._bus, topic_named(topic) if isinstance(topic, str) else topic)

    async def _acquire(self) -> None:
        """Ask the gate for the body, once it has come to rest from whatever it was doing."""
        state = await self.read_state()
        if self._hold.lost:
            who = state.gate.commander or "an e-stop"
            raise Refused(
                f"{state.robot_type}: {who} has the body; ask again with enable(take=True)"
            )
        for _ in range(HOLD_TICKS):
            if state.gate.mode != "stopping":
                break
            await self._ticks(1)
            state = await self.read_state()
        await self.enable(take=self._take)

    def _repeat(self, state: RobotState) -> None:
        self._hold.see(state)
        self._arrived.set()
        self._send()

    def _send(self) -> None:
        target, body = self._target, self._bodies.current
        if target is None or body is None or self._hold.lost:
            return
        if self._bus.time.tick > self._until_tick:
            target = ZERO
        command = CmdVel(**asdict(target), source=self._bus.process)
        self._bus.publish(command_topic(body.description), command)

    async def _ticks(self, count: int) -> None:
        """Let the robot's time go on by `count` states, or a second of ours."""
        for _ in range(count):
            self._arrived.clear()
            try:
                await asyncio.wait_for(self._arrived.wait(), ANSWER_S)
            except TimeoutError:
                raise BodyLost("robot/state has stopped; is the driver running?") from None
