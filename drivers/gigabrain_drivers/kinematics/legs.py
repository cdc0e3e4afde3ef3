"""Kinematics, gaits and odometry of a quadruped with three joints per leg.

Positions are in the body's frame (x forward, y left, z up) [m]. Angles [rad] follow the right-hand
rule: abduction about x, hip and knee about y. At zero a leg hangs straight down.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from gigabrain_drivers.kinematics import Quaternion, Vector
from gigabrain_drivers.kinematics.wheels import Twist, advance_pose
from gigabrain_schemas.base import Pose

LEGS = ("front_left", "front_right", "rear_left", "rear_right")
JOINTS = ("abduction", "hip", "knee")
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
MAX_REACH_SHARE = 0.999  # of the leg's length; a straight leg is singular

FREQUENCY_HZ = (1.0, 5.0)  # minimum and maximum of a valid gait, as in the next lines
DUTY_RANGE = (0.5, 0.9)
F32_ROUNDING = 1e-6  # a limit is rounded on the wire by less than this
HEIGHT_M = (0.20, 0.33)  # of the hips
MAX_STRIDE_M = 0.25  # in one cycle, in any direction
MAX_TURN_RAD = 0.6  # in one cycle
GRAVITY = 9.81  # [m/s2]
FEET_TIME_CONSTANT_S = 0.04  # with which the feet's velocity corrects the accelerometer's
MAX_SAMPLE_GAP_S = 0.1  # longer gaps between two samples are integrated as this


def by_leg(values: Sequence[float]) -> tuple[Vector, ...]:
    """Group the values of all joints (12,) by leg."""
    each = iter(values)
    return tuple(zip(each, each, each, strict=True))


def by_joint(legs: Iterable[Vector]) -> list[float]:
    """Return the values of all joints in one list (12,), leg by leg."""
    return [value for leg in legs for value in leg]


@dataclass(frozen=True)
class Leg:
    """One leg. Its joints are always in the order abduction, hip, knee."""

    hip_x: float  # [m], of the abduction axis
    hip_y: float
    offset: (
        float  # [m], from the abduction axis to the plane of thigh and calf; positive to the left
    )
    thigh: float  # [m]
    calf: float
    knee_sign: float  # of the knee's angle, 1 or -1

    def home(self, height: float) -> Vector:
        """Return the position of a foot right below its leg, `height` [m] below the hip."""
        return self.hip_x, self.hip_y + self.offset, -height

    def joints(self, foot: Vector) -> Vector:
        """Return the angles that put the foot at a position, or as near as the leg reaches."""
        side, offset = math.copysign(1.0, self.offset), abs(self.offset)
        x, y, z = foot[0] - self.hip_x, (foot[1] - self.hip_y) * side, foot[2]
        drop = math.sqrt(max(y * y + z * z - offset * offset, 1e-6))
        abduction = math.atan2(z, y) - math.atan2(-drop, offset)
        reach = min(math.hypot(x, drop), MAX_REACH_SHARE * (self.thigh + self.calf))
        cosine = (reach**2 - self.thigh**2 - self.calf**2) / (2 * self.thigh * self.calf)
        knee = self.knee_sign * math.acos(min(max(cosine, -1.0), 1.0))
        lean = math.atan2(self.calf * math.sin(knee), self.thigh + self.calf * math.cos(knee))
        return math.remainder(abduction, math.tau) * side, math.atan2(-x, drop) - lean, knee

    def foot(self, joints: Vector) -> Vector:
        """Return the position of the foot's center."""
        abduction, hip, knee = joints
        x = -self.thigh * math.sin(hip) - self.calf * math.sin(hip + knee)
        z = -self.thigh * math.cos(hip) - self.calf * math.cos(hip + knee)
        sin, cos = math.sin(abduction), math.cos(abduction)
        return self.hip_x + x, self.hip_y + self.offset * cos - z * sin, self.offset * sin + z * cos

    def jacobian(self, joints: Vector) -> tuple[Vector, Vector, Vector]:
        """Return the foot's motion [m/rad] for each joint."""
        abduction, hip, knee = joints
        sin, cos = math.sin(abduction), math.cos(abduction)
        knee_x, knee_z = -self.calf * math.cos(hip + knee), self.calf * math.sin(hip + knee)
        hip_x, hip_z = knee_x - self.thigh * math.cos(hip), knee_z + self.thigh * math.sin(hip)
        # hip_x is also the height of the foot: the hip swings forward what hangs below it
        return (
            (0.0, -self.offset * sin - hip_x * cos, self.offset * cos - hip_x * sin),
            (hip_x, -hip_z * sin, hip_z * cos),
            (knee_x, -knee_z * sin, knee_z * cos),
        )


