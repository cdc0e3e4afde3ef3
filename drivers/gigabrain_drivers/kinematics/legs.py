"""Four legs of three joints each: where the feet are, how they walk, where they carry the body.

Places are in the body's frame (x ahead, y to the left, z up) [m], angles [rad] follow the right
hand: abduction about x, hip and knee about y. At zero a leg hangs straight down.
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
MAX_REACH = 0.999  # of the whole leg; fully stretched it could not be steered

FREQUENCY_HZ = (1.0, 5.0)  # [Hz]
DUTY_RANGE = (0.5, 0.9)
F32_ROUNDING = 1e-6
HEIGHT_M = (0.20, 0.33)  # [m]
MAX_STRIDE_M = 0.25  # [m], ahead or sideways, in one cycle
MAX_TURN_RAD = 0.6  # [rad] in one cycle
GRAVITY = 9.81  # [m/s2]
FEET_TIME_CONSTANT_S = 0.04  # how long the legs need to overrule the accelerometer
MAX_SAMPLE_GAP_S = 0.1  # a longer gap between two samples counts as this


def by_leg(values: Sequence[float]) -> tuple[Vector, ...]:
    """Return the values of all joints, leg by leg, as one vector for each leg."""
    each = iter(values)
    return tuple(zip(each, each, each, strict=True))


def by_joint(legs: Iterable[Vector]) -> list[float]:
    """Return the values of all joints, leg by leg, in one list."""
    return [value for leg in legs for value in leg]


@dataclass(frozen=True)
class Leg:
    """One leg: abduction, hip and knee, in this order everywhere."""

    hip_x: float  # [m], of the abduction axis
    hip_y: float
    out: float  # [m], from the abduction axis to the plane of thigh and calf; positive to the left
    thigh: float  # [m]
    calf: float
    bend: float  # sign of the knee's angle

    def home(self, height: float) -> Vector:
        """The foot right under the leg, the hip `height` above it."""
        return self.hip_x, self.hip_y + self.out, -height

    def joints(self, foot: Vector) -> Vector:
        """The angles that put the foot there, or as near as the leg reaches."""
        side, out = math.copysign(1.0, self.out), abs(self.out)
        x, y, z = foot[0] - self.hip_x, (foot[1] - self.hip_y) * side, foot[2]
        drop = math.sqrt(max(y * y + z * z - out * out, 1e-6))
        abduction = math.atan2(z, y) - math.atan2(-drop, out)
        reach = min(math.hypot(x, drop), MAX_REACH * (self.thigh + self.calf))
        cosine = (reach**2 - self.thigh**2 - self.calf**2) / (2 * self.thigh * self.calf)
        knee = self.bend * math.acos(min(max(cosine, -1.0), 1.0))
        lean = math.atan2(self.calf * math.sin(knee), self.thigh + self.calf * math.cos(knee))
        return math.remainder(abduction, math.tau) * side, math.atan2(-x, drop) - lean, knee

    def foot(self, joints: Vector) -> Vector:
        """Return the middle of the foot."""
        abduction, hip, knee = joints
        x = -self.thigh * math.sin(hip) - self.calf * math.sin(hip + knee)
        z = -self.thigh * math.cos(hip) - self.calf * math.cos(hip + knee)
        sin, cos = math.sin(abduction), math.cos(abduction)
        return self.hip_x + x, self.hip_y + self.out * cos - z * sin, self.out * sin + z * cos

    def jacobian(self, joints: Vector) -> tuple[Vector, Vector, Vector]:
        """Return the foot's motion per radian [m] of the abduction, of the hip, of the knee."""
        abduction, hip, knee = joints
        sin, cos = math.sin(abduction), math.cos(abduction)
        knee_x, knee_z = -self.calf * math.cos(hip + knee), self.calf * math.sin(hip + knee)
        hip_x, hip_z = knee_x - self.thigh * math.cos(hip), knee_z + self.thigh * math.sin(hip)
        # hip_x is the leg's height as well: what the hip moves ahead is what hangs below it
        return (
            (0.0, -self.out * sin - hip_x * cos, self.out * cos - hip_x * sin),
            (hip_x, -hip_z * sin, hip_z * cos),
            (knee_x, -knee_z * sin, knee_z * cos),
        )


