"""Locates things in a camera's picture, and finds scan hits that may hide them."""

import math
from typing import NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.camera_model import rotation

RIM_SHARE = 0.08  # of the picture's width and height; things in this rim may be cut off
MIN_PX = 10.0  # smaller things are not recognised reliably
NEAREST_M = 0.35
BEAM_RAD = math.radians(1.5)  # half width of a line of sight; hits in it hide what is behind them


class Spot(NamedTuple):
    """Position of a thing in a picture."""

    pixel: tuple[float, float]
    depth: float  # [m], along the camera's axis


class CameraView:
    """A camera as mounted in the body's file, for things well inside its picture.

    Distortion is ignored.
    """

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self._origin: Floats = np.array((camera.x, camera.y, camera.z))
        self._turn = rotation(camera.roll, camera.pitch, camera.yaw)

    def spot(self, position: Floats, extent: float, farthest: float) -> Spot | None:
        """Return where a thing of size `extent` [m] at `position` (3,) [m] is in the picture.

        The position is in the body's frame. None if the thing is cut off, too small, too near, or
        more than `farthest` [m] away.
        """
        camera = self._camera
        depth, left, up = (self._turn.T @ (position - self._origin)).tolist()
        if not NEAREST_M <= depth <= farthest:
            return None
        fx, fy, cx, cy = camera.pinhole
        u, v = cx - fx * left / depth, cy - fy * up / depth
        half = fx * extent / 2 / depth
        rim_u, rim_v = RIM_SHARE * camera.width + half, RIM_SHARE * camera.height + half
        inside = rim_u <= u <= camera.width - rim_u and rim_v <= v <= camera.height - rim_v
        return Spot((u, v), depth) if inside and 2 * half >= MIN_PX else None

    def hidden(self, hits: Floats, place: tuple[float, float], before: float) -> bool:
        """Return whether one of the scan's `hits` (n, 2) hides a place.

        It must be on the line of sight, and more than `before` [m] nearer. All are in the body's
        frame. Low obstacles, which the scan misses, are not considered.
        """
        if not len(hits):
            return False
        way = np.array(place) - self._origin[:2]
        distance = float(np.hypot(*way))
        off = hits - self._origin[:2]
        along = off @ way / max(distance, 1e-6)
        beside = np.abs(off[:, 0] * way[1] - off[:, 1] * way[0]) / max(distance, 1e-6)
        hiding = (
            (along > 0.05) & (along < distance - before) & (beside < along * math.tan(BEAM_RAD))
        )
        return bool(hiding.any())
