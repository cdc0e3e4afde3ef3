"""A base with wheels on servos in velocity mode, on the bus of its arm."""

from collections import deque
from collections.abc import Mapping
from typing import Protocol

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.arming import VARIANT_LIMIT, Arming
from gigabrain_drivers.bodies.feetech.bus import ANSWER_TIMEOUT_NS, HostBus
from gigabrain_drivers.bodies.feetech.joint import LOST_NS
from gigabrain_drivers.bodies.feetech.protocol import RADIANS_PER_TICK, TICKS, ServoReadings
from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_drivers.kinematics.wheels import Twist, advance_pose, wheels_of
from gigabrain_drivers.links.line_guard import LineGuard
from gigabrain_schemas.base import Pose, Velocity
from gigabrain_schemas.body import Joint
from gigabrain_zenoh.errors import BodyLost, ConfigError

VELOCITY_MODE = 1
MAX_SPEED = 3000  # ticks/s, of an STS3215 under load, as in LeRobot
MAX_READ_SPEED = 1.5 * MAX_SPEED  # ticks/s, of a wheel that is pushed or runs free
SLACK_TICKS = 8  # added to the largest motion between two readings
STOP_ATTEMPTS = 20  # after a disturbed length field, a servo may wait for 250 bytes
WINDOW_NS = 50_000_000  # for mean speeds; a shorter one shows encoder noise


class WheelOptions(Protocol):
    """The driver's options for wheels."""

    @property
    def wheels(self) -> Mapping[str, int]:
        """The id of each servo, by the wheel's name."""

    @property
    def inverted(self) -> tuple[str, ...]:
        """Wheels whose ticks decrease in forward motion."""

    @property
    def voltage(self) -> float:
        """The servos' variant [V]."""

    @property
    def torque_limit(self) -> float:
        """A share of the stall torque."""


