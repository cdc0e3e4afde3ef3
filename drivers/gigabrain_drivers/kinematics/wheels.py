"""Kinematics of wheeled bases in both directions, and wheel odometry.

Pure; SI units; x forward, y left. The same equations hold for speeds and for small distances:
`to_body` of wheel rotations [rad] is the body's motion [m, m, rad].
"""

import abc
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gigabrain_drivers.driver.robot import RobotFile
from gigabrain_schemas.base import Pose

MEASURES = {  # required fields of each drive type with wheels
    "differential": ("wheel_radius", "wheel_separation"),
    "skid_steer": ("wheel_radius", "wheel_separation"),
    "mecanum": ("wheel_radius", "wheel_separation", "wheel_base"),
    "omni": ("wheel_radius", "wheel_separation"),
    "ackermann": ("wheel_radius", "wheel_base"),
}


class Twist(NamedTuple):
    """A body's velocity, or its motion in a short time."""

    linear_x: float  # [m/s] or [m]
    linear_y: float
    angular_z: float  # [rad/s] or [rad]


class Base(abc.ABC):
    """A base on wheels. Wheel speeds [rad/s] are positive where the wheel rolls forward."""

    wheels: tuple[str, ...]  # names of the wheels, in the order of all tuples here

    @abc.abstractmethod
    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """Return the speed of each wheel; motion that the base cannot do is ignored."""

    @abc.abstractmethod
    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the velocity of a body whose wheels do not slip."""


@dataclass(frozen=True)
class Differential(Base):
    """Two driven wheels on one axle; it cannot move sideways."""

    radius: float  # [m]
    separation: float  # [m], between the wheels

    wheels = ("left", "right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """Return (left, right) [rad/s]."""
        turn = twist.angular_z * self.separation / 2
        return (twist.linear_x - turn) / self.radius, (twist.linear_x + turn) / self.radius

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the velocity along x and about z."""
        left, right = wheels
        forward, turn = (left + right) / 2 * self.radius, (right - left) * self.radius
        return Twist(forward, 0.0, turn / self.separation)


