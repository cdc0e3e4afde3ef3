"""TurtleBot3 on its real link: the OpenCR board on USB, and its lidar on another port.

With the vendor's stack the body drives on when commands end (turtlebot3#1154). This driver stops it
after 100 ms. If the driver itself dies, the board stops it after 500 ms.
"""

import asyncio
import contextlib
import logging
import math
from collections.abc import Callable

import serial
from msgspec.structs import asdict, replace

from gigabrain_drivers.bodies.turtlebot3 import protocol as opencr
from gigabrain_drivers.bodies.turtlebot3.protocol import Readings
from gigabrain_drivers.driver.base import Driver
from gigabrain_drivers.driver.robot import LinkOptions, RobotFile, Run
from gigabrain_drivers.kinematics.wheels import (
    Differential,
    Encoders,
    Twist,
    WheelOdometry,
    wheels_of,
)
from gigabrain_drivers.lidars.base import ScanSource, open_lidar
from gigabrain_drivers.links.frames import Spelling, Wording
from gigabrain_drivers.links.link import Link
from gigabrain_drivers.links.serial_link import SerialLink, check_port
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Battery, Joint, LinkHealth, RobotState
from gigabrain_schemas.sensors import Imu, ImuData
from gigabrain_schemas.topics import IMU
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.errors import BodyLost, ConfigError

log = logging.getLogger(__name__)

LOST_NS = 100_000_000  # the board counts as lost after this time without an answer
GIVE_UP_NS = 160_000_000  # then its line is closed, and queued bytes are dropped
PING_PERIOD_NS = 100_000_000  # between two attempts to get a first answer
FIRST_ANSWER_TIMEOUT_NS = 1_000_000_000  # then the port is reopened
LOG_AFTER_NS = 500_000_000  # a problem is logged after this time
ANSWER_TIMEOUT_S = 0.01  # for the answer to a question
ANSWER_BYTES = 14  # of the answer to a ping
WATCHDOG_FIRMWARE = 5  # in older versions, the debug mode's byte is part of a clock

GUARD_PERIOD_NS = 20_000_000  # between two checks by the driver
COMMAND_TIMEOUT_NS = 80_000_000  # after this time without a command, so that zero is sent by 100 ms
FLUSH_S = 0.05  # for the last zero to arrive before the port is closed
JOINTS = ("wheel_left_joint", "wheel_right_joint")
PUSHED_FACTOR = 1.5  # factor on the maximal speed, for a body that is pushed
TURN_SLACK_RAD = 0.1  # [rad], tolerance; a larger jump between two readings is a counter reset
RESTART_MS = 500  # the board's clock is off by at least this after a restart
MAX_IMU_VALUE = 1000.0  # [m/s2] and [rad/s]; larger values are no measurements


