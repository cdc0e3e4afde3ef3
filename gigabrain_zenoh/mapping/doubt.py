"""Does a scan suddenly not belong where the robot is thought to be? Then it was carried off.

A map that drifts, or a room that changes, disagrees with what is seen little by little; somebody
who lifts the robot makes it disagree from one scan to the next.
"""

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.mapping.field import contradiction, field_of
from gigabrain_zenoh.mapping.grid import CELL, Grid
from gigabrain_zenoh.mapping.localizer import View

REACH_M = 5.0  # round the robot, beams that end farther off are not judged
SUDDEN = 0.3  # so many more of all beams than before
SHARE = 0.1  # of a new scan in what is usual
SCANS = 3  # in a row, then it is certain


class Doubt:
    """Looks at each scan before the map takes it."""

    def __init__(self) -> None:
        self._usual = 0.0  # share of beams that the map rules out
        self.scans = 0  # in a row that do not belong here

    @property
    def certain(self) -> bool:
        """Whether the robot is somewhere else."""
        return self.scans >= SCANS

    def look(self, grid: Grid, view: View, pose: Floats) -> bool:
        """Whether the scan does not belong at `pose`, where odometry has the robot."""
        cells, corner = grid.around(float(pose[0]), float(pose[1]), REACH_M)
        if not cells.size:
            return False
        field = field_of(cells, CELL, corner)
        share = contradiction(field, view.scan.points, view.scan.free, view.sensor, pose)
        if share > self._usual + SUDDEN:
            self.scans += 1
            return True
        self._usual += SHARE * (share - self._usual)
        self.scans = 0
        return False
