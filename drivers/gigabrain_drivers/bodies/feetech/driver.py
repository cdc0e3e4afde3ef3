"""An arm on a bus of Feetech STS servos, on its real link or on the emulator.

The servos hold their goals by themselves: should the driver die, the arm stays where it is. No
start moves it: a servo that holds keeps its goal, another gets the place where it is.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Mapping
from typing import Annotated

from msgspec import Meta
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.bus import ANSWER_TIMEOUT_NS, HostBus
from gigabrain_drivers.bodies.feetech.calibration import (
    OUTSIDE,
    calibration_path,
    load_calibration,
)
from gigabrain_drivers.bodies.feetech.joint import JUMP_SLACK, ServoJoint
from gigabrain_drivers.bodies.feetech.protocol import (
    FIRST,
    LENGTH,
    RADIANS_PER_TICK,
    ServoMemory,
    ServoReadings,
)
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.links.serial_link import SerialLink, check_port, describe_absent
from gigabrain_schemas.base import Name, Pose, Velocity
from gigabrain_schemas.body import LinkHealth, RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, ConfigError, GigabrainError, unknown
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

FIRST_ANSWER_NS = 1_500_000_000  # that a start waits for the arm
RETRY_NS = 200_000_000  # between two attempts to find it
YIELD_NS = 500_000_000  # between two attempts to end an overload
SETTLED_TICKS = 6  # 0.5 deg: by no more may it move while it is switched on
ARM_ATTEMPTS = 10
VOLTS = {7.4: (4.5, 8.7), 12.0: (9.0, 14.5)}  # that a supply may have, by the servos' variant
VARIANT_LIMIT = 100  # 0.1 V, between the greatest voltages that the two variants take
Share = Annotated[float, Meta(ge=0.05, le=1.0)]


class FeetechOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bus's part of a robot's file."""

    port: str = f"usb:{feetech.USB_ID}"  # a path, or usb:VID:PID[:SERIAL]
    servos: dict[Name, Annotated[int, Meta(ge=0, le=feetech.MAX_ID)]]  # id, by the joint's name
    inverted: tuple[Name, ...] = ()  # joints that turn backward as the ticks go up
    voltage: float = 7.4  # [V], of the servos' variant: 7.4 or 12
    calibration: str = ""  # file, beside the robot's; empty: where calibrate keeps it
    rate_hz: Annotated[float, Meta(ge=50.0, le=200.0)] = 100.0  # of reading and writing
    torque_limit: Share = 1.0  # of the stall torque
    grip_torque: Share = 0.4  # of the stall torque, once the gripper touches something

    def __post_init__(self) -> None:
        check_port(self.port)
        if self.voltage not in VOLTS:
            raise ValueError(f"voltage: expected 7.4 or 12, got {self.voltage:g}")
        if len(set(self.servos.values())) < len(self.servos):
            raise ValueError("servos: each needs an id of its own")