class Board:
    """The OpenCR board on its line. Each question has a new heartbeat, and its answer returns it.

    So a late answer never counts as fresh. Bytes before the answer to the first ping on a newly
    opened port are ignored. Every connection begins with zero velocity.
    """

    def __init__(self, link: Link, clock: Clock) -> None:
        self.link = link
        self.link.on_open, self.link.on_lost = self._opened, self._lost
        self.link.on_bytes = self._take
        self.link.wording = Wording(
            Spelling(opencr.DynamixelDecoder().feed, opencr.describe),
            Spelling(opencr.DynamixelDecoder().feed, opencr.describe),
        )
        self.on_readings: Callable[[Readings], None] = _ignore  # set by the owner
        self._clock = clock
        self._decoder = opencr.DynamixelDecoder()
        self._firmware: int | None = None  # of the board on the open port, after its first answer
        self._beat = 0
        self._answered = asyncio.Event()
        self._opened_ns = self._pinged_ns = self._asked_ns = self._fresh_ns = clock.now_ns()
        self._waiting_ns: int | None = None  # time of the oldest unanswered question
        self._newest: Readings | None = None
        self._complaint = "not there yet"
        self._well_ns = clock.now_ns()

    @property
    def ready(self) -> bool:
        """True while commands reach an OpenCR."""
        return self._firmware is not None

    @property
    def health(self) -> LinkHealth:
        """The link's health: connected if the board answers; the age is that of its last answer."""
        age_ns = self._clock.now_ns() - self._fresh_ns
        return replace(
            self.link.health,
            connected=self.ready and age_ns <= LOST_NS and not self._fault(),
            age_ms=age_ns / 1e6,
            late_ms=0.0,  # late answers are dropped
        )

    @property
    def problem(self) -> str:
        """The reason in one line why the body cannot be driven, or an empty text."""
        if self.link.problem:
            return self.link.problem
        if not self.ready:
            return f"{self.link} is open, but no OpenCR answers: right port, power on?"
        return self._fault()

    def halt(self) -> bool:
        """Send zero velocity, even before a board has answered."""
        return self.link.write(opencr.velocity(0.0, 0.0).frame)

    def release_motors(self) -> bool:
        """Switch off the motors' torque, until the driver finds the board again."""
        return self.link.write(opencr.torque(on=False))

    def drive(self, linear_x: float, angular_z: float) -> tuple[float, float]:
        """Send a velocity [m/s], [rad/s]; return the one that was sent, rounded."""
        sent = opencr.velocity(linear_x, angular_z)
        if self.ready and self.link.write(sent.frame):
            return sent.linear_x, sent.angular_z
        return 0.0, 0.0

    async def ask(self, patience_s: float = ANSWER_TIMEOUT_S) -> None:
        """Request the table and wait for it; `on_readings` gets it, possibly later."""
        if not self.ready:
            return
        self._beat = self._beat + 1 & 0xFF
        self._asked_ns = self._clock.now_ns()
        self._waiting_ns = self._waiting_ns or self._asked_ns
        self._answered.clear()
        if self.link.write(opencr.heartbeat(self._beat) + opencr.ask()):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(patience_s):
                    await self._answered.wait()

    def supervise(self, now_ns: int) -> None:
        """Ping a board that has not answered; reopen the port after a timeout. Call it often."""
        self._log_problem(now_ns)
        if not self.link.connected:
            return
        if self._waiting_ns and now_ns - self._waiting_ns > GIVE_UP_NS:
            self.link.drop("the OpenCR has stopped answering")
        elif not self.ready and now_ns - self._opened_ns > FIRST_ANSWER_TIMEOUT_NS:
            self.link.drop(self.problem)
        elif not self.ready and now_ns - self._pinged_ns >= PING_PERIOD_NS:
            self._ping()

    def _log_problem(self, now_ns: int) -> None:
        """Log a lasting problem once when it begins, and once when it ends."""
        problem, before = self.problem, self._complaint
        if not problem:
            self._well_ns = now_ns
        elif now_ns - self._well_ns < LOG_AFTER_NS:
            return
        if problem == before:
            return
        self._complaint = problem
        if problem:
            log.warning("%s", problem)
        else:
            log.info("OpenCR on %s answers, firmware %s", self.link, self._firmware)

    def _fault(self) -> str:
        """Return the fault that the board reports, or an empty text."""
        newest = self._newest
        if newest and newest.device_status == opencr.MOTORS_SILENT:
            return "OpenCR reaches no motors: switch their power on, then press its reset button"
        if newest and newest.watchdog_off and (self._firmware or 0) >= WATCHDOG_FIRMWARE:
            return "OpenCR is in debug mode, in which it does not stop by itself: restart it"
        return ""

    def _opened(self) -> None:
        self._decoder.clear()
        self._firmware = self._waiting_ns = None
        self._opened_ns = self._clock.now_ns()
        self._ping()

    def _lost(self, _why: str) -> None:
        self._firmware = self._waiting_ns = None

    def _ping(self) -> None:
        """Send zero, then ping the board; so a queued old command cannot last."""
        self._pinged_ns = self._clock.now_ns()
        self.halt()
        self.link.write(opencr.ping(opencr.ID))

    def _take(self, data: bytes) -> None:
        for packet in self._decoder.feed(data):
            if packet.id != opencr.ID or packet.instruction != opencr.STATUS:
                continue
            answer = packet.params[1:]
            if model := opencr.decode_model(answer):
                self._recognise(*model)
            elif self.ready and len(answer) == opencr.LENGTH:
                self._read(opencr.decode_readings(answer))
        self.link.errors = self._decoder.errors

    def _recognise(self, model: int, firmware: int) -> None:
        if model != opencr.MODEL:
            self.link.drop(f"{self.link} leads to a Dynamixel of model {model}, not to an OpenCR")
        elif not self.ready:
            self._firmware = firmware
            self.halt()
            self.link.write(opencr.torque(on=True))

    def _read(self, now: Readings) -> None:
        if now.heartbeat != self._beat:  # the answer to an abandoned question
            return
        self._fresh_ns, self._waiting_ns, self._newest = self._asked_ns, None, now
        self.on_readings(now)
        self._answered.set()


def is_opencr(port: serial.Serial) -> bool:
    """Return whether an OpenCR answers on this port. Runs in a thread; may raise OSError."""
    port.write(opencr.ping(opencr.ID))
    answers = opencr.DynamixelDecoder().feed(port.read(ANSWER_BYTES))
    models = [opencr.decode_model(packet.params[1:]) for packet in answers]
    return any(model is not None and model[0] == opencr.MODEL for model in models)


def _ignore(_: Readings) -> None:
    pass


