"""Scans with the place that they were taken from.

A scan of a tick whose state is still on its way waits for it: no outcome may depend on which of two
messages was quicker. One from the future waits until the next one takes its place.
"""

from collections.abc import Callable

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.pose_history import PoseHistory


class PlacedScans:
    """Calls `on_scan(scan, pose)`; the pose is None where the states of that time are missing."""

    def __init__(self, on_scan: Callable[[LaserScan, Pose | None], None]) -> None:
        self._on_scan = on_scan
        self._waiting: LaserScan | None = None
        self.history = PoseHistory()

    def state(self, state: RobotState) -> None:
        """Take one state."""
        self.history = self.history.then(state)
        if self._waiting:
            self.scan(self._waiting)

    def scan(self, scan: LaserScan) -> None:
        """Take one scan."""
        here = self.history
        self._waiting = scan
        if scan.boot == here.boot and scan.basis <= here.newest_tick:
            self._waiting = None
            self._on_scan(scan, here.at(scan.boot, scan.basis))
