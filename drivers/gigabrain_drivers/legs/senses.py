"""What a quadruped measures of itself. Nothing here knows the truth."""

import math
from typing import NamedTuple

from gigabrain_drivers.legs.geometry import Vector

Quaternion = tuple[float, float, float, float]


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
