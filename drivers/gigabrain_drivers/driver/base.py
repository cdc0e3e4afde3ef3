"""The hardware abstraction layer: what every body offers."""

import abc
import asyncio
import logging
import math
from collections.abc import AsyncIterator, Callable, Mapping
from typing import Any, ClassVar, Self

from gigabrain_drivers.driver.arm_model import arm_text
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_schemas.base import TICK_NS, Message, Velocity
from gigabrain_schemas.body import (
    ArmModel,
    Joint,
    RobotState,
    SafeState,
)
from gigabrain_schemas.sim import SimReply, SimRequest
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import GigabrainError, Unsupported
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of

log = logging.getLogger(__name__)

TIMER_SLACK_NS = 2_000_000  # before its time an event loop may call, as its own clock is coarse
AT_REST_SPEED = 0.02  # [m/s], [rad/s]
MAX_REST_CHECKS = 40  # 0.8 s: a supervisor that ends this process waits little longer

Emit = Callable[[Topic[Any], Message], None]


class Driver(abc.ABC):
    """One body. Used as `async with driver:`; leaving the block always makes the body safe.

    A body implements the primitives that it has; the others raise Unsupported. `stop` and `close`
    work in any state, any number of times, and never raise.
    """

    Options: ClassVar[type[LinkOptions]] = LinkOptions  # the link's part of the robot's file
    lockstep = False  # whether time waits for the brain (simulation at other speeds than 1)
    finished = False  # whether the body's time has come to its end (simulation with a duration)

    def __init__(self, robot: RobotFile, options: Any, run: Run) -> None:
        self.robot, self.options, self.run = robot, options, run
        self.emit: Emit = lambda topic, message: None  # the driver's process puts its own here
        self.sensors: dict[str, Message | None] = {}  # newest readings; None before the first

    @classmethod  # noqa: B027 - most drivers fit any body
    def check(cls, robot: RobotFile, options: Any) -> None:
        """Raises ValueError, as `FIELD: ...`, where its options do not fit the body."""

    async def __aenter__(self) -> Self:
        try:
            await self.open()
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        try:
            await self.make_safe()
        finally:  # it may be cancelled
            await self.close()

    @abc.abstractmethod
    async def open(self) -> None:
        """Connect. Raises BodyLost if the body does not answer."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Let go of the body."""

    @abc.abstractmethod
    async def stop(self) -> None:
        """Bring the body to rest."""

    @abc.abstractmethod
    async def read_state(self) -> RobotState:
        """Return the body's measurements; header and gate are added later. Raises BodyLost."""

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """Yield whenever time has gone on, and by how many ticks of 20 ms of the body's time."""
        start, yielded = clock.now_ns(), 0
        async for now_ns in clock.every(TICK_NS):
            passed = (now_ns - start + TIMER_SLACK_NS) // TICK_NS + 1 - yielded
            if passed > 0:
                yielded += passed
                yield passed

    async def hold(self) -> None:
        """Keep the present position; an arm without brakes must not go limp."""
        await self.stop()

    async def park(self) -> None:
        """Take a posture in which the body may be left alone. Raises BodyLost."""
        raise Unsupported(f"{type(self).__name__} cannot park its body")

    async def limp(self) -> None:
        """Switch joint torque off, to move the joints by hand. Raises BodyLost.

        The next positions that are sent hold the joints again; `read_state` gives `limp` until
        all of them do. Where they do not, `problem` says why.
        """
        raise Unsupported(f"{type(self).__name__} cannot release its body's joints")

    def can(self, state: SafeState) -> bool:
        """Return whether this driver can bring its body into a safe state."""
        return getattr(type(self), state) is not getattr(Driver, state) or state == "hold"

    async def make_safe(self) -> None:
        """Come to rest, then take up the safe state that the robot's file names. Never raises."""
        state = self.robot.safe_state
        await (self.hold() if state == "hold" else self.stop())
        if state in ("stop", "hold"):
            return
        try:
            await self._rest()
            await (self.park() if state == "park" else self.limp())
        except GigabrainError as error:
            log.error("the body has stopped, but %s could not be done: %s", state, error)

    async def _rest(self) -> None:
        """Wait until the body stands still, but no longer than it may take to brake."""
        for _ in range(MAX_REST_CHECKS):
            now = (await self.read_state()).velocity
            if max(abs(now.linear_x), abs(now.linear_y), abs(now.angular_z)) < AT_REST_SPEED:
                return
            await asyncio.sleep(TICK_NS / 1e9)

    @property
    def problem(self) -> str:
        """The reason in one line why the body cannot be moved; empty for none, or none known."""
        return ""

    @property
    def guard_ms(self) -> float | None:
        """Time in which a process of its own stops the motors if this one dies; None for none."""
        return None

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive [m/s, m/s, rad/s]; returns what was really sent. Raises BodyLost."""
        raise Unsupported(f"{type(self).__name__} has no base to drive")

    def bounded(self, linear_x: float, linear_y: float, angular_z: float) -> Velocity:
        """A command within the body's own limits; where one value is no number, all are zero."""
        if not all(map(math.isfinite, (linear_x, linear_y, angular_z))):
            return ZERO
        wanted = Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)
        return clamp(wanted, limits_of(self.robot))

    def bounded_joints(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Return positions within the joints' ranges, without those that are no numbers.

        Raises Unsupported for a joint that the body does not have.
        """
        known = {joint.name: joint for joint in self.robot.joints}
        for name in positions:
            if name not in known:
                has = ", ".join(known) or "none"
                raise Unsupported(f"{self.robot.robot_type} has no joint {name!r}; it has: {has}")
        return {
            name: max(known[name].lower, min(known[name].upper, position))
            for name, position in positions.items()
            if math.isfinite(position)
        }

    async def set_joint_positions(self, positions: Mapping[str, float]) -> Mapping[str, float]:
        """Move joints together [rad or m]; returns what was really sent. Raises BodyLost."""
        raise Unsupported(f"{type(self).__name__} has no joints to position")

    async def set_joint_position(self, joint_name: str, position: float) -> float:
        """Move one joint [rad or m]; returns what was really sent. Raises BodyLost."""
        return (await self.set_joint_positions({joint_name: position}))[joint_name]

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """Return all joints as measured. Raises BodyLost."""
        return (await self.read_state()).joints

    def arm_model(self) -> ArmModel | None:
        """Return the model of a body with an arm. Raises ConfigError."""
        if self.robot.arm is None:
            return None
        path = self.run.folder / self.robot.arm_model
        return ArmModel(mjcf=arm_text(path, [joint.name for joint in self.robot.joints]))

    async def change_world(self, request: SimRequest) -> SimReply:
        """Change the simulated world that the body is in. Raises Unsupported, and Refused."""
        what = "a real body" if self.run.link == "real" else f"{type(self).__name__}, no simulation"
        raise Unsupported(f"{self.robot.robot_type} has no simulated world: it is {what}")

    async def get_sensor_data(self, sensor_name: str) -> Message | None:
        """Return the newest reading of a sensor, or None before its first. Raises Unsupported."""
        if sensor_name not in self.sensors:
            has = ", ".join(sorted(self.sensors)) or "none"
            raise Unsupported(
                f"{self.robot.robot_type} has no sensor {sensor_name!r}; it has: {has}"
            )
        return self.sensors[sensor_name]

    def publish(self, sensor: str, topic: Topic[Any], message: Message) -> None:
        """Emit a reading of a sensor, and keep it as the newest."""
        self.sensors[sensor] = message
        self.emit(topic, message)

    def report(self) -> Mapping[str, float | int | str | None]:
        """Return figures that only this driver knows, such as a simulation's truth."""
        return {}
