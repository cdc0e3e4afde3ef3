"""One joint of an arm on a servo bus: its accepted readings and its goal."""

import math
from typing import NamedTuple

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import ServoCalibration
from gigabrain_drivers.bodies.feetech.protocol import RADIANS_PER_TICK, ServoReadings
from gigabrain_schemas.body import Joint, JointDescription

LOST_NS = 100_000_000  # it counts as lost after this time without an answer
# larger changes between two readings are no motion:
PUSHED_FACTOR = 2.0  # factor on the maximal speed, for a joint that is pushed
MAX_ACCELERATION = 150.0  # [rad/s2], of a joint that is pushed or hits something
JUMP_SLACK = math.radians(0.5)  # [rad], added to both
VOLTAGE_STEP, TEMPERATURE_STEP = 5, 2  # 0.1 V, [deg C]
AT_REST = 0.05  # [rad/s]
CONTACT = math.radians(4.0)  # [rad], a gripper that stops this far from its goal holds something
CONTACT_NS = 200_000_000  # after this time
SPEED_MARGIN = 1.2  # servo's speed limit / joint's speed limit


class Settings(NamedTuple):
    """Values in the servo's RAM besides the goal."""

    acceleration: int
    velocity: int  # ticks/s
    torque_limit: int  # 0.001

    def frame_part(self, goal: int) -> bytes:
        """Return the bytes from the acceleration to the torque limit."""
        parts = (
            feetech.ACCELERATION.encode(self.acceleration),
            feetech.GOAL.encode(goal),
            bytes(2),  # goal time: not used in position mode
            feetech.GOAL_VELOCITY.encode(self.velocity),
            feetech.TORQUE_LIMIT.encode(self.torque_limit),
        )
        return b"".join(parts)


