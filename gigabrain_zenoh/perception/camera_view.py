"""The place of a thing in a camera's picture, and hits of the scan that may hide it."""

import math
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.camera_model import rotation

EDGE = 0.08  # of the picture's width and height, at its rim: what is there may be cut off
MIN_PX = 10.0  # a smaller thing is not surely recognised
NEAREST_M = 0.35
BEAM_RAD = math.radians(1.5)  # beside a line of sight, in which a hit hides what is behind


class Spot(NamedTuple):
    """The place of a thing in a picture."""

    pixel: tuple[float, float]
    depth: float  # [m], along the camera's axis


class CameraView:
    """A camera as its file mounts it, without its distortion: for what is well inside."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._origin: Floats = np.array((camera.x, camera.y, camera.z))
        self._turn = rotation(camera.roll, camera.pitch, camera.yaw)

    def spot(self, position: Floats, extent: float, farthest: float) -> Spot | None:
        """Return where a thing (3,) [m] of an `extent` [m], in the body's frame, is seen.

        None if it is cut off, too small, too near, or more than `farthest` [m] away.
        """
        camera = self._camera
        depth, left, up = (self._turn.T @ (position - self._origin)).tolist()
        if not NEAREST_M <= depth <= farthest:
            return None
        fx, fy, cx, cy = camera.pinhole
        u, v = cx - fx * left / depth, cy - fy * up / depth
        half = fx * extent / 2 / depth
        rim_u, rim_v = EDGE * camera.width + half, EDGE * camera.height + half
        inside = rim_u <= u <= camera.width - rim_u and rim_v <= v <= camera.height - rim_v
        return Spot((u, v), depth) if inside and 2 * half >= MIN_PX else None

    def hidden(self, hits: Floats, place: tuple[float, float], before: float) -> bool:
        """Return whether a hit of the scan (n, 2) lies on the way to a place, and `before` it [m].

        All in the body's frame. What the scan does not meet, because it is low, is not known.
        """
        if not len(hits):
            return False
        way = np.array(place) - self._origin[:2]
        far = float(np.hypot(*way))
        off = hits - self._origin[:2]
        along = off @ way / max(far, 1e-6)
        beside = np.abs(off[:, 0] * way[1] - off[:, 1] * way[0]) / max(far, 1e-6)
        hiding = (along > 0.05) & (along < far - before) & (beside < along * math.tan(BEAM_RAD))
        return bool(hiding.any())