@dataclass(frozen=True)
class LegGeometry:
    """Dimensions of a quadruped [m]; defaults are alpha's. Front and rear knees face each other."""

    hip_x: float = 0.19  # from the body's center to the abduction axes, forward and backward
    hip_y: float = 0.05
    abduction: float = 0.085  # from the abduction axis out to the leg's plane
    thigh: float = 0.21
    calf: float = 0.21
    foot: float = 0.022  # radius of the ball at the end of the calf

    @cached_property
    def legs(self) -> tuple[Leg, ...]:
        """The legs in the order of LEGS."""
        return tuple(
            Leg(
                hip_x=front * self.hip_x,
                hip_y=side * self.hip_y,
                offset=side * self.abduction,
                thigh=self.thigh,
                calf=self.calf,
                knee_sign=-front,
            )
            for front, side in ((1, 1), (1, -1), (-1, 1), (-1, -1))
        )

    def standing(self, height: float) -> tuple[Vector, ...]:
        """Return the joint angles of a standing body, with the hips `height` [m] above the feet."""
        return tuple(leg.joints(leg.home(height)) for leg in self.legs)


class Senses(NamedTuple):
    """One sample of all sensors of a quadruped, in the order of LEGS."""

    joints: tuple[Vector, ...]  # [rad], of each leg, from the encoders
    rates: tuple[Vector, ...]  # [rad/s], from the encoders
    contacts: tuple[bool, ...]  # True if the foot bears weight
    orientation: Quaternion  # x, y, z, w; its yaw drifts and is not used
    angular_velocity: Vector  # [rad/s], in the body's frame
    linear_acceleration: Vector  # [m/s2], in the body's frame; 9.81 upward at rest

    def tilt(self) -> tuple[float, float]:
        """Return (roll, pitch) [rad]."""
        x, y, z, w = self.orientation
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        return roll, math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))


class Gait(NamedTuple):
    """The gait of a quadruped: each foot is on the ground for `duty` of a cycle."""

    stride_x: float  # [m], motion of the body in one cycle
    stride_y: float  # [m]
    turn: float  # [rad], rotation of the body in one cycle
    frequency: float  # [Hz], cycles
    duty: float  # 0-1
    phases: tuple[float, float, float, float]  # 0-1, of front left, front right, rear left, right
    height: float  # [m], of the hips


@dataclass(frozen=True)
class Walker:
    """Parameters of a trot: with the speed, first the strides grow, then their frequency."""

    frequency: float = 2.5  # [Hz], up to the speed of `max_stride`
    max_frequency: float = 4.0  # [Hz]
    max_stride: float = 0.2  # [m] in one cycle
    duty: float = 0.55
    height: float = 0.29  # [m]
    phases: tuple[float, float, float, float] = (0.0, 0.5, 0.5, 0.0)

    def to_gait(self, twist: Twist) -> Gait:
        """Return the gait for a velocity; one that is too fast is scaled down."""
        speed = math.hypot(twist.linear_x, twist.linear_y)
        fastest = self.max_frequency * self.max_stride
        scale = min(1.0, fastest / speed) if speed else 1.0
        x, y, turn = (part * scale for part in twist)
        frequency = max(self.frequency, speed * scale / self.max_stride)
        return Gait(
            stride_x=x / frequency,
            stride_y=y / frequency,
            turn=turn / frequency,
            frequency=frequency,
            duty=self.duty,
            phases=self.phases,
            height=self.height,
        )

    @staticmethod
    def to_body(gait: Gait) -> Twist:
        """Return the velocity of a body whose feet do not slip."""
        strides = (gait.stride_x, gait.stride_y, gait.turn)
        return Twist(*(stride * gait.frequency for stride in strides))


# Alpha takes quick, short steps. On two feet the body tips over, so they must change soon. At
# 0.3 m/s its speed oscillates by 0.036 m/s rms with 2.5 Hz, and by half of that with 3.6 Hz.
WALKER = Walker(frequency=3.6, max_frequency=4.2, duty=0.6)


