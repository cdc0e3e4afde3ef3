"""Four legs of three joints each: where the feet are, and by which angles they get there.

Places are in the body's frame (x ahead, y to the left, z up) [m], angles [rad] follow the right
hand: abduction about x, hip and knee about y. At zero a leg hangs straight down.
"""

import math
from dataclasses import dataclass
from functools import cached_property

Vector = tuple[float, float, float]

LEGS = ("front_left", "front_right", "rear_left", "rear_right")
JOINTS = ("abduction", "hip", "knee")
JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
STRAIGHTEST = 0.999  # of the whole leg; fully stretched it could not be steered


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
        reach = min(math.hypot(x, drop), STRAIGHTEST * (self.thigh + self.calf))
        cosine = (reach**2 - self.thigh**2 - self.calf**2) / (2 * self.thigh * self.calf)
        knee = self.bend * math.acos(min(max(cosine, -1.0), 1.0))
        lean = math.atan2(self.calf * math.sin(knee), self.thigh + self.calf * math.cos(knee))
        return math.remainder(abduction, math.tau) * side, math.atan2(-x, drop) - lean, knee

    def foot(self, joints: Vector) -> Vector:
        """Where the middle of the foot is."""
        abduction, hip, knee = joints
        x = -self.thigh * math.sin(hip) - self.calf * math.sin(hip + knee)
        z = -self.thigh * math.cos(hip) - self.calf * math.cos(hip + knee)
        sin, cos = math.sin(abduction), math.cos(abduction)
        return self.hip_x + x, self.hip_y + self.out * cos - z * sin, self.out * sin + z * cos

    def jacobian(self, joints: Vector) -> tuple[Vector, Vector, Vector]:
        """By how much the foot moves per radian [m]: of the abduction, of the hip, of the knee."""
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
        """In the order of LEGS."""
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
