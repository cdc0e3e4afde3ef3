"""One joint of an arm on a servo bus: what is believed of it, and where it is to go."""

import math
from typing import NamedTuple

from gigabrain_drivers.bodies.feetech import protocol as feetech
from gigabrain_drivers.bodies.feetech.calibration import ServoCalibration
from gigabrain_drivers.bodies.feetech.protocol import RADIANS_PER_TICK, ServoReadings
from gigabrain_schemas.body import Joint, JointDescription

LOST_NS = 100_000_000  # without an answer it counts as lost
PUSHED_FACTOR = 2.0  # times as fast as it may move a joint may be pushed, and
MAX_ACCELERATION = 150.0  # [rad/s2] of a joint that is pushed, or runs into something;
JUMP_SLACK = math.radians(0.5)  # [rad] more between two readings; the rest is no motion
VOLTAGE_STEP, TEMPERATURE_STEP = 5, 2  # 0.1 V, [deg C] that may lie between two readings
AT_REST = 0.05  # [rad/s]
CONTACT = math.radians(4.0)  # [rad] that a gripper stops short of its goal where it holds something
CONTACT_NS = 200_000_000  # for which it does
SPEED_MARGIN = 1.2  # of the servo's own speed limit over the joint's


class Settings(NamedTuple):
    """Values in the servo's RAM beside the goal."""

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
    """A joint, its servo and its calibration. Positions are radians, places are ticks."""

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
        self.refused = 0  # readings that were not believed
        self.position = 0.0  # [rad], the newest that is believed
        self.newest: ServoReadings | None = None
        self.received_ns = 0  # when the newest one was asked for
        self._stall_torque = stall_torque
        self._full = round(torque_limit * 1000)
        self._gentle = min(self._full, round(grip_torque * 1000))
        self._last: ServoReadings | None = None  # believed or not
        self._speed = 0.0  # [rad/s] between the two newest that are believed
        self._held = False
        self._contact_ns: int | None = None  # since when something has been between its fingers

    def __str__(self) -> str:
        return f"servo {self.id} ({self.description.name})"

    @property
    def velocity(self) -> float:
        """The measured speed [rad/s]."""
        ticks = self.newest.velocity if self.newest else 0
        return self.calibration.direction * ticks * RADIANS_PER_TICK

    @property
    def let_go(self) -> bool:
        """True where it has no torque any more, whatever was sent."""
        return self.newest is not None and not self.newest.torque

    @property
    def status(self) -> int:
        """The servo's own status bits; 0 if all is well."""
        return self.newest.status if self.newest else 0

    def begin(self, now: ServoReadings, asked_ns: int) -> None:
        """Believe a reading whatever was before, and take it for the goal.

        A servo that holds already keeps what it holds: any other goal would move it.
        """
        self.newest = self._last = now
        self.received_ns, self._speed = asked_ns, 0.0
        self.position = self.calibration.to_radians(now.position)
        self._contact_ns = None
        holds = now.torque and abs(self.velocity) < AT_REST
        self.goal, self._held = (now.goal if holds else now.position), True

    def take(self, now: ServoReadings, asked_ns: int) -> None:
        """Believe a reading that motion explains, and that agrees with the one before it.

        A sum of 8 bits lets some wrong ones through. So what seldom changes, such as torque,
        settings and status, has to be read twice.
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
        """Go to a position [rad] within its limits; return the one that a tick stands for.

        Where it is not a number, the joint stays where it is.
        """
        if math.isfinite(position):
            lower, upper = self.description.lower, self.description.upper
            self.goal = self.calibration.to_ticks(max(lower, min(upper, position)))
            self._held = False
        return self.calibration.to_radians(self.goal)

    def hold(self) -> None:
        """Come to rest: at its goal, or sooner where that is further than it takes to brake.

        At rest it keeps its goal, so that neither its load nor what it grips is let down.
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
        """Take the place where it is for the goal, so that it pulls at nothing."""
        if self.newest:
            self.goal, self._held = self.newest.position, True

    def settings(self, now_ns: int) -> Settings:
        """Return what its servo has to hold; a gripper is gentle once it touches something."""
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
        """Return whether its servo has these settings, by its newest reading."""
        now = self.newest
        return now is not None and wanted == Settings(
            now.acceleration, now.goal_velocity, now.torque_limit
        )

    def problem(self, now_ns: int) -> str:
        """Return what is wrong with it in one line, or an empty text."""
        if lost := self.lost(now_ns):
            return lost
        if status := feetech.faults_of(self.status):
            return f"{self} protects itself: {status}"
        return ""

    def lost(self, now_ns: int) -> str:
        """Return that it answers no more, or an empty text."""
        silent = now_ns - self.received_ns > self.lost_after_ns
        return f"{self} answers no more: cable, power?" if silent else ""

    def measured(self) -> Joint | None:
        """Return it as measured, or None before the first reading."""
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
    """Return whether two readings in a row tell the same about what seldom changes."""
    return (
        abs(now.voltage - before.voltage) <= VOLTAGE_STEP
        and abs(now.temperature - before.temperature) <= TEMPERATURE_STEP
        and now.seldom() == before.seldom()
    )
