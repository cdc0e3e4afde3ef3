"""LDS-02 (LDROBOT LD08), the lidar of most TurtleBot3: LD frames of a lens beside the axis."""

import numpy as np

from gigabrain_drivers.lidars.ld.source import Ld
from gigabrain_drivers.lidars.turn import Samples

OFFSET_X, OFFSET_Y = 5.9, -20.14  # [mm], of the lens
SLANT = 0.11923  # of the beam against the direction that the lidar tells


class Lds02(Ld):
    """Starts with its power. It measures from its lens, which goes round the axis."""

    name, rate_baud = "LDS-02", 115_200
    samples_hz = 2300.0

    def place(self, angles: Samples, distances: Samples) -> tuple[Samples, Samples]:
        """Both seen from the axis."""
        return from_axis(angles, distances)


def from_axis(angles: Samples, distances: Samples) -> tuple[Samples, Samples]:
    """Measurements (n,) from the lens ([deg] clockwise, [mm]) as they are seen from the axis.

    Source: the vendor's ld08_driver, `SlTransform`. No return (0 mm) stays where it is.
    """
    x, y = distances + OFFSET_X, SLANT * distances + OFFSET_Y
    seen = distances != 0
    turned = angles - np.degrees(np.arctan2(y, x))
    return np.where(seen, turned, angles), np.where(seen, np.hypot(x, y), distances)
