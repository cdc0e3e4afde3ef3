"""Static frames: the tree of /tf_static, and transforms. Pure."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats

MAX_FRAMES = 1000  # of the tree; a robot has some fifty
MAX_TILT_RAD = 0.17  # 10 degrees, of a lidar's plane; beyond it, ranges are no planar distances


class Transform(NamedTuple):
    """The pose of a frame in its parent frame."""

    turn: Floats  # (3, 3)
    shift: Floats  # (3,) [m]

    def then(self, inner: "Transform") -> "Transform":
        """Return the transform of `inner`, a frame in this one, in this one's parent."""
        return Transform(self.turn @ inner.turn, self.turn @ inner.shift + self.shift)

    @property
    def planar(self) -> tuple[float, float, float]:
        """Return x [m], y [m] and yaw [rad], seen from above."""
        yaw = math.atan2(self.turn[1, 0], self.turn[0, 0])
        return float(self.shift[0]), float(self.shift[1]), yaw

    @property
    def tilt(self) -> float:
        """Angle between its plane and the floor [rad]; 0 if it is upside down."""
        return math.acos(min(1.0, abs(float(self.turn[2, 2]))))


IDENTITY = Transform(np.eye(3), np.zeros(3))


def planar(x: float, y: float, yaw: float) -> Transform:
    """Return the transform of a pose in the plane."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Transform(turn, np.array([x, y, 0.0]))


def rotation(x: float, y: float, z: float, w: float) -> Floats | None:
    """Return the matrix (3, 3) of a quaternion; None if it is invalid."""
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not 0.9 < norm < 1.1:  # also false for NaN
        return None
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


class FrameTree:
    """Frames by name, each with its parent."""

    def __init__(self) -> None:
        self._frames: dict[str, tuple[str, Transform]] = {}

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def names(self) -> list[str]:
        """All frames, parents as well."""
        return sorted({*self._frames, *(parent for parent, _ in self._frames.values())})

    def add(self, transforms: Iterable[Any]) -> None:
        """Add TransformStamped messages, except invalid ones."""
        for one in transforms:
            moved, turned = one.transform.translation, one.transform.rotation
            turn = rotation(turned.x, turned.y, turned.z, turned.w)
            shift = np.array([moved.x, moved.y, moved.z])
            child, parent = _plain(one.child_frame_id), _plain(one.header.frame_id)
            if turn is None or not np.isfinite(shift).all() or not child or child == parent:
                continue
            if child in self._frames or len(self._frames) < MAX_FRAMES:
                self._frames[child] = (parent, Transform(turn, shift))

    def find(self, frame: str, base: str) -> Transform | None:
        """Return the transform of `frame` in `base`; None if they are not connected."""
        up, down = self._to_root(_plain(frame)), self._to_root(_plain(base))
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        to, of = up[common], down[common]
        turn = of.turn.T
        return Transform(turn, -turn @ of.shift).then(to)

    def _to_root(self, frame: str) -> dict[str, Transform]:
        """Return the transform of a frame in itself and in its ancestors, nearest first."""
        found = {frame: IDENTITY}
        place = IDENTITY
        while frame in self._frames:
            frame, own = self._frames[frame]
            if frame in found:  # a cycle
                break
            place = own.then(place)
            found[frame] = place
        return found


def _plain(frame: str) -> str:
    """Return the name without a leading slash, as in tf2."""
    return frame.lstrip("/")
