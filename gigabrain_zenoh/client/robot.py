"""Python API to a running robot, for scripts and notebooks: the HAL's primitives over Zenoh."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, overload

from msgspec.structs import asdict

from gigabrain_schemas.base import TICK_S, Message, Velocity
from gigabrain_schemas.body import BodyDescription, Joint, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.logs import AuditRecord
from gigabrain_schemas.objects import ObjectMap
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.tasks import Task
from gigabrain_schemas.topics import (
    BODY,
    JOINT_CMD,
    SAFETY,
    STATE,
    Topic,
    command_topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import listen, topic_named
from gigabrain_zenoh.client.arm import JointPath, JointStream, checked_positions
from gigabrain_zenoh.client.lease import ControlLease
from gigabrain_zenoh.client.motion import OdometryMotion, Reached
from gigabrain_zenoh.client.objects import known_objects
from gigabrain_zenoh.client.requests import (
    ANSWER_S,
    audit_log,
    check_finite,
    check_speed,
    enable,
    jog,
    let_go,
    press_estop,
    release,
    steer,
)
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import (
    BodyLost,
    ConfigError,
    NotConfirmed,
    Refused,
    StillStopping,
    Unsupported,
)
from gigabrain_zenoh.gate.gate import STILL_TICKS
from gigabrain_zenoh.geometry.limits import ZERO, at_rest, clamp, limits_of
from gigabrain_zenoh.security.identity_files import may_not_ask

M = TypeVar("M", bound=Message)

HOLD_TICKS = 50  # how long a requested velocity lasts: one second of the robot's time
ROUTER_S = 3.0  # timeout of the connection
REST_TICKS = 150  # timeout for a body to come to rest before a release
BODY_TICKS = 100  # timeout for `robot/body`, which is published once a second


class Robot:
    """A running robot. Commands are published at 50 Hz with the echo that the gate requires."""

    def __init__(self, bus: Bus, *, take: bool = False, keys: str = "") -> None:
        self._bus, self._take, self._keys = bus, take, keys
        self._states = bus.latest(STATE, self._repeat)
        self._bodies, self._safety = bus.latest(BODY), bus.latest(SAFETY)
        self._target: Velocity | None = None
        self._until_tick = self._boot = 0
        self._joints: JointStream | None = None  # once joints were commanded
        self._pressed = 0  # the number of this script's newest e-stop
        self._lease = ControlLease(bus.process)
        self._arrived = asyncio.Event()
        self.tasks = Tasks(bus, keys)

    async def move(self, distance: float, *, speed: float | None = None) -> Reached:
        """Drive straight by `distance` [m]; backwards if it is negative.

        `speed` [m/s] is an upper limit. Returns what odometry has measured and what has held the
        body back. Cutting this call short, as with Ctrl-C or a timeout, stops the body. Raises
        Refused if the gate does not grant the body, and BodyLost.
        """
        return await self._carry_out(distance, 0.0, speed)

    async def turn(self, angle: float, *, speed: float | None = None) -> Reached:
        """Turn on the spot by `angle` [rad], counter-clockwise if it is positive.

        `speed` [rad/s] is an upper limit. Returns, stops and raises as `move` does, and raises
        Unsupported for a body that cannot turn on the spot.
        """
        return await self._carry_out(0.0, angle, speed)

    async def goto(
        self,
        x: float | str | None = None,
        y: float | None = None,
        yaw: float | None = None,
        *,
        object: str = "",
        tag: int | None = None,
    ) -> Task:
        """Send the robot to a pose [m, m, rad] or a named place; return the task once it has ended.

        Instead of these, `object` is the class of a thing to drive before, and `tag` the number of
        a tag; the robot looks for one that it does not know. Cancelling this call cancels the goal.
        `tasks` has missions, the queue and progress. Raises Refused, and BodyLost if no process
        serves goals.
        """
        if sum((x is not None, bool(object), tag is not None)) != 1:
            raise ConfigError("goto: expected x and y, the name of a place, an object or a tag")
        if x is None:
            if y is not None or yaw is not None:
                raise ConfigError("goto: expected an object or a tag without y and yaw")
            name = await self.tasks.go_to_object(object, tag=tag)
        elif isinstance(x, str):
            if y is not None:
                expected = "expected numbers x and y, or a place and yaw="
                raise ConfigError(f"goto: {expected}; got {x!r} and y={y!r}")
            name = await self.tasks.go_to_place(x, yaw)
        elif y is None:
            raise ConfigError("goto: expected x and y, or the name of a place")
        else:
            name = await self.tasks.go_to(x, y, yaw)
        try:
            return await self.tasks.result(name)
        except asyncio.CancelledError:
            await self.tasks.cancel(name)
            raise

    async def objects(self) -> ObjectMap:
        """Return the things and tags that the cameras have recognised. Raises BodyLost."""
        return await known_objects(self._bus)

    async def set_base_velocity(
        self, linear_x: float, linear_y: float = 0.0, angular_z: float = 0.0
    ) -> Velocity:
        """Drive [m/s, m/s, rad/s] for one second, or until the next call.

        Returns the velocity within the body's limits. The first call asks the gate for the body,
        which this script then keeps. Raises ConfigError for a number that is not finite, and
        Refused if the gate does not grant the body, or if another commander has taken it over or
        latched it.
        """
        wanted = Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)
        check_finite(asdict(wanted))
        state, body = await self.read_state(), await self.read_body()
        if not body.has_base:
            raise Unsupported(f"{body.robot_type} has no base to drive")
        wanted = clamp(wanted, limits_of(body))
        if not self._lease.has(state):
            await self._acquire()
        self._target, self._until_tick = wanted, self._bus.time.tick + HOLD_TICKS
        self._send()
        return wanted

    async def drive(self, linear_x: float = 0.0, angular_z: float = 0.0, *, seconds: float) -> None:
        """Drive for `seconds` of the robot's time, then stop; also when this call is cut short.

        Raises what `set_base_velocity` raises.
        """
        check_finite({"seconds": seconds})
        start = (await self.read_state()).tick
        last = start + round(seconds * 50)
        with self._halting():
            while (left := last - self._bus.time.tick) > 0:
                await self.set_base_velocity(linear_x, 0.0, angular_z)
                await self._ticks(min(left, HOLD_TICKS // 2))
        await self.stop()

    def steer(self, wanted: Velocity) -> None:
        """Publish an operator's velocity to the robot's control; repeat at 20 Hz.

        Control obeys while the gate is enabled for the brain. It keeps the body until the brain is
        enabled again.
        """
        steer(self._bus, wanted)

    def jog(self, speeds: Mapping[str, float]) -> None:
        """Publish an operator's velocities of joints [rad/s or m/s]; repeat at 20 Hz.

        Joints that are not named are held. Control obeys as it does for `steer`.
        """
        jog(self._bus, speeds)

    async def limp(self) -> GateReply:
        """Let go of all joints, so that a person can move them; an arm may fall.

        Raises Refused while somebody moves it, or where its driver cannot, and BodyLost.
        """
        return await let_go(self._bus, True, self._keys)

    async def hold(self) -> GateReply:
        """Hold limp joints again, where they are.

        Raises Refused with the reason where they do not hold, and BodyLost.
        """
        return await let_go(self._bus, False, self._keys)

    async def _carry_out(self, distance: float, angle: float, speed: float | None) -> Reached:
        check_finite({"distance": distance, "angle": angle})
        check_speed(speed)
        motion = OdometryMotion(await self.read_body(), await self.read_state(), distance, angle)
        with self._halting():
            while not motion.done:
                verdict = self._safety.fresh()
                causes = verdict.causes if verdict else ()
                wanted = motion.step(await self.read_state(), speed, causes)
                await self.set_base_velocity(wanted.linear_x, 0.0, wanted.angular_z)
                await self._ticks(1)
        await self.stop()
        return motion.result()

    async def stop(self) -> None:
        """Come to rest, if this script drives; it keeps the body."""
        self._halt()
        if self._target is None:
            return
        for _ in range(HOLD_TICKS):
            state = self._states.fresh()
            if state is None or at_rest(state.velocity):
                break
            await self._ticks(1)

    def _halt(self) -> None:
        """Let base and joints brake from the next command on, if this script moves them."""
        if self._joints:
            self._joints.rest()
        if self._target is not None:
            self._target = ZERO

    @contextlib.contextmanager
    def _halting(self) -> Iterator[None]:
        """Brake if the block is cut short: by an error, a timeout or Ctrl-C."""
        try:
            yield
        except BaseException:
            self._halt()
            raise

    async def enable(self, source: str = "", *, take: bool = False) -> GateReply:
        """Ask the gate for the body, for this script or for `source`, once it no longer stops.

        Raises Refused and BodyLost.
        """
        source = source or self._bus.process
        reply = await self._once_stopped(
            lambda: enable(self._bus, source, take=take, keys=self._keys)
        )
        if source == self._bus.process:
            self._lease.granted(self._bus.time.boot, reply.gate)
        return reply

    async def release(self) -> GateReply:
        """Release a latched gate once the body has rested; `enable` is still needed to move.

        Raises Refused.
        """
        gate = (await self.read_state()).gate
        known = max(self._pressed, gate.estop_generation)
        if gate.mode in ("latched", "stopping") or known > gate.estop_generation:
            await self._rest()
        return await self._once_stopped(lambda: release(self._bus, known, self._keys))

    async def estop(self, reason: str = "") -> GateReply:
        """Stop at once and latch; this script's own commands stop first.

        Raises NotConfirmed if no body has confirmed it within two seconds.
        """
        self._target = self._joints = None
        try:
            reply = await press_estop(self._bus, reason)
        except NotConfirmed as error:
            raise NotConfirmed(f"{error}{may_not_ask(self._keys)}") from None
        self._pressed = reply.gate.estop_generation
        return reply

    async def audit(self, newest: int = 100) -> tuple[AuditRecord, ...]:
        """Return the newest entries of all audit logs, oldest first. Raises BodyLost."""
        return await audit_log(self._bus, newest)

    async def read_state(self) -> RobotState:
        """Return the newest state. Raises BodyLost if none arrives within a second."""
        if self._states.fresh() is None:
            await self._ticks(1)
        state = self._states.fresh()
        if state is None:
            raise BodyLost("no robot/state; is the driver running?")
        return state

    @property
    def state(self) -> RobotState | None:
        """The newest state; None while the robot is silent."""
        return self._states.fresh()

    async def read_body(self) -> BodyDescription:
        """Return the body's description: limits, footprint, sensors. Raises BodyLost."""
        for _ in range(BODY_TICKS):
            if body := self._bodies.current:
                return body.description
            await self._ticks(1)
        raise BodyLost("no robot/body; is the driver running?")

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """Return all measured joints. Raises BodyLost."""
        return (await self.read_state()).joints

    async def set_joint_position(
        self, joint_name: str, position: float, *, speed: float | None = None, wait: bool = True
    ) -> float:
        """Move one joint to a position [rad or m]; return the measured one.

        It raises what `set_joint_positions` raises.
        """
        positions = {joint_name: position}
        return (await self.set_joint_positions(positions, speed=speed, wait=wait))[joint_name]

    async def set_joint_positions(
        self, positions: Mapping[str, float], *, speed: float | None = None, wait: bool = True
    ) -> dict[str, float]:
        """Move joints together to positions [rad or m]; return those of all joints, as measured.

        The others are held. `speed` [rad/s or m/s] is an upper limit. The first call asks the gate
        for the body, which this script then keeps. With `wait`, it returns once the joints are
        there within their tolerance, or rest as near as they get, and cutting it short stops them;
        without, it returns at once.

        Raises Unsupported for a body without joints, UnknownName and ConfigError for a joint or a
        position that it does not have, Refused as `set_base_velocity` does, and BodyLost.
        """
        body = await self.read_body()
        positions = checked_positions(body, positions)
        check_speed(speed)
        stream = await self._joint_stream(body)
        stream.go(positions, speed)
        return await self._joints_there(body, stream, wait)

    async def track_joint_positions(
        self, positions: Mapping[str, float], *, speed: float | None = None
    ) -> dict[str, float]:
        """Have joints follow positions [rad or m] that change all the time, as of a leading arm.

        It returns where the joints were sent, at the next state: then call it again. They are on
        the fastest way to rest at the newest positions, so they lag by about a tenth of a second,
        and do not shoot over. `speed` [rad/s or m/s] is an upper limit. It raises what
        `set_joint_positions` raises.
        """
        body = await self.read_body()
        positions = checked_positions(body, positions)
        check_speed(speed)
        stream = await self._joint_stream(body)
        stream.go(positions, speed)
        await self._ticks(1)
        return stream.posture

    async def set_joint_trajectory(
        self, points: Sequence[tuple[float, Mapping[str, float]]], *, wait: bool = True
    ) -> dict[str, float]:
        """Follow points, each a time from now [s] and positions by joint [rad or m].

        Between them positions are interpolated. Returns and raises as `set_joint_positions` does,
        and raises ConfigError where a joint would have to move faster than it can.
        """
        body = await self.read_body()
        for _, positions in points:
            checked_positions(body, positions)
        stream = await self._joint_stream(body)
        stream.follow(JointPath(body, points, stream.posture))
        return await self._joints_there(body, stream, wait)

    async def get_sensor_data(self, sensor_name: str) -> Message:
        """Return the next message of `scan`, `imu` or another topic. Raises BodyLost after 1 s."""
        reading: Message = await anext(self.topic(sensor_name, timeout=ANSWER_S))
        return reading

    @overload
    def topic(self, topic: Topic[M], *, timeout: float | None = None) -> AsyncIterator[M]: ...

    @overload
    def topic(self, topic: str, *, timeout: float | None = None) -> AsyncIterator[Any]: ...

    def topic(self, topic: Topic[M] | str, *, timeout: float | None = None) -> AsyncIterator[M]:
        """Yield each message on a topic: `async for scan in robot.topic("scan", timeout=5)`.

        Without a `timeout` [s] it waits for ever, also for a driver that has died. Raises BodyLost
        after one without a message, and UnknownName for a topic that is not in the table.
        """
        if timeout is not None and not timeout > 0:
            raise ConfigError(f"timeout: expected more than 0, got {timeout:g}")
        wanted = topic_named(topic) if isinstance(topic, str) else topic
        return listen(self._bus, wanted, timeout)

    async def _joint_stream(self, body: BodyDescription) -> JointStream:
        """Return the stream of commands for joints, with the body for this script."""
        state = await self.read_state()
        if not self._lease.has(state):
            self._joints = None
            await self._acquire()
        if self._joints is None:
            self._joints = JointStream(body, await self.read_state(), self._bus.process)
        return self._joints

    async def _joints_there(
        self, body: BodyDescription, stream: JointStream, wait: bool
    ) -> dict[str, float]:
        """Wait until the joints are where they were sent, or as near as they get.

        Those that safety holds back stay there, also once they are free again.
        """
        assert body.arm
        left = round(body.arm.goal_time / TICK_S)
        with self._halting():
            while wait and left and not stream.reached(state := await self.read_state()):
                if not self._lease.has(state):
                    await self._acquire()
                await self._ticks(1)
                left -= stream.arrived
                if stream.held_back:
                    stream.give_up()
        return {joint.name: joint.position for joint in await self.get_joint_states()}

    async def _acquire(self) -> None:
        """Ask the gate for the body, unless another commander has taken it."""
        if self._lease.lost:
            state = await self.read_state()
            why = f"{state.gate.commander or 'an e-stop'} has the body"
            if self._lease.restarted(state):
                why = "the driver was restarted"
            raise Refused(f"{state.robot_type}: {why}; ask again with enable(take=True)")
        await self.enable(take=self._take)

    def _repeat(self, state: RobotState) -> None:
        self._lease.update(state)
        if self._lease.lost or state.boot != self._boot:  # what was stopped does not go on
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

    async def _once_stopped(self, ask: Callable[[], Awaitable[GateReply]]) -> GateReply:
        """Ask the gate once it no longer stops, by its newest state and by its answer."""
        for _ in range(HOLD_TICKS):
            if (await self.read_state()).gate.mode != "stopping":
                with contextlib.suppress(StillStopping):  # the answer is newer than the state
                    return await ask()
            await self._ticks(1)
        return await ask()

    async def _rest(self) -> None:
        """Wait until the body has rested as long as a release needs; for three seconds at most."""
        rested = 0
        for _ in range(REST_TICKS):
            rested = rested + 1 if at_rest((await self.read_state()).velocity) else 0
            if rested > STILL_TICKS:
                break
            await self._ticks(1)

    async def _ticks(self, count: int) -> None:
        """Wait for `count` states. Raises BodyLost after a second without one."""
        for _ in range(count):
            self._arrived.clear()
            try:
                async with asyncio.timeout(ANSWER_S):  # `wait_for` may swallow a cancellation
                    await self._arrived.wait()
            except TimeoutError:
                raise BodyLost("robot/state has stopped; is the driver running?") from None