class ServoWheel:
    """A wheel and its servo. It counts the ticks of its motion."""

    def __init__(self, name: str, servo: int, *, direction: int, torque_limit: float) -> None:
        self.name, self.id = name, servo
        self.goal = 0  # ticks/s, as the servo counts them
        self.turned = 0  # ticks forward since the start
        self.refused = 0  # rejected readings
        self.received_ns = 0  # when the newest was requested
        self.newest: ServoReadings | None = None
        self._direction, self._torque_limit = direction, round(torque_limit * 1000)
        self._last: ServoReadings | None = None  # newest, accepted or not
        self._past: deque[tuple[int, int]] = deque()  # (time [ns], turned)

    def __str__(self) -> str:
        return f"servo {self.id} (wheel {self.name})"

    @property
    def let_go(self) -> bool:
        """True if it has no torque, regardless of commands."""
        return self.newest is not None and not self.newest.torque

    @property
    def status(self) -> int:
        """The servo's own status bits; 0 if all is well."""
        return self.newest.status if self.newest else 0

    @property
    def speed(self) -> float:
        """The measured speed, forward [rad/s]."""
        if len(self._past) < 2:
            return 0.0
        (since_ns, before), (now_ns, now) = self._past[0], self._past[-1]
        return (now - before) * RADIANS_PER_TICK / ((now_ns - since_ns) / 1e9)

    def command(self, speed: float) -> float:
        """Turn forward [rad/s]; return the speed rounded to ticks/s."""
        self.goal = self._direction * round(speed / RADIANS_PER_TICK)
        return self._direction * self.goal * RADIANS_PER_TICK

    def begin(self, now: ServoReadings, asked_ns: int) -> None:
        """Accept a reading without checks."""
        self.newest = self._last = now
        self.received_ns, self.goal = asked_ns, 0
        self._past.clear()
        self._past.append((asked_ns, self.turned))

    def take(self, now: ServoReadings, asked_ns: int) -> int:
        """Add a reading; return its forward motion in ticks.

        It is accepted if it is a possible motion, and its seldom changing values were read twice.
        """
        before, last, self._last = self.newest or now, self._last or now, now
        moved = (now.position - before.position + TICKS // 2) % TICKS - TICKS // 2
        furthest = MAX_READ_SPEED * (asked_ns - self.received_ns) / 1e9 + SLACK_TICKS
        if abs(moved) > furthest or _seldom(now) != _seldom(last):
            self.refused += 1
            return 0
        self.newest, self.received_ns = now, asked_ns
        forward = self._direction * moved
        self.turned += forward
        self._past.append((asked_ns, self.turned))
        while len(self._past) > 2 and asked_ns - self._past[1][0] >= WINDOW_NS:
            self._past.popleft()
        return forward

    @property
    def has_settings(self) -> bool:
        """Return whether its newest reading has the settings of `frame_part`."""
        now = self.newest
        wanted = feetech.MAX_ACCELERATION, self._torque_limit
        return now is not None and (now.acceleration, now.torque_limit) == wanted

    def frame_part(self) -> bytes:
        """Return the bytes from the acceleration to the torque limit."""
        parts = (
            feetech.ACCELERATION.encode(feetech.MAX_ACCELERATION),
            bytes(4),  # position and time: not used in velocity mode
            feetech.GOAL_VELOCITY.encode(self.goal),
            feetech.TORQUE_LIMIT.encode(self._torque_limit),
        )
        return b"".join(parts)

    def problem(self, now_ns: int) -> str:
        """Return its problem as one line, or an empty text."""
        if now_ns - self.received_ns > LOST_NS:
            return f"{self} no longer answers: check its cable and power"
        if status := feetech.faults_of(self.status):
            return f"{self} protects itself: {status}"
        return ""

    def measured(self, stall_torque: float) -> Joint | None:
        """Return its measured state, or None before the first reading."""
        now = self.newest
        if now is None:
            return None
        return Joint(
            name=f"wheel_{self.name}_joint",
            position=self.turned * RADIANS_PER_TICK,
            velocity=self.speed,
            effort=self._direction * now.load * feetech.LOAD_UNIT * stall_torque,
            temperature=float(now.temperature),
            current=abs(now.current) * feetech.CURRENT_UNIT,
        )


def _seldom(now: ServoReadings) -> tuple[int, ...]:
    """Return the values of a wheel's readings that seldom change."""
    return now.torque, now.acceleration, now.torque_limit, now.lock, now.status


class ServoBase:
    """All wheels of a base: commands its velocity, and integrates its odometry."""

    def __init__(
        self, robot: RobotFile, options: WheelOptions, bus: HostBus, arming: Arming
    ) -> None:
        base = wheels_of(robot)
        assert base
        self._base, self._bus, self._arming = base, bus, arming
        self._voltage = options.voltage
        self._stall_torque = feetech.STALL_TORQUE[options.voltage]
        rim = robot.max_rim_speed
        fastest = rim / robot.wheel_radius / RADIANS_PER_TICK if rim else MAX_SPEED
        self._fastest = min(fastest, MAX_SPEED) * RADIANS_PER_TICK  # [rad/s]
        self.wheels = [
            ServoWheel(
                name,
                options.wheels[name],
                direction=-1 if name in options.inverted else 1,
                torque_limit=options.torque_limit,
            )
            for name in base.wheels
        ]
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)
        self._guard = LineGuard(self._goals())

    async def close(self) -> None:
        """Come to rest, and end the guard process.

        Nothing could stop the wheels later. So the stop is repeated until it is read back.
        """
        self.stop()
        for _ in range(STOP_ATTEMPTS):
            if not self._bus.link.connected or (await self.send() and await self._stands()):
                break
        self._guard.close()

    async def _stands(self) -> bool:
        """Return whether all servos have a goal of zero speed."""
        speed, servos = feetech.GOAL_VELOCITY, [wheel.id for wheel in self.wheels]
        question = feetech.sync_read(servos, speed.address, speed.size)
        answers = await self._bus.ask(question, servos, speed.size, len(servos) * ANSWER_TIMEOUT_NS)
        goals = [speed.decode(answer[1:]) for answer in answers.values()]
        return goals == [0] * len(servos)

    def command(self, wanted: Velocity) -> Velocity:
        """Drive; return the sent velocity. If a wheel would be too fast, all are scaled down."""
        speeds = self._base.to_wheels(Twist(wanted.linear_x, wanted.linear_y, wanted.angular_z))
        slower = max(1.0, max(map(abs, speeds)) / self._fastest)
        pairs = zip(self.wheels, speeds, strict=True)
        sent = tuple(wheel.command(speed / slower) for wheel, speed in pairs)
        return Velocity(**self._base.to_body(sent)._asdict()) if any(sent) else Velocity()

    def stop(self) -> None:
        """Come to rest."""
        for wheel in self.wheels:
            wheel.goal = 0

    @property
    def velocity(self) -> Velocity:
        """The measured velocity."""
        speeds = tuple(wheel.speed for wheel in self.wheels)
        return Velocity(**self._base.to_body(speeds)._asdict()) if any(speeds) else Velocity()

    def joints(self) -> tuple[Joint, ...]:
        """Return the measured state of all wheels."""
        return tuple(filter(None, (wheel.measured(self._stall_torque) for wheel in self.wheels)))

    def take(self, readings: Mapping[int, ServoReadings], asked_ns: int) -> None:
        """Add the wheels' motion to the pose."""
        turned = [
            wheel.take(readings[wheel.id], asked_ns) if wheel.id in readings else 0
            for wheel in self.wheels
        ]
        if any(turned):
            moved = self._base.to_body(tuple(ticks * RADIANS_PER_TICK for ticks in turned))
            self.pose = advance_pose(self.pose, moved)

    async def send(self) -> bool:
        """Send all speeds; return whether they were sent."""
        moving = any(wheel.goal for wheel in self.wheels)
        if moving:  # report it to the guard before the wheels move
            self._guard.tell(self._bus.link.fd, moving=True)
        sent = await self._bus.send(self._goals())
        if not moving:
            self._guard.tell(self._bus.link.fd, moving=False)
        return sent

    def _goals(self) -> bytes:
        goals = {wheel.id: feetech.GOAL_VELOCITY.encode(wheel.goal) for wheel in self.wheels}
        return feetech.sync_write(feetech.GOAL_VELOCITY.address, goals)

    async def start(self, now_ns: int) -> str:
        """Switch stopped servos to velocity mode; return why that failed, or an empty text.

        The mode is written while the EEPROM is locked, so it is lost at power-off. Raises
        ConfigError for other servos.
        """
        for wheel in self.wheels:
            data = await self._bus.confirm(wheel.id, 0, feetech.EEPROM_SIZE)
            if data is None:
                return f"{wheel} answers only at times"
            memory = feetech.decode_memory(data)
            if memory.model != feetech.MODEL:
                raise ConfigError(f"{wheel} is of model {memory.model}; expected an STS3215")
            if (memory.max_voltage > VARIANT_LIMIT) != (self._voltage > VARIANT_LIMIT / 10):
                raise ConfigError(
                    f"{wheel} takes up to {memory.max_voltage / 10:g} V, but the robot's file "
                    f"has servos of {self._voltage:g} V; change voltage there"
                )
            if not await self._switched_on(wheel, memory.mode):
                return f"{wheel} answers only at times"
            if (now := await self._arming.block(wheel.id)) is None:
                return f"{wheel} answers only at times"
            wheel.begin(now, now_ns)
        return ""

    async def _switched_on(self, wheel: ServoWheel, mode: int) -> bool:
        write = self._bus.write
        if mode != VELOCITY_MODE:
            for register, value in ((feetech.TORQUE, 0), (feetech.LOCK, 1), (feetech.MODE, 1)):
                if not await write(wheel.id, register, value):
                    return False
        still = await write(wheel.id, feetech.GOAL_VELOCITY, 0)
        return still and await write(wheel.id, feetech.TORQUE, 1)

    async def keep(self) -> int:
        """Restore settings that servos have lost; return the number of those servos.

        Raises BodyLost if a servo has lost its torque: then its mode has changed too.
        """
        parts = {wheel.id: wheel.frame_part() for wheel in self.wheels if not wheel.has_settings}
        if parts:
            await self._bus.send(feetech.sync_write(feetech.ACCELERATION.address, parts))
        for wheel in self.wheels:
            if wheel.let_go and not wheel.status:
                raise BodyLost(f"{wheel} had switched itself off: is its supply too weak?")
        return len(parts)

    @property
    def overloaded(self) -> bool:
        """Return whether a servo's overload protection is active."""
        return any(wheel.status & feetech.OVERLOAD for wheel in self.wheels)

    async def end_overload(self) -> None:
        """End the overload protection of servos by switching them off and on.

        They keep their old speed, so each gets zero speed before it is switched on.
        """
        write = self._bus.write
        for wheel in self.wheels:
            if wheel.status & feetech.OVERLOAD:
                await write(wheel.id, feetech.TORQUE, 0)
                if await write(wheel.id, feetech.GOAL_VELOCITY, 0):
                    await write(wheel.id, feetech.TORQUE, 1)


def check_wheels(robot: RobotFile, wheels: Mapping[str, int]) -> None:
    """Raise ValueError if the servos of wheels do not match the body's base."""
    base = wheels_of(robot)
    names = base.wheels if base else ()
    if set(wheels) != set(names):
        has = ", ".join(wheels) or "none"
        raise ValueError(
            f"wheels: {has}; expected {', '.join(names) or 'none'} for {robot.drive_type}"
        )
