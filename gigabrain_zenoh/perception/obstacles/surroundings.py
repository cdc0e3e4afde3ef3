"""Worlds with the things in them that are followed from scan to scan."""

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas import arrays
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.brain import WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.perception.obstacles.tracker import ObstacleTracker


class Surroundings:
    """Remembers what was round the robot in the scans before."""

    def __init__(self) -> None:
        self._tracker = ObstacleTracker()

    def add(
        self, world: WorldModel, lidar: Lidar | None, scan: LaserScan, pose: Pose | None
    ) -> WorldModel:
        """`world` with the obstacles in the frame of `pose`; without, where that is not known."""
        if lidar is None or pose is None or not world.scan_ok:
            return world
        hits = arrays.hits(world).astype(np.float64)
        found = self._tracker.update(hits, lidar, scan.angle_increment, pose, scan.boot, scan.basis)
        return replace(world, obstacles=found)
