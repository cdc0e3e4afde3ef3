"""Pairs each scan with the odometry pose of its tick.

A scan that arrives before the state of its tick waits for that state. The outcome thus never
depends on which message came first. If the next scan comes first, the waiting one is reported as
missed.
"""

from collections.abc import Callable

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.pose import PoseHistory


class PlacedScans:
    """Calls `on_scan(scan, pose)` for each scan; the pose is None where states are missing.

    A scan whose state had not arrived when the next scan came goes to `on_missed`.
    """

    def __init__(
        self,
        on_scan: Callable[[LaserScan, Pose | None], None],
        on_missed: Callable[[LaserScan], None],
    ) -> None:
        self._on_scan, self._on_missed = on_scan, on_missed
        self._waiting: LaserScan | None = None
        self.history = PoseHistory()

    def state(self, state: RobotState) -> None:
        """Add a robot state; process the waiting scan if its tick has been reached."""
        self.history = self.history.then(state)
        if self._waiting:
            self._place(self._waiting)

    def scan(self, scan: LaserScan) -> None:
        """Process a scan, or keep it until the state of its tick arrives."""
        if self._waiting:
            self._on_missed(self._waiting)
        self._place(scan)

    def _place(self, scan: LaserScan) -> None:
        """Hand a scan on if its tick has been reached; otherwise keep it waiting."""
        here = self.history
        self._waiting = scan
        if scan.boot == here.boot and scan.basis <= here.newest_tick:
            self._waiting = None
            self._on_scan(scan, here.at(scan.boot, scan.basis))
