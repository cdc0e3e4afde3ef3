"""An arm on a bus of Feetech STS servos, and the wheels of its base if it has one.

The servos hold their goals by themselves: if the driver dies, the arm stays where it is. Wheels
would keep turning, so a guard stops them. A start never moves the arm: a servo that holds keeps its
goal, another one gets its present position as goal.
"""

import asyncio
import contextlib
import logging
from collections.abc import Mapping
from typing import Annotated

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.arming import VOLTS, Arming
from gigabrain_drivers.bodies.feetech.bus import ANSWER_TIMEOUT_NS, HostBus
from gigabrain_drivers.bodies.feetech.calibration import calibration_path, load_calibration
from gigabrain_drivers.bodies.feetech.joint import ServoJoint
from gigabrain_drivers.bodies.feetech.protocol import FIRST, LENGTH
from gigabrain_drivers.bodies.feetech.wheels import ServoBase, ServoWheel, check_wheels
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.lidars.base import ScanSource, open_lidar
from gigabrain_drivers.links.line_guard import SILENCE_NS
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.links.serial_link import SerialLink, check_port, describe_absent
from gigabrain_schemas.base import Name, Pose, Velocity
from gigabrain_schemas.body import LinkHealth, RobotState
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, ConfigError, GigabrainError, unknown
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

NO_ANSWER = "is open, but no servo answers: right port, power on?"
CONNECT_S = 3.0
FIRST_ANSWER_NS = 1_500_000_000  # wait for the arm at a start
RETRY_NS = 200_000_000  # between two attempts to find it
COMMAND_TIMEOUT_NS = 80_000_000  # after this time without a command, so that wheels stop by 100 ms
YIELD_NS = 500_000_000  # between two attempts to end an overload
ServoId = Annotated[int, Meta(ge=0, le=feetech.MAX_ID)]
Share = Annotated[float, Meta(ge=0.05, le=1.0)]


class FeetechOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The bus's fields in a robot's file."""

    port: str = f"usb:{feetech.USB_ID}"  # a path, or usb:VID:PID[:SERIAL]
    servos: dict[Name, ServoId]  # by the joint's name
    wheels: Mapping[Name, ServoId] = msgspec.field(default_factory=dict)  # by the wheel's name
    inverted: tuple[Name, ...] = ()  # joints and wheels whose ticks decrease in forward motion
    voltage: float = 7.4  # [V], of the servos' variant: 7.4 or 12
    calibration: str = ""  # file, relative to the robot's; empty: the default of calibrate
    rate_hz: Annotated[float, Meta(ge=50.0, le=200.0)] = 100.0  # of reading and writing
    torque_limit: Share = 1.0  # of the stall torque
    grip_torque: Share = 0.4  # of the stall torque, while the gripper touches something

    def __post_init__(self) -> None:
        check_port(self.port)
        if self.voltage not in VOLTS:
            raise ValueError(f"voltage: expected 7.4 or 12, got {self.voltage:g}")
        ids = [*self.servos.values(), *self.wheels.values()]
        if len(set(ids)) < len(ids):
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
        """`link` replaces the serial port in the options."""
        super().__init__(robot, options, run)
        self._clock = clock or Clock()
        self.link = link or SerialLink(options.port, feetech.BAUD, self._clock)
        self._bus = HostBus(self.link, self._clock)
        self._arming = Arming(self._bus, self._clock, robot.robot_type, options.voltage)
        self._base = ServoBase(robot, options, self._bus, self._arming) if options.wheels else None
        self._wheels = self._base.wheels if self._base else []
        self._joints: dict[str, ServoJoint] = {}
        self._armed = self._limp = False
        self._complaint = "not opened"  # why it is not armed, or does not hold again
        self._found: dict[ServoJoint | ServoWheel, str] = {}  # results of the search
        self._failure: GigabrainError | None = None
        self._fault = Fault(log)
        self._tried_ns = self._commanded_ns = 0
        self._yielded_ns: dict[ServoJoint | ServoBase, int] = {}
        self._rewritten = 0
        self._cycles: asyncio.Task[None] | None = None
        self._lidar: ScanSource | None = None
        self.sensors = {"scan": None} if robot.lidar else {}

    @classmethod
    def check(cls, robot: RobotFile, options: FeetechOptions) -> None:
        """Raise ValueError if the servos do not match the body's joints."""
        names = [joint.name for joint in robot.joints]
        if not names:
            raise ValueError("servos: this body has no joints; expected an arm on its servo bus")
        parts = [*names, *options.wheels]
        for field, given, known in (
            ("servos", options.servos, names),
            ("inverted", options.inverted, parts),
        ):
            for name in given:
                if name not in known:
                    raise ValueError(f"{field}: {unknown('joint', name, known)}")
        if missing := [name for name in names if name not in options.servos]:
            raise ValueError(f"servos: none for {', '.join(missing)}")
        if options.wheels or robot.drive_type != "arm":
            check_wheels(robot, options.wheels)

    @property
    def problem(self) -> str:
        """The reason in one line why the arm cannot be moved, or an empty text."""
        return self._trouble() or (self._complaint if self._limp else "")

    def _trouble(self) -> str:
        """Return the problem of the line or a servo as one line, or an empty text."""
        if self.link.problem:
            return line_problem(self.link)
        if not self._armed:
            return self._complaint
        now_ns = self._clock.now_ns()
        return next(filter(None, (servo.problem(now_ns) for servo in self._servos())), "")

    @property
    def guard_ms(self) -> float | None:
        """Time to stop the wheels if this process dies; None for an arm, which holds by itself."""
        return SILENCE_NS / 1e6 if self._base else None

    def _servos(self) -> list[ServoJoint | ServoWheel]:
        return [*self._joints.values(), *self._wheels]

    async def open(self) -> None:
        """Find and switch on the arm; it may appear later. Raises ConfigError for another arm."""
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
        self._lidar = open_lidar(self, self._clock)
        self.link.open()
        until_ns = self._clock.now_ns() + FIRST_ANSWER_NS
        while not await self._find() and self._clock.now_ns() < until_ns:
            await self._clock.sleep_ns(RETRY_NS // 10)
        if not self.link.connected and not describe_absent(options.port):
            raise ConfigError(line_problem(self.link))
        self._cycles = asyncio.create_task(self._run(), name="servo bus")

    async def close(self) -> None:
        """Stop the wheels and close the ports; the arm holds its last goal."""
        cycles, self._cycles = self._cycles, None
        if cycles:
            await self.hold()
            cycles.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await cycles
            servo = next(iter(self._joints.values())).id
            await self._bus.ask(feetech.ping(servo), [servo], 0)  # answers after the goals
        self._armed = False
        if self._base:
            await self._base.close()
        await self.link.close()
        if self._lidar:
            await self._lidar.close()

    async def stop(self) -> None:
        """Come to rest, and hold: a limp arm would fall."""
        await self.hold()

    async def hold(self) -> None:
        """Come to rest, and hold the position."""
        for joint in self._joints.values():
            joint.hold()
        await self._send_goals()
        if self._base:
            self._base.stop()
            await self._base.send()

    async def limp(self) -> None:
        """Switch off all joints, until their next positions. Raises BodyLost."""
        if not self._armed:
            raise BodyLost(self.problem)
        self._limp = True
        for joint in self._joints.values():
            if not await self._bus.write(joint.id, feetech.TORQUE, 0):
                raise BodyLost(f"{joint} does not switch off")

    async def set_joint_positions(self, positions: Mapping[str, float]) -> Mapping[str, float]:
        """Move joints [rad]; return the sent positions, or the measured ones if it cannot send.

        Limp joints first hold their position, before they move. Raises UnknownName before it sends
        anything.
        """
        for name in positions:
            if name not in self._joints:
                raise unknown("joint", name, [joint.name for joint in self.robot.joints])
        joints = {name: self._joints[name] for name in positions}
        if self._limp and self._armed:
            self._complaint = await self._arming.arm(self._joints.values())
            self._limp = bool(self._complaint)
        if self._limp or self._trouble():
            return {name: joint.position for name, joint in joints.items()}
        sent = {name: joint.command(positions[name]) for name, joint in joints.items()}
        await self._send_goals()
        return sent

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive, if there are wheels. It sends nothing while the robot has a problem."""
        if self._base is None:
            return await super().set_base_velocity(linear_x, linear_y, angular_z)
        self._commanded_ns = self._clock.now_ns()
        wanted = ZERO if self._trouble() else self.bounded(linear_x, linear_y, angular_z)
        sent = self._base.command(wanted)
        if self._bus.busy:  # the cycle sends it after its answers
            return sent
        return sent if await self._base.send() else ZERO

    async def read_state(self) -> RobotState:
        """Return the newest accepted readings. Raises BodyLost, and ConfigError."""
        if self._failure:
            raise self._failure
        base, measured = self._base, (joint.measured() for joint in self._joints.values())
        return RobotState(
            robot_type=self.robot.robot_type,
            pose=base.pose if base else Pose(x=0.0, y=0.0, yaw=0.0),
            velocity=base.velocity if base else ZERO,
            joints=(*(base.joints() if base else ()), *filter(None, measured)),
            joints_sent=() if self._limp or not self._armed else self._goals(),
            limp=self._limp,
            link=self._health(),
        )

    def _goals(self) -> tuple[float, ...]:
        return tuple(j.calibration.to_radians(j.goal) for j in self._joints.values())

    def report(self) -> Mapping[str, float | int | str | None]:
        """Return counts of failures of the bus, and of corrections by the driver."""
        return {
            "bus_errors": self._bus.errors,
            "bus_unanswered": self._bus.unanswered,
            "readings_refused": self._refused(),
            "settings_rewritten": self._rewritten,
        }

    def _refused(self) -> int:
        return sum(servo.refused for servo in self._servos())

    def _health(self) -> LinkHealth:
        received_ns = min((servo.received_ns for servo in self._servos()), default=0)
        self.link.errors = self._bus.errors + self._refused()
        return replace(
            self.link.health,
            connected=not self._trouble(),
            age_ms=max(0, self._clock.now_ns() - received_ns) / 1e6,
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
            if self._base:
                await self._keep_base(self._base, now_ns)
            if not self._limp:
                await self._keep(now_ns)
        if problem := self.problem:
            self._fault.begin(problem)
        else:
            self._fault.end(f"{self.link}: the arm answers")

    async def _read(self, now_ns: int) -> None:
        servos = [servo.id for servo in self._servos()]
        question = feetech.sync_read(servos, FIRST, LENGTH)
        answers = await self._bus.ask(question, servos, LENGTH, len(servos) * ANSWER_TIMEOUT_NS)
        readings = {n: feetech.decode_readings(answer[1:]) for n, answer in answers.items()}
        for joint in self._joints.values():
            if joint.id in readings:
                joint.take(readings[joint.id], now_ns)
        if self._base:
            self._base.take(readings, now_ns)

    async def _keep_base(self, base: ServoBase, now_ns: int) -> None:
        """Turn the wheels as commanded, or stop them while there is a problem."""
        if self._trouble() or self._clock.now_ns() - self._commanded_ns > COMMAND_TIMEOUT_NS:
            base.stop()
        if base.overloaded and self._yields(base, now_ns):
            await base.end_overload()
        self._rewritten += await base.keep()
        await base.send()

    async def _keep(self, now_ns: int) -> None:
        """Restore goals and settings of all servos, and handle failing ones."""
        for joint in self._joints.values():
            if joint.let_go and not joint.status:
                await self._catch(joint)
            elif joint.status & feetech.OVERLOAD and self._yields(joint, now_ns):
                joint.yield_to_load()  # a goal at its position ends the protection
        if self._trouble():
            for joint in self._joints.values():
                joint.hold()
        await self._send_settings(now_ns)
        await self._send_goals()

    def _yields(self, overloaded: ServoJoint | ServoBase, now_ns: int) -> bool:
        """Return whether an attempt to end its overload is due; if so, record it."""
        due = now_ns - self._yielded_ns.get(overloaded, 0) >= YIELD_NS
        if due:
            self._yielded_ns[overloaded] = now_ns
        return due

    async def _catch(self, joint: ServoJoint) -> None:
        """Switch on a restarted servo at its position. Always raises BodyLost."""
        joint.yield_to_load()
        settings = joint.settings(self._clock.now_ns()).frame_part(joint.goal)
        address = feetech.ACCELERATION.address
        await self._bus.send(feetech.sync_write(address, {joint.id: settings}))
        caught = await self._bus.write(joint.id, feetech.TORQUE, 1)
        text = "it holds again" if caught else "and it could not be switched on again"
        raise BodyLost(f"{joint} had switched itself off, {text}: is its supply too weak?")

    async def _send_settings(self, now_ns: int) -> None:
        """Write settings to servos that lack them, as after a disturbed write."""
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
        """Find all servos, and switch them on unless limp; return whether all were found.

        Raises ConfigError.
        """
        if not self.link.connected:
            return False
        if self._base:  # an earlier process may have left its wheels turning
            self._base.stop()
            await self._base.send()
        before, self._found = (
            self._found,
            {servo: await self._bus.find(servo.id) for servo in self._servos()},
        )
        if set(self._found.values()) == {"missing"}:
            self._complaint = f"{self.link} {NO_ANSWER}"
            return False
        if self._found != before:  # its power may have been switched on just now
            self._complaint = f"{self.link}: the arm has just begun to answer"
            return False
        refuse_incomplete(str(self.link), {str(joint): how for joint, how in self._found.items()})
        for joint in self._joints.values():
            await self._arming.check(joint)
        prepare = self._arming.measure if self._limp else self._arming.arm
        self._complaint = await prepare(self._joints.values())
        if self._base and not self._complaint:
            self._complaint = await self._base.start(self._clock.now_ns())
        self._armed = not self._complaint
        return self._armed


def line_problem(link: Link) -> str:
    """Return the problem of a line, with its name."""
    problem, name = link.problem, str(link)
    return problem if name in problem else f"{name}: {problem}"


async def until_open(link: Link) -> None:
    """Open a link, and wait for its port. Raises ConfigError if it cannot be opened."""
    opened = asyncio.Event()
    link.on_open = opened.set
    link.open()
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(opened.wait(), CONNECT_S)
    if not link.connected:
        raise ConfigError(line_problem(link))


def refuse_incomplete(port: str, found: Mapping[str, str]) -> None:
    """Raise ConfigError if a servo is missing, or two have the same id."""
    if set(found.values()) == {"missing"}:
        raise ConfigError(f"{port} {NO_ANSWER}")
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