class OpenCrOptions(LinkOptions, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The board's part of a robot's file."""

    port: str = f"usb:{opencr.USB_ID}"  # a path, usb:VID:PID[:SERIAL], or auto

    def __post_init__(self) -> None:
        check_port(self.port)


class OpenCrDriver(Driver):
    """Requests the board's whole state once a tick, and sends commands at once."""

    Options = OpenCrOptions

    def __init__(
        self,
        robot: RobotFile,
        options: OpenCrOptions,
        run: Run,
        *,
        clock: Clock | None = None,
        link: Link | None = None,
    ) -> None:
        """`link` replaces the serial port in the options."""
        super().__init__(robot, options, run)
        base = wheels_of(robot)
        if not isinstance(base, Differential):
            raise ConfigError(
                f"{robot.robot_type}: OpenCR drives a differential base; expected its "
                "wheel_radius and wheel_separation"
            )
        self._clock = clock or Clock()
        self.link = link or SerialLink(options.port, opencr.BAUD, self._clock, probe=is_opencr)
        self._board = Board(self.link, self._clock)
        self._board.on_readings = self._take
        self._base, self._odometry = base, WheelOdometry(base)
        self._encoders = Encoders(opencr.TICKS, bits=32)
        self._commanded_ns = self._clock.now_ns()
        self._milliseconds, self._received_ns = 0, 0  # the board's clock, and ours, as last read
        self._state = RobotState(
            robot_type=robot.robot_type, pose=Pose(x=0.0, y=0.0, yaw=0.0), velocity=Velocity()
        )
        self.sensors = dict.fromkeys(("imu", "scan") if options.scan else ("imu",))
        self._lidar: ScanSource | None = None
        self._guard: asyncio.Task[None] | None = None

    @property
    def problem(self) -> str:
        """The reason in one line why the body cannot be driven, or an empty text."""
        return self._board.problem

    async def open(self) -> None:
        """Start connecting to the board and the lidar; both may appear later."""
        self._lidar = open_lidar(self, self._clock)
        self.link.open()
        self._guard = asyncio.create_task(self._guard_motion(), name="opencr guard")

    async def close(self) -> None:
        """Stop the body, and close the ports."""
        await self.stop()
        guard, self._guard = self._guard, None
        if guard:
            guard.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await guard
            await self._board.ask(FLUSH_S)  # its answer shows that it has read the zero
        await self.link.close()
        if self._lidar:
            await self._lidar.close()

    async def stop(self) -> None:
        """Send zero velocity, at once."""
        self._commanded_ns = self._clock.now_ns()
        self._board.halt()

    async def limp(self) -> None:
        """Let the wheels turn freely, until the next start of a driver."""
        if not self._board.release_motors():
            raise BodyLost(self.problem or f"{self.link} takes no commands")

    async def set_base_velocity(
        self, linear_x: float, linear_y: float, angular_z: float
    ) -> Velocity:
        """Drive, in steps of 0.01. All speeds are zero if one is not a number."""
        self._commanded_ns = self._clock.now_ns()
        to = self.bounded(linear_x, linear_y, angular_z)
        wanted = Twist(to.linear_x, 0.0, to.angular_z)
        # the board would limit only the faster wheel, and so change the path
        too_fast = max(
            1.0, *(abs(w) / opencr.MAX_WHEEL_SPEED for w in self._base.to_wheels(wanted))
        )
        forward, turn = self._board.drive(wanted.linear_x / too_fast, wanted.angular_z / too_fast)
        return Velocity(linear_x=forward, angular_z=turn)

    async def read_state(self) -> RobotState:
        """Return the board's present state; without an answer the last one, with its age."""
        await self._board.ask()
        return replace(self._state, link=self._board.health)

    async def _guard_motion(self) -> None:
        """Send zero repeatedly while there are no commands: a single frame may get lost."""
        async for now_ns in self._clock.every(GUARD_PERIOD_NS):
            if now_ns - self._commanded_ns >= COMMAND_TIMEOUT_NS and self._board.ready:
                self._board.halt()
            self._board.supervise(now_ns)

    def _take(self, now: Readings) -> None:
        turned = self._encoders.turned(now.ticks)
        now_ns, passed = self._clock.now_ns(), now.milliseconds - self._milliseconds
        if abs((now_ns - self._received_ns) / 1e6 - passed) > RESTART_MS:
            passed = 0  # its counters have restarted
        self._milliseconds, self._received_ns = now.milliseconds, now_ns
        furthest = PUSHED_FACTOR * opencr.MAX_WHEEL_SPEED * passed / 1000 + TURN_SLACK_RAD
        if max(map(abs, turned)) <= furthest:
            self._odometry.add(turned)
        moves = self._base.to_body(now.velocities)
        wheels = zip(JOINTS, now.ticks, now.velocities, strict=True)
        self._state = replace(
            self._state,
            pose=self._odometry.pose,
            velocity=Velocity(linear_x=moves.linear_x, angular_z=moves.angular_z),
            joints=tuple(
                Joint(name=name, position=ticks * opencr.RADIANS_PER_TICK, velocity=velocity)
                for name, ticks, velocity in wheels
            ),
            battery=Battery(voltage=now.voltage, percentage=now.percentage),
            imu=imu_data(now),
            bumpers=now.bumpers,
        )
        if imu := self._state.imu:
            self.publish("imu", IMU, Imu(**asdict(imu)))


def imu_data(now: Readings) -> ImuData | None:
    """Return the board's inertial unit, or None while its values are impossible."""
    rates = (*now.angular_velocity, *now.linear_acceleration)
    norm = math.hypot(*now.orientation)
    if not 0.9 < norm < 1.1 or not all(abs(value) < MAX_IMU_VALUE for value in rates):
        return None
    x, y, z, w = (part / norm for part in now.orientation)
    return ImuData(
        orientation=(x, y, z, w),
        angular_velocity=now.angular_velocity,
        linear_acceleration=now.linear_acceleration,
    )
