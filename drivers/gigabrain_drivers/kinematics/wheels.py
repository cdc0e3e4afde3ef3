"""From a body's velocity to its wheels and back, and dead reckoning by how the wheels turned.

Pure; SI units; x forward, y left. What holds for speeds holds for small distances: `to_body` of
wheel angles [rad] is how far the body has moved [m, m, rad].
"""

import abc
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_schemas.base import Pose

MEASURES = {  # of each drive type with wheels
    "differential": ("wheel_radius", "wheel_separation"),
    "skid_steer": ("wheel_radius", "wheel_separation"),
    "mecanum": ("wheel_radius", "wheel_separation", "wheel_base"),
    "omni": ("wheel_radius", "wheel_separation"),
    "ackermann": ("wheel_radius", "wheel_base"),
}


class Twist(NamedTuple):
    """A body's velocity, or how far it has moved in a moment."""

    linear_x: float  # [m/s] or [m]
    linear_y: float
    angular_z: float  # [rad/s] or [rad]


class Base(abc.ABC):
    """A base on wheels. Wheel speeds [rad/s] are positive where the wheel rolls forward."""

    wheels: tuple[str, ...]  # their names, in the order of all tuples here

    @abc.abstractmethod
    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """Return the speed of each wheel; what the base cannot do is left out."""

    @abc.abstractmethod
    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the velocity of the body when its wheels do not slip."""


@dataclass(frozen=True)
class Differential(Base):
    """Two driven wheels on one axle; it cannot go sideways."""

    radius: float  # [m]
    separation: float  # [m], between the wheels

    wheels = ("left", "right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(left, right) [rad/s]."""
        turn = twist.angular_z * self.separation / 2
        return (twist.linear_x - turn) / self.radius, (twist.linear_x + turn) / self.radius

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Linear along x and turning about z."""
        left, right = wheels
        forward, turn = (left + right) / 2 * self.radius, (right - left) * self.radius
        return Twist(forward, 0.0, turn / self.separation)


@dataclass(frozen=True)
class SkidSteer(Base):
    """Four fixed wheels that scrub over the floor in turns; those of a side turn alike."""

    radius: float  # [m]
    effective_track: float  # [m], between rolling wheels that would turn the body as much

    wheels = ("front_left", "front_right", "rear_left", "rear_right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(front left, front right, rear left, rear right) [rad/s]."""
        return 2 * self._rolling.to_wheels(twist)

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Linear along x and turning about z, by the mean of each side."""
        front_left, front_right, rear_left, rear_right = wheels
        return self._rolling.to_body(((front_left + rear_left) / 2, (front_right + rear_right) / 2))

    @property
    def _rolling(self) -> Differential:
        return Differential(self.radius, self.effective_track)


@dataclass(frozen=True)
class Mecanum(Base):
    """Four wheels with rollers at 45 degrees, in an X seen from above."""

    radius: float  # [m]
    separation: float  # [m], left to right
    wheel_base: float  # [m], front to rear

    wheels = ("front_left", "front_right", "rear_left", "rear_right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(front left, front right, rear left, rear right) [rad/s]."""
        x, y, turn = twist.linear_x, twist.linear_y, twist.angular_z * self._arm
        speeds = (x - y - turn, x + y + turn, x + y - turn, x - y + turn)
        return tuple(speed / self.radius for speed in speeds)

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """The velocity that fits all four best (least squares)."""
        front_left, front_right, rear_left, rear_right = (w * self.radius / 4 for w in wheels)
        return Twist(
            front_left + front_right + rear_left + rear_right,
            -front_left + front_right + rear_left - rear_right,
            (-front_left + front_right - rear_left + rear_right) / self._arm,
        )

    @property
    def _arm(self) -> float:
        return (self.separation + self.wheel_base) / 2