@dataclass(frozen=True)
class LegGeometry:
    """The measures of a quadruped [m]; the defaults are alpha's. Front and rear knees face."""

    hip_x: float = 0.19  # of the abduction axes from the body's middle, ahead and behind
    hip_y: float = 0.05
    abduction: float = 0.085  # from the abduction axis out to the leg's plane
    thigh: float = 0.21
    calf: float = 0.21
    foot: float = 0.022  # radius of the ball that the calf ends in

    @cached_property
    def legs(self) -> tuple[Leg, ...]:
        """The legs in the order of LEGS."""
        return tuple(
            Leg(
                hip_x=ahead * self.hip_x,
                hip_y=side * self.hip_y,
                out=side * self.abduction,
                thigh=self.thigh,
                calf=self.calf,
                bend=-ahead,
            )
            for ahead, side in ((1, 1), (1, -1), (-1, 1), (-1, -1))
        )

    def standing(self, height: float) -> tuple[Vector, ...]:
        """The angles of all legs when the body stands with its hips `height` above the feet."""
        return tuple(leg.joints(leg.home(height)) for leg in self.legs)


class Senses(NamedTuple):
    """One sample of all of a quadruped's sensors; legs in the order of `geometry.LEGS`."""

    joints: tuple[Vector, ...]  # [rad], of each leg, by the encoders
    rates: tuple[Vector, ...]  # [rad/s], by the encoders
    contacts: tuple[bool, ...]  # whether the foot bears weight
    orientation: Quaternion  # x, y, z, w; its heading is not used, it drifts
    angular_velocity: Vector  # [rad/s], in the body's frame
    linear_acceleration: Vector  # [m/s2], 9.81 upwards at rest

    def tilt(self) -> tuple[float, float]:
        """(roll, pitch) [rad]."""
        x, y, z, w = self.orientation
        roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
        return roll, math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))


class Gait(NamedTuple):
    """The gait of a quadruped: each foot is on the ground for `duty` of a cycle."""

    stride_x: float  # [m], by which the body moves in one cycle
    stride_y: float  # [m]
    turn: float  # [rad], by which it turns in one cycle
    frequency: float  # [Hz], cycles
    duty: float  # 0-1
    phases: tuple[float, float, float, float]  # 0-1, of front left, front right, rear left, right
    height: float  # [m], of the hips


@dataclass(frozen=True)
class Walker:
    """A quadruped's way to walk: a trot whose steps grow with the speed, then come faster."""

    frequency: float = 2.5  # [Hz], as long as the stride allows it
    max_frequency: float = 4.0  # [Hz]
    max_stride: float = 0.2  # [m] in one cycle
    duty: float = 0.55
    height: float = 0.29  # [m]
    phases: tuple[float, float, float, float] = (0.0, 0.5, 0.5, 0.0)

    def to_gait(self, twist: Twist) -> Gait:
        """The gait for a velocity; faster than it can step, all parts slow down alike."""
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
        """The velocity of a body whose feet do not slip."""
        strides = (gait.stride_x, gait.stride_y, gait.turn)
        return Twist(*(stride * gait.frequency for stride in strides))


# Quick and short steps: while two feet bear the body it tips over them, the less the sooner they
# change. At 2.5 Hz the body's speed swings by 0.036 m/s rms at 0.3 m/s, at 3.6 Hz by half of that.
WALKER = Walker(frequency=3.6, max_frequency=4.2, duty=0.6)


