"""Scans with the place that they were taken from.

A scan of a tick whose state is still on its way waits for it: no outcome may depend on which of two
messages was quicker. One from the future waits until the next one takes its place, and is missed.
"""

from collections.abc import Callable

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.pose_history import PoseHistory


class PlacedScans:
    """Calls `on_scan(scan, pose)`; the pose is None where the states of that time are missing.

    A scan whose tick had not come when the next scan did goes to `on_missed`.
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
        """Take one state."""
        self.history = self.history.then(state)
        if self._waiting:
            self._place(self._waiting)

    def scan(self, scan: LaserScan) -> None:
        """Take one scan."""
        if self._waiting:
            self._on_missed(self._waiting)
        self._place(scan)

    def _place(self, scan: LaserScan) -> None:
        """Hand a scan on, or have it wait."""
        here = self.history
        self._waiting = scan
        if scan.boot == here.boot and scan.basis <= here.newest_tick:
            self._waiting = None
            self._on_scan(scan, here.at(scan.boot, scan.basis))
