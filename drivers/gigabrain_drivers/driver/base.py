"""The hardware abstraction layer: the interface of every body."""

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

TIMER_SLACK_NS = 2_000_000  # an event loop may call this early, as its own clock is coarse
AT_REST_SPEED = 0.02  # [m/s], [rad/s]
MAX_REST_CHECKS = 40  # 0.8 s; a supervisor that ends this process waits little longer

Emit = Callable[[Topic[Any], Message], None]


class Driver(abc.ABC):
    """One body. Used as `async with driver:`; leaving the block always makes the body safe.

    A body implements the primitives that it has; the others raise Unsupported. `stop` and `close`
    work in any state, any number of times, and never raise.
    """

    Options: ClassVar[type[LinkOptions]] = LinkOptions  # the link's section in the robot's file
    lockstep = False  # True if time waits for the brain (simulation at speeds other than 1)
    finished = False  # True once the body's time has ended (simulation with a duration)

    def __init__(self, robot: RobotFile, options: Any, run: Run) -> None:
        self.robot, self.options, self.run = robot, options, run
        self.emit: Emit = lambda topic, message: None  # set by the driver's process
        self.sensors: dict[str, Message | None] = {}  # newest readings; None before the first

    @classmethod  # noqa: B027 - most drivers fit any body
    def check(cls, robot: RobotFile, options: Any) -> None:
        """Raise ValueError, as `FIELD: ...`, if the options do not fit the body."""

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
        finally:  # `make_safe` may be cancelled
            await self.close()

    @abc.abstractmethod
    async def open(self) -> None:
        """Connect. Raises BodyLost if the body does not answer."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Disconnect from the body."""

    @abc.abstractmethod
    async def stop(self) -> None:
        """Bring the body to rest."""

    @abc.abstractmethod
    async def read_state(self) -> RobotState:
        """Return the body's measurements; header and gate are added later. Raises BodyLost."""

    async def ticks(self, clock: Clock) -> AsyncIterator[int]:
        """Yield the number of ticks of 20 ms that have passed in the body's time, when any has."""
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

        The next positions that are sent hold the joints again. `read_state` returns `limp` until
        all of them hold. If they do not, `problem` says why.
        """
        raise Unsupported(f"{type(self).__name__} cannot release its body's joints")

    def can(self, state: SafeState) -> bool:
        """Return whether this driver can bring its body into a safe state."""
        return getattr(type(self), state) is not getattr(Driver, state) or state == "hold"

    async def make_safe(self) -> None:
        """Come to rest, then enter the safe state of the robot's file. Never raises."""
        state = self.robot.safe_state
        await (self.hold() if state == "hold" else self.stop())
        if state in ("stop", "hold"):
            return
        try:
            await self._wait_for_rest()
            await (self.park() if state == "park" else self.limp())
        except GigabrainError as error:
            log.error("the body has stopped, but %s could not be done: %s", state, error)

    async def _wait_for_rest(self) -> None:
        """Wait until the body is at rest, at most for MAX_REST_CHECKS ticks."""
        for _ in range(MAX_REST_CHECKS):
            now = (await self.read_state()).velocity
            if max(abs(now.linear_x), abs(now.linear_y), abs(now.angular_z)) < AT_REST_SPEED:
                return
            await asyncio.sleep(TICK_NS / 1e9)

    @property
    def problem(self) -> str:
        """One line on why the body cannot be moved; empty if it can, or if this is unknown."""
        return ""

    @property
    def guard_ms(self) -> float | None:
        """Time in which a guard process stops the motors if this one dies; None without a guard."""
        return None

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive [m/s, m/s, rad/s]; return the velocity that was sent. Raises BodyLost."""
        raise Unsupported(f"{type(self).__name__} has no base to drive")

    def bounded(self, linear_x: float, linear_y: float, angular_z: float) -> Velocity:
        """Return a command within the body's limits; zero if any value is not finite."""
        if not all(map(math.isfinite, (linear_x, linear_y, angular_z))):
            return ZERO
        wanted = Velocity(linear_x=linear_x, linear_y=linear_y, angular_z=angular_z)
        return clamp(wanted, limits_of(self.robot))

    def bounded_joints(self, positions: Mapping[str, float]) -> dict[str, float]:
        """Return positions within the joints' ranges, without values that are not finite.

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
        """Move joints together [rad or m]; return the positions that were sent. Raises BodyLost."""
        raise Unsupported(f"{type(self).__name__} has no joints to position")

    async def set_joint_position(self, joint_name: str, position: float) -> float:
        """Move one joint [rad or m]; return the position that was sent. Raises BodyLost."""
        return (await self.set_joint_positions({joint_name: position}))[joint_name]

    async def get_joint_states(self) -> tuple[Joint, ...]:
        """Return all joints as measured. Raises BodyLost."""
        return (await self.read_state()).joints

    def arm_model(self) -> ArmModel | None:
        """Return the model of the arm; None without one. Raises ConfigError."""
        if self.robot.arm is None:
            return None
        path = self.run.folder / self.robot.arm_model
        return ArmModel(mjcf=arm_text(path, [joint.name for joint in self.robot.joints]))

    async def change_world(self, request: SimRequest) -> SimReply:
        """Change the simulated world of the body. Raises Unsupported or Refused."""
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
        """Emit a reading of a sensor, and store it as the newest."""
        self.sensors[sensor] = message
        self.emit(topic, message)

    def report(self) -> Mapping[str, float | int | str | None]:
        """Return figures of this driver only, such as a simulation's ground truth."""
        return {}