@dataclass(frozen=True)
class SkidSteer(Base):
    """Four fixed wheels that scrub over the floor in turns; both wheels of a side turn alike."""

    radius: float  # [m]
    effective_track: float  # [m], separation of a differential base that turns as fast

    wheels = ("front_left", "front_right", "rear_left", "rear_right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """(front left, front right, rear left, rear right) [rad/s]."""
        return 2 * self._differential.to_wheels(twist)

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the velocity along x and about z, from the mean of each side."""
        front_left, front_right, rear_left, rear_right = wheels
        return self._differential.to_body(
            ((front_left + rear_left) / 2, (front_right + rear_right) / 2)
        )

    @property
    def _differential(self) -> Differential:
        return Differential(self.radius, self.effective_track)


@dataclass(frozen=True)
class Mecanum(Base):
    """Four wheels with rollers at 45 degrees, which form an X seen from above."""

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
        """Return the least-squares velocity of the four wheels."""
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
    circle: float  # [m], radius of the circle through the wheels

    wheels = ("left", "back", "right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """Return (left, back, right) [rad/s]; positive speeds turn the body counter-clockwise."""
        wheels = self._matrix @ twist / self.radius
        return tuple(wheels.tolist())

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the only velocity that turns the wheels at these speeds."""
        return Twist(*np.linalg.solve(self._matrix, np.array(wheels) * self.radius).tolist())

    @property
    def _matrix(self) -> "np.ndarray[tuple[int, int], np.dtype[np.float64]]":
        directions = np.radians((150.0, -90.0, 30.0))  # rolling direction of each wheel
        return np.stack([np.cos(directions), np.sin(directions), np.full(3, self.circle)], axis=1)


@dataclass(frozen=True)
class Ackermann(Base):
    """A car, as a bicycle model: rear wheels drive, front wheels steer.

    It cannot turn on the spot: at zero speed it steers straight.
    """

    radius: float  # [m], of the rear wheels
    wheel_base: float  # [m], front to rear axle
    max_steering: float = math.radians(45.0)  # [rad], to either side

    wheels = ("drive", "steering")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """Return (rear wheels [rad/s], steering angle [rad], positive to the left)."""
        drive = twist.linear_x / self.radius
        if twist.linear_x == 0:
            return drive, 0.0
        steering = math.atan(self.wheel_base * twist.angular_z / twist.linear_x)
        return drive, min(max(steering, -self.max_steering), self.max_steering)

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the velocity of the rear axle's center."""
        drive, steering = wheels
        forward = drive * self.radius
        return Twist(forward, 0.0, forward * math.tan(steering) / self.wheel_base)


@dataclass(frozen=True)
class AckermannAxles(Base):
    """The four wheels of a car: both rear wheels drive, both front wheels steer.

    Each front wheel steers at its own angle, so that all wheels roll about one center. The wheels'
    values are speeds [rad/s] and angles [rad], positive to the left.
    """

    car: Ackermann
    separation: float  # [m], left to right

    wheels = ("rear_left", "rear_right", "steer_left", "steer_right")

    def to_wheels(self, twist: Twist) -> tuple[float, ...]:
        """Return (rear left, rear right [rad/s], front left, front right [rad])."""
        drive, steering = self.car.to_wheels(twist)
        curvature = math.tan(steering) / self.car.wheel_base  # [1/m], of the rear axle's center
        lateral = 0.5 * self.separation * curvature
        forward = self.car.wheel_base * curvature
        left, right = math.atan2(forward, 1.0 - lateral), math.atan2(forward, 1.0 + lateral)
        return drive * (1.0 - lateral), drive * (1.0 + lateral), left, right

    def to_body(self, wheels: tuple[float, ...]) -> Twist:
        """Return the velocity of the rear axle's center, from all wheels."""
        rear_left, rear_right, left, right = wheels
        base, half = self.car.wheel_base, 0.5 * self.separation
        curvature_left = math.tan(left) / (base + half * math.tan(left))
        curvature_right = math.tan(right) / (base - half * math.tan(right))
        forward = (rear_left + rear_right) / 2 * self.car.radius
        return Twist(forward, 0.0, forward * (curvature_left + curvature_right) / 2)


def missing_measures(robot: RobotFile) -> list[str]:
    """Return the required wheel fields that a robot's file lacks."""
    return [name for name in MEASURES.get(robot.drive_type, ()) if not getattr(robot, name)]


def wheels_of(robot: RobotFile) -> Base | None:
    """Return the wheels of a robot's file; None if it has none, or lacks their fields."""
    if robot.drive_type not in MEASURES or missing_measures(robot):
        return None
    radius, separation, wheel_base = robot.wheel_radius, robot.wheel_separation, robot.wheel_base
    if robot.drive_type == "differential":
        return Differential(radius, separation)
    if robot.drive_type == "skid_steer":
        return SkidSteer(radius, robot.effective_track or separation)
    if robot.drive_type == "mecanum":
        return Mecanum(radius, separation, wheel_base)
    if robot.drive_type == "omni":
        return Omni(radius, separation / math.sqrt(3.0))
    return Ackermann(radius, wheel_base)


def advance_pose(pose: Pose, moved: Twist) -> Pose:
    """Return the pose after a small step in the body's frame, integrated at the mid heading."""
    middle = pose.yaw + moved.angular_z / 2
    cos, sin = math.cos(middle), math.sin(middle)
    return Pose(
        x=pose.x + moved.linear_x * cos - moved.linear_y * sin,
        y=pose.y + moved.linear_x * sin + moved.linear_y * cos,
        yaw=math.remainder(pose.yaw + moved.angular_z, math.tau),
    )


def step_between(start: Pose, end: Pose) -> Twist:
    """Return the small step, in the body's frame, from one pose to another."""
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
        """Add the wheels' rotations [rad], in the order of `base.wheels`."""
        self.pose = advance_pose(self.pose, self._base.to_body(wheels))


class Encoders:
    """Converts encoder counts, which wrap, to the rotations of wheels between two readings."""

    def __init__(self, per_turn: float, bits: int) -> None:
        self._radians, self._range = math.tau / per_turn, 1 << bits
        self._last: tuple[int, ...] | None = None

    def turned(self, counts: tuple[int, ...]) -> tuple[float, ...]:
        """Return the rotations since the last call [rad]; zero at the first call."""
        last, self._last = self._last or counts, counts
        pairs = zip(counts, last, strict=True)
        return tuple(self._radians * self._wrapped(now - before) for now, before in pairs)

    def restart(self) -> None:
        """Start at the next counts, because the counters may have been reset."""
        self._last = None

    def _wrapped(self, difference: int) -> int:
        half = self._range // 2
        return (difference + half) % self._range - half
