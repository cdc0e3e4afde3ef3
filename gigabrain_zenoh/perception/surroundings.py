"""What one scan says of the place: what may hide things, and which cameras can be believed."""

from dataclasses import dataclass

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.brain import Contour, WorldModel

STEP_M = 0.05  # between points on the rim of a contour


@dataclass(frozen=True)
class Surroundings:
    """A scan, its world, and the keyframes of the map after it."""

    body: BodyDescription
    world: WorldModel
    points: Floats  # (n, 2) [m], hits in the body's frame
    keyframes: Floats  # (n, 3), their poses in the map

    def camera(self, name: str) -> Camera | None:
        """Return a camera that can be believed; None for others.

        One whose pictures have never come here is judged by what is recognised in them alone.
        """
        blind = any(one.name == name and one.exposure and not one.ok for one in self.world.cameras)
        found = (one for one in self.body.cameras if one.name == name)
        return None if blind else next(found, None)

    def hiding(self, height: float) -> Floats:
        """Return points (n, 2) [m] of what may hide a thing from a camera of that `height` [m]."""
        rims = [_rim(one) for one in self.world.contours if one.top >= height]
        return np.concatenate((self.points, *rims))


def _rim(contour: Contour) -> Floats:
    """Return points (n, 2) on the rim of a contour [m]."""
    corners = np.array(contour.polygon)
    sides = np.roll(corners, -1, axis=0) - corners
    counts = np.clip(np.ceil(np.hypot(*sides.T) / STEP_M), 1, 64).astype(int)
    return np.concatenate(
        [
            corner + np.outer(np.arange(count) / count, side)
            for corner, side, count in zip(corners, sides, counts, strict=True)
        ]
    )