class FeetechDriver(Driver):
    """Reads all servos, and sends all goals, `rate_hz` times a second."""

    Options = FeetechOptions

    def __init__(
        self,
        robot: RobotFile,
        options: FeetechOptions,
        run: Run,
        *,
        clock: Clock | None = None,
        link: Link | None = None,
    ) -> None:
        """`link` instead of the serial port that the options name."""
        super().__init__(robot, options, run)
        self._clock = clock or Clock()
        self.link = link or SerialLink(options.port, feetech.BAUD, self._clock)
        self._bus = HostBus(self.link, self._clock)
        self._joints: dict[str, ServoJoint] = {}
        self._armed = self._limp = False
        self._complaint = "not opened"  # while it is not armed
        self._found: dict[ServoJoint, str] = {}  # how each answered when it was last looked for
        self._failure: GigabrainError | None = None
        self._fault = Fault(log)
        self._yielded_ns = self._tried_ns = 0
        self._rewritten = 0
        self._cycles: asyncio.Task[None] | None = None

    @classmethod
    def check(cls, robot: RobotFile, options: FeetechOptions) -> None:
        """Raises ValueError where the servos are not those of the body's joints."""
        names = [joint.name for joint in robot.joints]
        for field, given in (("servos", options.servos), ("inverted", options.inverted)):
            for name in given:
                if name not in names:
                    raise ValueError(f"{field}: {unknown('joint', name, names)}")
        if missing := [name for name in names if name not in options.servos]:
            raise ValueError(f"servos: none for {', '.join(missing)}")

    @property
    def problem(self) -> str:
        """The reason in one line why the arm cannot be moved, or an empty text."""
        if self.link.problem:
            return line_problem(self.link)
        if not self._armed:
            return self._complaint
        now_ns = self._clock.now_ns()
        return next(filter(None, (joint.problem(now_ns) for joint in self._joints.values())), "")

    async def open(self) -> None:
        """Find the arm and have it hold; it may come later. Raises ConfigError for another one."""
        options = self.options
        path = calibration_path(self.robot.robot_type, options.calibration, self.run.folder)
        robot_type, joints = self.robot.robot_type, self.robot.joints
        calibration = load_calibration(path, robot_type, joints, options.servos)
        for joint in joints:
            self._joints[joint.name] = ServoJoint(
                joint,
                calibration.joints[joint.name],
                stall_torque=feetech.STALL_TORQUE[options.voltage],
                torque_limit=options.torque_limit,
                grip_torque=options.grip_torque,
            )
        self._limp = False
        self.link.open()
        until_ns = self._clock.now_ns() + FIRST_ANSWER_NS
        while not await self._find() and self._clock.now_ns() < until_ns:
            await self._clock.sleep_ns(RETRY_NS // 10)
        if not self.link.connected and not describe_absent(options.port):
            raise ConfigError(line_problem(self.link))
        self._cycles = asyncio.create_task(self._run(), name="servo bus")

    async def close(self) -> None:
        """Let go of the port; the arm holds what it was last told to."""
        cycles, self._cycles = self._cycles, None
        if cycles:
            await self.hold()
            cycles.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await cycles
            servo = next(iter(self._joints.values())).id
            await self._bus.ask(feetech.ping(servo), [servo], 0)  # the goals have gone out before
        self._armed = False
        await self.link.close()

    async def stop(self) -> None:
        """Come to rest, and hold: an arm that is let go falls."""
        await self.hold()

    async def hold(self) -> None:
        """Come to rest where it is, and stay there."""
        for joint in self._joints.values():
            joint.hold()
        await self._send_goals()

    async def limp(self) -> None:
        """Let go of all joints, until they are sent somewhere. Raises BodyLost."""
        self._limp = True
        for joint in self._joints.values():
            if not await self._bus.write(joint.id, feetech.TORQUE, 0):
                raise BodyLost(f"{joint} does not let go")

    async def set_joint_positions(self, positions: Mapping[str, float]) -> Mapping[str, float]:
        """Move joints [rad]; return what was sent, or what is measured where nothing can be.

        Joints that were let go of hold again where they are, before they move. Raises
        UnknownName before anything is sent.
        """
        for name in positions:
            if name not in self._joints:
                raise unknown("joint", name, [joint.name for joint in self.robot.joints])
        joints = {name: self._joints[name] for name in positions}
        if self._limp and self._armed:
            self._limp = bool(await self._arm())
        if self._limp or self.problem:
            return {name: joint.position for name, joint in joints.items()}
        sent = {name: joint.command(positions[name]) for name, joint in joints.items()}
        await self._send_goals()
        return sent

    async def read_state(self) -> RobotState:
        """Return the newest readings that are believed. Raises BodyLost, and ConfigError."""
        if self._failure:
            raise self._failure
        measured = (joint.measured() for joint in self._joints.values())
        return RobotState(
            robot_type=self.robot.robot_type,
            pose=Pose(x=0.0, y=0.0, yaw=0.0),
            velocity=Velocity(),
            joints=tuple(filter(None, measured)),
            joints_sent=() if self._limp or not self._armed else self._goals(),
            limp=self._limp,
            link=self._health(),
        )

    def _goals(self) -> tuple[float, ...]:
        return tuple(j.calibration.to_radians(j.goal) for j in self._joints.values())

    def report(self) -> Mapping[str, float | int | str | None]:
        """Return how often the bus failed, and what the driver did about it."""
        return {
            "bus_errors": self._bus.errors,
            "bus_unanswered": self._bus.unanswered,
            "readings_refused": self._refused(),
            "settings_rewritten": self._rewritten,
        }

    def _refused(self) -> int:
        return sum(joint.refused for joint in self._joints.values())

    def _health(self) -> LinkHealth:
        heard_ns = min((joint.heard_ns for joint in self._joints.values()), default=0)
        self.link.errors = self._bus.errors + self._refused()
        return replace(
            self.link.health,
            connected=not self.problem,
            age_ms=max(0, self._clock.now_ns() - heard_ns) / 1e6,
        )

    async def _run(self) -> None:
        """Read and write until cancelled, or until the arm is lost."""
        async for now_ns in self._clock.every(round(1e9 / self.options.rate_hz)):
            try:
                await self._cycle(now_ns)
            except GigabrainError as error:
                self._failure = error
                return

    async def _cycle(self, now_ns: int) -> None:
        self._armed = self._armed and self.link.connected
        if not self._armed:
            if now_ns - self._tried_ns >= RETRY_NS:
                self._tried_ns = now_ns
                await self._find()
        else:
            await self._read(now_ns)
            if not self._limp:
                await self._keep(now_ns)
        if problem := self.problem:
            self._fault.begin(problem)
        else:
            self._fault.end(f"{self.link}: the arm answers")

    async def _read(self, now_ns: int) -> None:
        servos = [joint.id for joint in self._joints.values()]
        question = feetech.sync_read(servos, FIRST, LENGTH)
        answers = await self._bus.ask(question, servos, LENGTH, ANSWER_TIMEOUT_NS)
        for joint in self._joints.values():
            if joint.id in answers:
                joint.take(feetech.decode_readings(answers[joint.id][1:]), now_ns)

    async def _keep(self, now_ns: int) -> None:
        """Have each servo hold its goal with the right settings, and see to those that fail."""
        for joint in self._joints.values():
            if joint.let_go and not joint.status:
                await self._catch(joint)
            elif joint.status & feetech.OVERLOAD and now_ns - self._yielded_ns >= YIELD_NS:
                self._yielded_ns = now_ns
                joint.yield_to_load()  # a goal that gives way ends the protection
        if self.problem:
            for joint in self._joints.values():
                joint.hold()
        await self._send_settings(now_ns)
        await self._send_goals()

    async def _catch(self, joint: ServoJoint) -> None:
        """Have a servo that has started again hold where it is. Raises BodyLost always."""
        joint.yield_to_load()
        settings = joint.settings(self._clock.now_ns()).frame_part(joint.goal)
        address = feetech.ACCELERATION.address
        await self._bus.send(feetech.sync_write(address, {joint.id: settings}))
        caught = await self._bus.write(joint.id, feetech.TORQUE, 1)
        text = "it holds again" if caught else "and could not be caught"
        raise BodyLost(f"{joint} had let go by itself, {text}: is its supply too weak?")

    async def _send_settings(self, now_ns: int) -> None:
        """Write the settings of servos that do not have them, as after a disturbed write."""
        parts = {}
        for joint in self._joints.values():
            wanted = joint.settings(now_ns)
            if not joint.holds(wanted):
                parts[joint.id] = wanted.frame_part(joint.goal)
        if parts:
            self._rewritten += len(parts)
            await self._bus.send(feetech.sync_write(feetech.ACCELERATION.address, parts))

    async def _send_goals(self) -> None:
        if self._armed and not self._limp:
            goals = {joint.id: feetech.GOAL.encode(joint.goal) for joint in self._joints.values()}
            await self._bus.send(feetech.sync_write(feetech.GOAL.address, goals))

    async def _find(self) -> bool:
        """Look for the whole arm, and have it hold; return whether it does. Raises ConfigError."""
        if not self.link.connected:
            return False
        before, self._found = (
            self._found,
            {joint: await self._bus.find(joint.id) for joint in self._joints.values()},
        )
        if set(self._found.values()) == {"missing"}:
            self._complaint = f"{self.link} is open, but no servo answers: right port, power on?"
            return False
        if self._found != before:  # its power may just have been switched on
            self._complaint = f"{self.link}: the arm has just begun to answer"
            return False
        refuse_incomplete(str(self.link), {str(joint): how for joint, how in self._found.items()})
        for joint in self._joints.values():
            await self._check_servo(joint)
        self._complaint = await self._arm()
        self._armed = not self._complaint
        return self._armed

    async def _check_servo(self, joint: ServoJoint) -> None:
        """Raise ConfigError where a servo is not the one that was calibrated."""
        data = await self._bus.read(joint.id, 0, feetech.EEPROM_SIZE)
        if data is None:
            raise ConfigError(f"{self.link}: {joint} does not answer any more")
        memory, voltage = feetech.decode_memory(data), self.options.voltage
        if memory.model != feetech.MODEL or memory.mode:
            raise ConfigError(
                f"{self.link}: {joint} is of model {memory.model} in mode {memory.mode}; "
                f"expected an STS3215 (model {feetech.MODEL}) in mode 0, position"
            )
        if (memory.max_voltage > VARIANT_LIMIT) != (voltage > VARIANT_LIMIT / 10):
            raise ConfigError(
                f"{self.link}: {joint} takes up to {memory.max_voltage / 10:g} V, but the "
                f"robot's file has servos of {voltage:g} V; change voltage there"
            )
        if not joint.calibration.is_of(memory):
            raise ConfigError(_other_arm(self.robot.robot_type, joint, memory))

    async def _arm(self) -> str:
        """Have all servos hold, without a motion; return why not, or an empty text.

        Raises ConfigError where the supply is not that of the servos.
        """
        for joint in self._joints.values():
            first, now = await self._block(joint), await self._block(joint)
            if first is None or now is None:
                return f"{joint} answers only at times"
            if abs(first.position - now.position) * RADIANS_PER_TICK > 2 * JUMP_SLACK:
                return f"{joint} is being moved: let go of the arm"
            self._check_supply(joint, now)
            if outside := _outside(joint, now):
                return (
                    f"{joint} is {math.degrees(outside):.0f} deg outside its calibrated range: "
                    "move it back by hand, or calibrate again"
                )
            joint.begin(now, self._clock.now_ns())
        for _ in range(ARM_ATTEMPTS):
            if await self._switched_on():
                return ""
        return "the arm moves while it is switched on: let go of it"

    async def _switched_on(self) -> bool:
        """Give each servo its goal, and torque once it is seen to be there."""
        now_ns = self._clock.now_ns()
        parts = {j.id: j.settings(now_ns).frame_part(j.goal) for j in self._joints.values()}
        await self._bus.send(feetech.sync_write(feetech.ACCELERATION.address, parts))
        for joint in self._joints.values():
            now = await self._block(joint)
            if now is None:
                return False
            if not now.torque and abs(now.position - now.goal) > SETTLED_TICKS:
                joint.begin(now, self._clock.now_ns())
                return False
            if now.goal != joint.goal:
                return False
            locked = now.lock == 1 or await self._bus.write(joint.id, feetech.LOCK, 1)
            if not locked or not await self._bus.write(joint.id, feetech.TORQUE, 1):
                return False
            if on := await self._block(joint):
                joint.begin(on, self._clock.now_ns())
        return True

    async def _block(self, joint: ServoJoint) -> ServoReadings | None:
        data = await self._bus.read(joint.id, FIRST, LENGTH)
        return feetech.decode_readings(data) if data else None

    def _check_supply(self, joint: ServoJoint, now: ServoReadings) -> None:
        volts, voltage = now.voltage * feetech.VOLTAGE_UNIT, self.options.voltage
        least, most = VOLTS[voltage]
        if not least <= volts <= most:
            raise ConfigError(
                f"{self.link}: {joint} measures {volts:.1f} V; expected {least:g} to {most:g} V "
                f"for servos of {voltage:g} V: wrong supply, or wrong voltage in the robot's file"
            )


def line_problem(link: Link) -> str:
    """Return what is wrong with a line, with its name."""
    problem, name = link.problem, str(link)
    return problem if name in problem else f"{name}: {problem}"


def refuse_incomplete(port: str, found: Mapping[str, str]) -> None:
    """Raise ConfigError where a servo is missing, or two have the same id."""
    missing = ", ".join(servo for servo, how in found.items() if how == "missing")
    garbled = ", ".join(servo for servo, how in found.items() if how == "garbled")
    if garbled:
        also = f", and {missing} is missing" if missing else ""
        raise ConfigError(
            f"{port}: what answers as {garbled} is garbled{also}: "
            "two servos have the same id, or the cable is bad; give each servo its own id"
        )
    if missing:
        raise ConfigError(
            f"{port}: {missing} does not answer: are its cable and its power plugged in, "
            "and does it have this id?"
        )


def _other_arm(robot_type: str, joint: ServoJoint, memory: ServoMemory) -> str:
    its = joint.calibration
    return (
        f"{joint} keeps offset {memory.offset} and limits {memory.min_position} to "
        f"{memory.max_position}, its calibration has {its.offset} and {its.min_position} to "
        f"{its.max_position}: this is another arm; run gigabrain driver calibrate {robot_type}"
    )


def _outside(joint: ServoJoint, now: ServoReadings) -> float:
    """Return by how much it is where switching it on would move it [rad], 0 where it is not."""
    its, at = joint.calibration, now.position
    slack = round(OUTSIDE / RADIANS_PER_TICK)
    lower = max(its.min_position - SETTLED_TICKS, its.lower - slack)
    upper = min(its.max_position + SETTLED_TICKS, its.upper + slack)
    return max(lower - at, at - upper, 0) * RADIANS_PER_TICK