class ServoJoint:
    """A joint, its servo and its calibration. Positions are in radians, goals in ticks."""

    pushed_factor, pushed_acceleration = PUSHED_FACTOR, MAX_ACCELERATION
    lost_after_ns = LOST_NS

    def __init__(
        self,
        description: JointDescription,
        calibration: ServoCalibration,
        *,
        stall_torque: float,
        torque_limit: float,
        grip_torque: float,
    ) -> None:
        self.description, self.calibration = description, calibration
        self.id = calibration.id
        self.goal = 0  # ticks
        self.refused = 0  # rejected readings
        self.position = 0.0  # [rad], newest accepted
        self.newest: ServoReadings | None = None  # accepted
        self.received_ns = 0  # when the newest was requested
        self._stall_torque = stall_torque
        self._full = round(torque_limit * 1000)
        self._gentle = min(self._full, round(grip_torque * 1000))
        self._last: ServoReadings | None = None  # newest, accepted or not
        self._speed = 0.0  # [rad/s], between the two newest accepted readings
        self._held = False
        self._contact_ns: int | None = None  # start of contact with a thing between its fingers

    def __str__(self) -> str:
        return f"servo {self.id} ({self.description.name})"

    @property
    def velocity(self) -> float:
        """The measured speed [rad/s]."""
        ticks = self.newest.velocity if self.newest else 0
        return self.calibration.direction * ticks * RADIANS_PER_TICK

    @property
    def let_go(self) -> bool:
        """True if it has no torque, regardless of commands."""
        return self.newest is not None and not self.newest.torque

    @property
    def status(self) -> int:
        """The servo's own status bits; 0 if all is well."""
        return self.newest.status if self.newest else 0

    def begin(self, now: ServoReadings, asked_ns: int) -> None:
        """Accept a reading without checks, and use its position as the goal.

        A servo that already holds keeps its goal: any other goal would move it.
        """
        self.newest = self._last = now
        self.received_ns, self._speed = asked_ns, 0.0
        self.position = self.calibration.to_radians(now.position)
        self._contact_ns = None
        holds = now.torque and abs(self.velocity) < AT_REST
        self.goal, self._held = (now.goal if holds else now.position), True

    def take(self, now: ServoReadings, asked_ns: int) -> None:
        """Accept a reading that is a possible motion, and agrees with the one before.

        A checksum of 8 bits does not detect all wrong readings. So values that seldom change, such
        as torque, settings and status, must be the same twice.
        """
        position = self.calibration.to_radians(now.position)
        passed_s = (asked_ns - self.received_ns) / 1e9
        moved = position - self.position
        furthest = self.pushed_factor * self.description.max_speed * passed_s + JUMP_SLACK
        change = abs(moved - self._speed * passed_s)
        smooth = change <= self.pushed_acceleration * passed_s**2 + JUMP_SLACK
        before, self._last = self._last, now
        if abs(moved) > furthest or not smooth or not (before and _agree(before, now)):
            self.refused += 1
            return
        self._speed = moved / passed_s if passed_s > 0.0 else 0.0
        self.newest, self.position, self.received_ns = now, position, asked_ns

    def command(self, position: float) -> float:
        """Go to a position [rad] within its limits; return it rounded to a tick.

        If it is not a number, the joint stays where it is.
        """
        if math.isfinite(position):
            lower, upper = self.description.lower, self.description.upper
            self.goal = self.calibration.to_ticks(max(lower, min(upper, position)))
            self._held = False
        return self.calibration.to_radians(self.goal)

    def hold(self) -> None:
        """Come to rest at its goal, or earlier if braking needs less way.

        At rest it keeps its goal, so that neither its load nor a gripped thing drops.
        """
        if self._held:
            return
        self._held = True
        speed = self.velocity
        if abs(speed) < AT_REST:
            return
        left = self.calibration.to_radians(self.goal) - self.position
        brakes = speed * abs(speed) / (2 * self.description.max_acceleration)
        if left * speed < 0.0 or abs(left) > abs(brakes):
            self.goal = self.calibration.to_ticks(self.position + brakes)

    def yield_to_load(self) -> None:
        """Set the goal to the present position, so that the servo gives way."""
        if self.newest:
            self.goal, self._held = self.newest.position, True

    def settings(self, now_ns: int) -> Settings:
        """Return the servo's settings; with less torque for a gripper that touches something."""
        limit = self._gentle if self._grips(now_ns) else self._full
        speed = SPEED_MARGIN * self.description.max_speed / RADIANS_PER_TICK
        return Settings(feetech.MAX_ACCELERATION, round(speed), limit)

    def _grips(self, now_ns: int) -> bool:
        if self.description.part != "gripper":
            return False
        left = abs(self.calibration.to_radians(self.goal) - self.position)
        if left < CONTACT or (self._contact_ns is None and abs(self.velocity) > AT_REST):
            self._contact_ns = None
            return False
        self._contact_ns = now_ns if self._contact_ns is None else self._contact_ns
        return now_ns - self._contact_ns >= CONTACT_NS

    def holds(self, wanted: Settings) -> bool:
        """Return whether its newest reading has these settings."""
        now = self.newest
        return now is not None and wanted == Settings(
            now.acceleration, now.goal_velocity, now.torque_limit
        )

    def problem(self, now_ns: int) -> str:
        """Return its problem as one line, or an empty text."""
        if lost := self.lost(now_ns):
            return lost
        if status := feetech.faults_of(self.status):
            return f"{self} protects itself: {status}"
        return ""

    def lost(self, now_ns: int) -> str:
        """Return a text if it no longer answers, else an empty one."""
        silent = now_ns - self.received_ns > self.lost_after_ns
        return f"{self} no longer answers: check its cable and power" if silent else ""

    def measured(self) -> Joint | None:
        """Return its measured state, or None before the first reading."""
        now = self.newest
        if now is None:
            return None
        load = self.calibration.direction * now.load * feetech.LOAD_UNIT
        return Joint(
            name=self.description.name,
            position=self.position,
            velocity=self.velocity,
            effort=load * self._stall_torque,
            temperature=float(now.temperature),
            current=abs(now.current) * feetech.CURRENT_UNIT,
        )


def _agree(before: ServoReadings, now: ServoReadings) -> bool:
    """Return whether two readings in a row agree on the values that seldom change."""
    return (
        abs(now.voltage - before.voltage) <= VOLTAGE_STEP
        and abs(now.temperature - before.temperature) <= TEMPERATURE_STEP
        and now.seldom() == before.seldom()
    )
