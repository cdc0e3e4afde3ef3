"""Python API to a running robot, for scripts and notebooks: the HAL's primitives over Zenoh."""

import asyncio
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Any, TypeVar, overload

from msgspec.structs import asdict

from gigabrain_schemas.base import TICK_S, Message, Velocity
from gigabrain_schemas.body import BodyDescription, Joint
from gigabrain_schemas.logs import AuditRecord
from gigabrain_schemas.objects import ObjectMap
from gigabrain_schemas.requests import GateReply
from gigabrain_schemas.tasks import Task
from gigabrain_schemas.topics import SAFETY, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import listen, topic_named
from gigabrain_zenoh.client.arm import JointPath, JointStream, check_joints, checked_positions
from gigabrain_zenoh.client.commander import HOLD_TICKS, Commander
from gigabrain_zenoh.client.motion import OdometryMotion, Reached
from gigabrain_zenoh.client.objects import known_objects
from gigabrain_zenoh.client.requests import (
    ANSWER_S,
    audit_log,
    check_finite,
    check_speed,
    jog,
    let_go,
    steer,
)
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import ConfigError, Unsupported
from gigabrain_zenoh.geometry.limits import clamp, limits_of

M = TypeVar("M", bound=Message)


class Robot(Commander):
    """A running robot. Commands are published at 50 Hz with the echo that the gate requires."""

    def __init__(self, bus: Bus, *, take: bool = False, keys: str = "") -> None:
        super().__init__(bus, take=take, keys=keys)
        self._safety = bus.latest(SAFETY)
        self.tasks = Tasks(bus, keys)

    async def move(self, distance: float, *, speed: float | None = None) -> Reached:
        """Drive straight by `distance` [m]; backwards if it is negative.

        `speed` [m/s] is an upper limit. Returns the measurements of odometry, and the causes that
        held the body back. Interrupting this call, as with Ctrl-C or a timeout, stops the body.
        Raises Refused if the gate does not grant the body, and BodyLost.
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

        Instead of a pose, `object` is the class of a thing to drive to, and `tag` the number of a
        tag; the robot searches for an unknown one. Cancelling this call cancels the goal. For
        missions, the queue and progress use `tasks`. Raises Refused, and BodyLost if no process
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
        """Drive for `seconds` of the robot's time, then stop; also if this call is interrupted.

        Raises the errors of `set_base_velocity`.
        """
        check_finite({"seconds": seconds})
        if seconds < 0:
            raise ConfigError(f"seconds: expected 0 or more, got {seconds:g}")
        start = (await self.read_state()).tick
        last = start + round(seconds * 50)
        with self._braking_on_error():
            while (left := last - self._bus.time.tick) > 0:
                await self.set_base_velocity(linear_x, 0.0, angular_z)
                await self._wait_ticks(min(left, HOLD_TICKS // 2))
        await self.stop()

    def steer(self, wanted: Velocity) -> None:
        """Publish an operator's velocity to the robot's control; repeat at 20 Hz.

        Control obeys while the gate is enabled for the brain. It keeps the body until the brain is
        enabled again.
        """
        steer(self._bus, wanted)

    def jog(self, speeds: Mapping[str, float]) -> None:
        """Publish an operator's velocities of joints [rad/s or m/s]; repeat at 20 Hz.

        Other joints are held. Control obeys as it does for `steer`.
        """
        jog(self._bus, speeds)

    async def limp(self) -> GateReply:
        """Let go of all joints, so that a person can move them; an arm may fall.

        Raises Refused while the arm is commanded or if its driver cannot do it, Unsupported for a
        body without joints, and BodyLost.
        """
        check_joints(await self.read_body())
        return await let_go(self._bus, True, self._keys)

    async def hold(self) -> GateReply:
        """Hold limp joints again, where they are.

        Raises Refused with the reason if they cannot hold, Unsupported for a body without joints,
        and BodyLost.
        """
        check_joints(await self.read_body())
        return await let_go(self._bus, False, self._keys)

    async def _carry_out(self, distance: float, angle: float, speed: float | None) -> Reached:
        check_finite({"distance": distance, "angle": angle})
        check_speed(speed)
        motion = OdometryMotion(await self.read_body(), await self.read_state(), distance, angle)
        with self._braking_on_error():
            while not motion.done:
                verdict = self._safety.fresh()
                causes = verdict.causes if verdict else ()
                wanted = motion.step(await self.read_state(), speed, causes)
                await self.set_base_velocity(wanted.linear_x, 0.0, wanted.angular_z)
                await self._wait_ticks(1)
        await self.stop()
        return motion.result()

    async def audit(self, newest: int = 100) -> tuple[AuditRecord, ...]:
        """Return the newest entries of all audit logs, oldest first. Raises BodyLost."""
        return await audit_log(self._bus, newest)

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """Return all measured joints. Raises BodyLost."""
        return (await self.read_state()).joints

    async def set_joint_position(
        self, joint_name: str, position: float, *, speed: float | None = None, wait: bool = True
    ) -> float:
        """Move one joint to a position [rad or m]; return the measured one.

        Raises the errors of `set_joint_positions`.
        """
        positions = {joint_name: position}
        return (await self.set_joint_positions(positions, speed=speed, wait=wait))[joint_name]

    async def set_joint_positions(
        self, positions: Mapping[str, float], *, speed: float | None = None, wait: bool = True
    ) -> dict[str, float]:
        """Move joints together to positions [rad or m]; return those of all joints, as measured.

        Other joints are held. `speed` [rad/s or m/s] is an upper limit. The first call asks the
        gate for the body, which this script then keeps. With `wait`, the call returns once the
        joints are within their tolerance, or rest as near as they can get; interrupting it stops
        them. Without `wait`, it returns at once.

        Raises Unsupported for a body without joints, UnknownName for an unknown joint, ConfigError
        for a position out of its range, Refused as `set_base_velocity` does, and BodyLost.
        """
        body = await self.read_body()
        positions = checked_positions(body, positions)
        check_speed(speed)
        stream = await self._joint_stream(body)
        stream.go(positions, speed)
        return await self._wait_for_joints(body, stream, wait)

    async def track_joint_positions(
        self, positions: Mapping[str, float], *, speed: float | None = None
    ) -> dict[str, float]:
        """Make joints follow positions [rad or m] that change all the time, as of a leading arm.

        Returns the commanded positions at the next state; then call it again. The joints take the
        fastest way to rest at the newest positions, so they lag by about a tenth of a second, and
        do not overshoot. `speed` [rad/s or m/s] is an upper limit. Raises the errors of
        `set_joint_positions`.
        """
        body = await self.read_body()
        positions = checked_positions(body, positions)
        check_speed(speed)
        stream = await self._joint_stream(body)
        stream.go(positions, speed)
        await self._wait_ticks(1)
        return stream.posture

    async def set_joint_trajectory(
        self, points: Sequence[tuple[float, Mapping[str, float]]], *, wait: bool = True
    ) -> dict[str, float]:
        """Follow points, each a time from now [s] and positions by joint [rad or m].

        Between them positions are interpolated. Returns and raises as `set_joint_positions` does,
        and raises ConfigError where a joint would have to move faster than it can.
        """
        body = await self.read_body()
        check_joints(body)
        source = self._bus.process
        stream = self._joints or JointStream(body, await self.read_state(), source)
        JointPath(body, points, stream.posture)  # a refused one does not take the body
        stream = await self._joint_stream(body)
        stream.follow(JointPath(body, points, stream.posture))
        return await self._wait_for_joints(body, stream, wait)

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

        Without a `timeout` [s] it waits for ever, also for a driver that died. Raises BodyLost
        after a `timeout` without a message, and UnknownName for an unknown topic.
        """
        if timeout is not None and not timeout > 0:
            raise ConfigError(f"timeout: expected more than 0, got {timeout:g}")
        wanted = topic_named(topic) if isinstance(topic, str) else topic
        return listen(self._bus, wanted, timeout)

    async def _wait_for_joints(
        self, body: BodyDescription, stream: JointStream, wait: bool
    ) -> dict[str, float]:
        """Wait until the joints reach their goals, or rest as near as they can get.

        Joints that safety held back stay there, also when the way is free again.
        """
        assert body.arm
        ticks_left = round(body.arm.goal_time / TICK_S)  # after the last command
        with self._braking_on_error():
            while wait and ticks_left and not stream.reached(state := await self.read_state()):
                if not self._lease.has(state):
                    await self._acquire()
                await self._wait_ticks(1)
                ticks_left -= stream.arrived
                if stream.held_back:
                    stream.give_up()
        return {joint.name: joint.position for joint in await self.get_joint_states()}