def is_sound(gait: Gait) -> bool:
    """Return whether all values are numbers, and within what the legs can do.

    On the wire they are f32, by which a limit may be rounded up.
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
        least - F32_ROUNDING <= value <= most + F32_ROUNDING for value, least, most in limited
    ) and all(0.0 <= phase < 1.0 for phase in gait.phases)


class LegOdometry:
    """Velocity and pose since the start. `update` with each sample, some 100 times a second.

    A foot that bears weight rolls on the floor without slipping, so the body moves against it.
    The feet on the floor are averaged; between them the accelerometer fills in (Bloesch et al.,
    "State Estimation for Legged Robots", RSS 2012, in its simplest form).
    """

    def __init__(self, geometry: LegGeometry) -> None:
        self._geometry = geometry
        self._stood: tuple[bool, ...] = (False,) * 4
        self._velocity = (0.0, 0.0, 0.0)  # [m/s], in the body's frame
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)
        self.velocity = Twist(0.0, 0.0, 0.0)  # along the floor

    def update(self, senses: Senses, passed_s: float) -> None:
        """Integrate a sample, `passed_s` after the one before."""
        passed_s = min(passed_s, MAX_SAMPLE_GAP_S)
        tilt = senses.tilt()
        velocity = self._by_accelerometer(senses, tilt, passed_s)
        firm = zip(senses.contacts, self._stood, strict=True)
        by_feet = [self._by_foot(senses, leg) for leg, both in enumerate(firm) if all(both)]
        if by_feet:
            share, count = min(1.0, passed_s / FEET_TIME_CONSTANT_S), len(by_feet)
            x, y, z = (sum(part) / count for part in zip(*by_feet, strict=True))
            velocity = (
                velocity[0] + share * (x - velocity[0]),
                velocity[1] + share * (y - velocity[1]),
                velocity[2] + share * (z - velocity[2]),
            )
        self._velocity, self._stood = velocity, senses.contacts
        self.velocity = Twist(*_level(tilt, velocity), senses.angular_velocity[2])
        x, y, turn = self.velocity
        self.pose = advance_pose(self.pose, Twist(x * passed_s, y * passed_s, turn * passed_s))

    def _by_foot(self, senses: Senses, number: int) -> Vector:
        """The body's velocity if this foot stands still where it touches the floor [m/s]."""
        leg, joints = self._geometry.legs[number], senses.joints[number]
        rates, radius = senses.rates[number], self._geometry.foot
        x, y, z = leg.foot(joints)
        (ax, ay, az), (bx, by, bz), (cx, cy, cz) = leg.jacobian(joints)
        a, b, c = rates
        moved_x = ax * a + bx * b + cx * c - radius * (b + c) * math.cos(joints[0])
        moved_y = ay * a + by * b + cy * c + radius * a  # the ball rolls
        moved_z = az * a + bz * b + cz * c
        turned = _cross(senses.angular_velocity, (x, y, z - radius))
        return -moved_x - turned[0], -moved_y - turned[1], -moved_z - turned[2]

    def _by_accelerometer(
        self, senses: Senses, tilt: tuple[float, float], passed_s: float
    ) -> Vector:
        """The velocity of the last sample, and what it has gained since [m/s]."""
        roll, pitch = tilt
        level = GRAVITY * math.cos(pitch)
        down = (-GRAVITY * math.sin(pitch), level * math.sin(roll), level * math.cos(roll))
        felt, before = senses.linear_acceleration, self._velocity
        turned = _cross(senses.angular_velocity, before)
        gained = [passed_s * (felt[i] - down[i] - turned[i]) for i in range(3)]
        return before[0] + gained[0], before[1] + gained[1], before[2] + gained[2]


def _level(tilt: tuple[float, float], velocity: Vector) -> tuple[float, float]:
    """The velocity along the floor, ahead and to the left [m/s]."""
    roll, pitch = tilt
    x, y, z = velocity
    sideways = math.cos(roll) * y - math.sin(roll) * z
    rising = math.sin(roll) * y + math.cos(roll) * z
    return math.cos(pitch) * x + math.sin(pitch) * rising, sideways


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
