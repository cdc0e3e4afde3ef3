"""Where the legs have carried a body: joints, contacts, turn rate and accelerometer, nothing more.

A foot that bears weight rolls on the floor without slipping, so the body moves against it. Several
feet say so at once and are averaged; between them the accelerometer fills in (Bloesch et al.,
"State Estimation for Legged Robots", RSS 2012, in its simplest form).
"""

import math

from gigabrain_drivers.kinematics import Twist
from gigabrain_drivers.legs.geometry import LegGeometry, Vector
from gigabrain_drivers.legs.senses import Senses
from gigabrain_drivers.odometry import advanced
from gigabrain_schemas.base import Pose

GRAVITY = 9.81  # [m/s2]
TRUST_S = 0.04  # how long the legs need to overrule the accelerometer
LONGEST_S = 0.1  # a longer gap between two samples counts as so long


class LegOdometry:
    """Velocity and pose since the start. `update` with each sample, some 100 times a second."""

    def __init__(self, geometry: LegGeometry) -> None:
        self._geometry = geometry
        self._stood: tuple[bool, ...] = (False,) * 4
        self._velocity = (0.0, 0.0, 0.0)  # [m/s], in the body's frame
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)
        self.velocity = Twist(0.0, 0.0, 0.0)  # along the floor

    def update(self, senses: Senses, passed_s: float) -> None:
        """Take in a sample, `passed_s` after the one before."""
        passed_s = min(passed_s, LONGEST_S)
        tilt = senses.tilt()
        velocity = self._by_accelerometer(senses, tilt, passed_s)
        firm = zip(senses.contacts, self._stood, strict=True)
        by_feet = [self._by_foot(senses, leg) for leg, both in enumerate(firm) if all(both)]
        if by_feet:
            share, count = min(1.0, passed_s / TRUST_S), len(by_feet)
            x, y, z = (sum(part) / count for part in zip(*by_feet, strict=True))
            velocity = (
                velocity[0] + share * (x - velocity[0]),
                velocity[1] + share * (y - velocity[1]),
                velocity[2] + share * (z - velocity[2]),
            )
        self._velocity, self._stood = velocity, senses.contacts
        self.velocity = Twist(*_level(tilt, velocity), senses.angular_velocity[2])
        x, y, turn = self.velocity
        self.pose = advanced(self.pose, Twist(x * passed_s, y * passed_s, turn * passed_s))

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