def is_valid_gait(gait: Gait) -> bool:
    """Return whether all values are finite and within the limits of the legs.

    On the wire they are f32, so a limit may be rounded up.
    """
    values = (gait.stride_x, gait.stride_y, gait.turn, gait.frequency, gait.duty, gait.height)
    if not all(map(math.isfinite, (*values, *gait.phases))):
        return False
    limited = (
        (math.hypot(gait.stride_x, gait.stride_y), 0.0, MAX_STRIDE_M),
        (abs(gait.turn), 0.0, MAX_TURN_RAD),
        (gait.frequency, *FREQUENCY_HZ),
        (gait.duty, *DUTY_RANGE),
        (gait.height, *HEIGHT_M),
    )
    return all(
        low - F32_ROUNDING <= value <= high + F32_ROUNDING for value, low, high in limited
    ) and all(0.0 <= phase < 1.0 for phase in gait.phases)


class LegOdometry:
    """Velocity and pose since the start. Call `update` about 100 times a second.

    A foot that bears weight rolls on the floor without slipping, so its motion gives the body's
    velocity. The feet are averaged, and fused with the accelerometer (Bloesch et al., "State
    Estimation for Legged Robots", RSS 2012, in its simplest form).
    """

    def __init__(self, geometry: LegGeometry) -> None:
        self._geometry = geometry
        self._contacts: tuple[bool, ...]  # of the last sample
        self._velocity: Vector  # [m/s], in the body's frame
        self.velocity: Twist  # along the floor
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)
        self.rest()

    def rest(self) -> None:
        """Forget the velocity, as samples are missing; keep the pose."""
        self._contacts, self._velocity = (False,) * 4, (0.0, 0.0, 0.0)
        self.velocity = Twist(0.0, 0.0, 0.0)

    def update(self, senses: Senses, passed_s: float) -> None:
        """Integrate a sample, `passed_s` after the last one."""
        passed_s = min(passed_s, MAX_SAMPLE_GAP_S)
        tilt = senses.tilt()
        velocity = self._velocity_by_accelerometer(senses, tilt, passed_s)
        contacts = enumerate(zip(senses.contacts, self._contacts, strict=True))
        by_feet = [
            self._velocity_by_foot(senses, leg)
            for leg, now_and_last in contacts
            if all(now_and_last)
        ]
        if by_feet:
            gain, count = min(1.0, passed_s / FEET_TIME_CONSTANT_S), len(by_feet)
            x, y, z = (sum(part) / count for part in zip(*by_feet, strict=True))
            velocity = (
                velocity[0] + gain * (x - velocity[0]),
                velocity[1] + gain * (y - velocity[1]),
                velocity[2] + gain * (z - velocity[2]),
            )
        self._velocity, self._contacts = velocity, senses.contacts
        self.velocity = Twist(*_level(tilt, velocity), senses.angular_velocity[2])
        x, y, turn = self.velocity
        self.pose = advance_pose(self.pose, Twist(x * passed_s, y * passed_s, turn * passed_s))

    def _velocity_by_foot(self, senses: Senses, number: int) -> Vector:
        """Return the body's velocity [m/s] if this foot does not slip."""
        leg, joints = self._geometry.legs[number], senses.joints[number]
        rates, radius = senses.rates[number], self._geometry.foot
        x, y, z = leg.foot(joints)
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = leg.jacobian(joints)
        a, b, c = rates
        foot_x = ax * a + bx * b + cx * c - radius * (b + c) * math.cos(joints[0])
        foot_y = ay * a + by * b + cy * c + radius * a  # `radius`: the ball rolls
        foot_z = az * a + bz * b + cz * c
        turning = _cross(senses.angular_velocity, (x, y, z - radius))
        return -foot_x - turning[0], -foot_y - turning[1], -foot_z - turning[2]

    def _velocity_by_accelerometer(
        self, senses: Senses, tilt: tuple[float, float], passed_s: float
    ) -> Vector:
        """Return the last velocity plus the acceleration since then [m/s]."""
        roll, pitch = tilt
        level = GRAVITY * math.cos(pitch)
        gravity = (-GRAVITY * math.sin(pitch), level * math.sin(roll), level * math.cos(roll))
        measured, last = senses.linear_acceleration, self._velocity
        turning = _cross(senses.angular_velocity, last)
        change = [passed_s * (measured[i] - gravity[i] - turning[i]) for i in range(3)]
        return last[0] + change[0], last[1] + change[1], last[2] + change[2]


def _level(tilt: tuple[float, float], velocity: Vector) -> tuple[float, float]:
    """Return the velocity along the floor (forward, left) [m/s]."""
    roll, pitch = tilt
    x, y, z = velocity
    sideways = math.cos(roll) * y - math.sin(roll) * z
    rising = math.sin(roll) * y + math.cos(roll) * z
    return math.cos(pitch) * x + math.sin(pitch) * rising, sideways


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