@dataclass(frozen=True)
class Omni(Base):
    """Three omnidirectional wheels on a circle, 120 degrees apart, one of them at the back."""

    radius: float  # [m]
    circle: float  # [m], radius of the circle on which they stand

    wheels = ("left", "back", "right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(left, back, right) [rad/s]; all turn the body counter-clockwise."""
        wheels = self._matrix @ twist / self.radius
        return tuple(wheels.tolist())

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """The only velocity that turns the wheels like this."""
        return Twist(*np.linalg.solve(self._matrix, np.array(wheels) * self.radius).tolist())

    @property
    def _matrix(self) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
        directions = np.radians((150.0, -90.0, 30.0))  # in which each wheel rolls
        return np.stack([np.cos(directions), np.sin(directions), np.full(3, self.circle)], axis=1)


@dataclass(frozen=True)
class Ackermann(Base):
    """A car, as the bicycle in its middle: rear wheels drive, front wheels steer.

    It cannot turn on the spot: at a standstill the steering is straight.
    """

    radius: float  # [m], of the rear wheels
    wheel_base: float  # [m], front to rear axle
    max_steering: float = math.radians(45.0)  # [rad], to either side

    wheels = ("drive", "steering")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(rear wheels [rad/s], steering angle [rad], positive to the left)."""
        drive = twist.linear_x / self.radius
        if twist.linear_x == 0:
            return drive, 0.0
        steering = math.atan(self.wheel_base * twist.angular_z / twist.linear_x)
        return drive, min(max(steering, -self.max_steering), self.max_steering)

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """The velocity of the middle of the rear axle."""
        drive, steering = wheels
        forward = drive * self.radius
        return Twist(forward, 0.0, forward * math.tan(steering) / self.wheel_base)


@dataclass(frozen=True)
class AckermannAxles(Base):
    """All four corners of a car: both rear wheels drive, both front wheels steer.

    Each front wheel steers at its own angle, so that all wheels roll round one center. The wheels'
    values are speeds [rad/s] and angles [rad], positive to the left.
    """

    car: Ackermann
    separation: float  # [m], left to right

    wheels = ("rear_left", "rear_right", "steer_left", "steer_right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(rear left, rear right [rad/s], front left, front right [rad])."""
        drive, steering = self.car.to_wheels(twist)
        bend = math.tan(steering) / self.car.wheel_base  # [1/m], of the middle of the rear axle
        inner = 0.5 * self.separation * bend
        along = self.car.wheel_base * bend
        left, right = math.atan2(along, 1.0 - inner), math.atan2(along, 1.0 + inner)
        return drive * (1.0 - inner), drive * (1.0 + inner), left, right

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """The velocity of the middle of the rear axle, by its wheels and the steering angles."""
        rear_left, rear_right, left, right = wheels
        base, half = self.car.wheel_base, 0.5 * self.separation
        bend_left = math.tan(left) / (base + half * math.tan(left))
        bend_right = math.tan(right) / (base - half * math.tan(right))
        forward = (rear_left + rear_right) / 2 * self.car.radius
        return Twist(forward, 0.0, forward * (bend_left + bend_right) / 2)


def missing_measures(robot: RobotFile) -> list[str]:
    """The measures of its wheels that a robot's file does not give."""
    return [name for name in MEASURES.get(robot.drive_type, ()) if not getattr(robot, name)]


def wheels_of(robot: RobotFile) -> Base | None:
    """The wheels of a robot's file, or None where it has none or does not give their measures."""
    if robot.drive_type not in MEASURES or missing_measures(robot):
        return None
    radius, across, along = robot.wheel_radius, robot.wheel_separation, robot.wheel_base
    if robot.drive_type == "differential":
        return Differential(radius, across)
    if robot.drive_type == "skid_steer":
        return SkidSteer(radius, robot.effective_track or across)
    if robot.drive_type == "mecanum":
        return Mecanum(radius, across, along)
    if robot.drive_type == "omni":
        return Omni(radius, across / math.sqrt(3.0))
    return Ackermann(radius, along)


def advance_pose(pose: Pose, moved: Twist) -> Pose:
    """Return the pose after a small step in the body's frame, taken at the mid heading."""
    middle = pose.yaw + moved.angular_z / 2
    cos, sin = math.cos(middle), math.sin(middle)
    return Pose(
        x=pose.x + moved.linear_x * cos - moved.linear_y * sin,
        y=pose.y + moved.linear_x * sin + moved.linear_y * cos,
        yaw=math.remainder(pose.yaw + moved.angular_z, math.tau),
    )


def step_between(start: Pose, end: Pose) -> Twist:
    """The small step, in the body's own frame, that leads from one pose to another."""
    turn = math.remainder(end.yaw - start.yaw, math.tau)
    middle, x, y = start.yaw + turn / 2, end.x - start.x, end.y - start.y
    cos, sin = math.cos(middle), math.sin(middle)
    return Twist(cos * x + sin * y, cos * y - sin * x, turn)


class WheelOdometry:
    """The pose since the start (REP-103), integrated at the mid heading."""

    def __init__(self, base: Base) -> None:
        self._base = base
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)

    def add(self, wheels: tuple[float, ...]) -> None:
        """Add the angles by which the wheels have turned [rad], as in `base.wheels`."""
        self.pose = advance_pose(self.pose, self._base.to_body(wheels))


class Encoders:
    """Counters that wrap, read as the angles by which wheels turned between two looks."""

    def __init__(self, per_turn: float, bits: int) -> None:
        self._radians, self._range = math.tau / per_turn, 1 << bits
        self._last: tuple[int, ...] | None = None

    def turned(self, counts: tuple[int, ...]) -> tuple[float, ...]:
        """Return the angles since the last call [rad]; zero at the first."""
        last, self._last = self._last or counts, counts
        pairs = zip(counts, last, strict=True)
        return tuple(self._radians * self._wrapped(now - before) for now, before in pairs)

    def restart(self) -> None:
        """Count from the next values on: the counters may have been reset."""
        self._last = None

    def _wrapped(self, difference: int) -> int:
        half = self._range // 2
        return (difference + half) % self._range - half
