"""LDS-02 (LDROBOT LD08), the lidar of most TurtleBot3: LD frames of a lens beside the axis."""

import math

from gigabrain_drivers.lidars.ld import Ld
from gigabrain_drivers.protocols import ld

OFFSET_X, OFFSET_Y = 5.9, -20.14  # [mm], of the lens
SLANT = 0.11923  # of the beam against the direction that the lidar tells


class Lds02(Ld):
    """Starts with its power. It measures from its lens, which goes round the axis."""

    name, rate_baud = "LDS-02", 115_200
    samples_hz = 2300.0

    def place(self, frame: ld.Frame) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Angles [deg], clockwise, and distances [mm], both seen from the axis, (12,) each."""
        pairs = zip(frame.angles(), frame.distances, strict=True)
        placed = [from_axis(angle, distance) for angle, distance in pairs]
        return tuple(angle for angle, _ in placed), tuple(distance for _, distance in placed)


def from_axis(angle: float, distance: float) -> tuple[float, float]:
    """A measurement from the lens ([deg] clockwise, [mm]) as it is seen from the axis.

    Source: the vendor's ld08_driver, `SlTransform`. No return (0 mm) stays where it is.
    """
    if not distance:
        return angle, distance
    x, y = distance + OFFSET_X, SLANT * distance + OFFSET_Y
    return angle - math.degrees(math.atan2(y, x)), math.hypot(x, y)
