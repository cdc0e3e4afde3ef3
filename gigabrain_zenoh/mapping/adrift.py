"""What odometry did since a scan was matched, and what that makes uncertain."""

from dataclasses import dataclass, replace

import numpy as np

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.mapping.correlative import Window

MISSES, MISSED_TRAVEL, MISSED_TURN = 3, 0.5, 0.5  # scans, [m], [rad]: after these it is broken,
MISSES_STANDING = 30  # or after so many scans
UNKNOWN = np.diag((10.0, 10.0, np.pi)) ** 2  # covariance of a link that nothing is known of


@dataclass(frozen=True, slots=True)
class Adrift:
    """What odometry did since a scan was matched."""

    misses: int = 0  # scans in a row that fit one another, but not the map
    travel: float = 0.0  # [m]
    turn: float = 0.0  # [rad]
    blind: bool = False  # there was nothing to match for a while, so odometry may be right

    def moved(self, delta: Floats, blind: bool) -> "Adrift":
        """After odometry has moved by `delta` (3,) once more."""
        travel = self.travel + float(np.hypot(delta[0], delta[1]))
        turn = self.turn + abs(float(delta[2]))
        return Adrift(self.misses, travel, turn, self.blind or blind)

    def missed(self, fits: bool) -> "Adrift":
        """Return the state after a scan that was not matched; `fits` the one missed before it."""
        return replace(self, misses=self.misses + 1 if fits else 1)

    @property
    def covariance(self) -> Floats:
        """Of the odometry since; generous, as wheels slip and bad odometry is common."""
        away, turn = 0.1 + 0.2 * self.travel, 0.1 + 0.3 * self.turn
        return np.diag((away**2, away**2, turn**2))

    @property
    def broken(self) -> bool:
        """Whether nothing joins what comes to what was before: the robot was carried off.

        Scans that fit neither the map nor one another say nothing: trees in the wind, a slope.
        """
        return (self.misses >= MISSES and self.far) or self.misses >= MISSES_STANDING

    @property
    def far(self) -> bool:
        """Whether what was matched last may be out of sight by now."""
        return self.travel > MISSED_TRAVEL or self.turn > MISSED_TURN

    def after_break(self) -> Floats:
        """The covariance of the link over a break."""
        return self.covariance if self.blind else UNKNOWN

    @property
    def window(self) -> Window:
        """Where to search: the farther odometry has moved, the wider."""
        effort = min(1.0, self.travel / 0.5 + self.turn / 0.3)
        return Window(0.15 + 0.2 * effort, 0.12 + 0.23 * effort)
