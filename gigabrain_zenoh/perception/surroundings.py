"""Surroundings at one scan: points that may hide things, and cameras that are reliable."""

from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.brain import WorldModel
from gigabrain_zenoh.geometry.polygon import points_on_edges

STEP_M = 0.05  # between points on the edges of a contour
MAX_EDGE_POINTS = 64


@dataclass(frozen=True)
class Surroundings:
    """A scan, its world, and the keyframes of the map after it."""

    body: BodyDescription
    world: WorldModel
    points: Floats  # (n, 2) [m], hits in the body's frame
    keyframes: Floats  # (n, 3), their poses in the map

    def camera(self, name: str) -> Camera | None:
        """Return a camera; None if it is unknown, or its pictures are not ok.

        A camera of which this process has received no picture is ok.
        """
        blind = any(one.name == name and one.exposure and not one.ok for one in self.world.cameras)
        found = (one for one in self.body.cameras if one.name == name)
        return None if blind else next(found, None)

    def hiding(self, height: float) -> Floats:
        """Return points (n, 2) [m] that may hide a thing from a camera at `height` [m]."""
        high = [np.array(one.polygon) for one in self.world.contours if one.top >= height]
        if not high:
            return self.points
        return np.concatenate((self.points, points_on_edges(high, STEP_M, MAX_EDGE_POINTS)))
