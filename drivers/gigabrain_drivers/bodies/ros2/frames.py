"""The tree of static frames in /tf_static, and transforms. Pure."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from gigabrain_schemas.arrays import Floats

MAX_FRAMES = 1000  # in the tree; a robot has about fifty
MAX_TILT_RAD = 0.17  # 10 degrees; ranges of a lidar that is tilted more are not horizontal


class Transform(NamedTuple):
    """The pose of a frame in its parent frame."""

    turn: Floats  # (3, 3) rotation matrix
    shift: Floats  # (3,) translation [m]

    def then(self, inner: "Transform") -> "Transform":
        """Return the pose of `inner`, a frame in this one, in the parent frame."""
        return Transform(self.turn @ inner.turn, self.turn @ inner.shift + self.shift)

    @property
    def planar(self) -> tuple[float, float, float]:
        """Return x [m], y [m] and yaw [rad], seen from above."""
        yaw = math.atan2(self.turn[1, 0], self.turn[0, 0])
        return float(self.shift[0]), float(self.shift[1]), yaw

    @property
    def tilt(self) -> float:
        """Angle between its x-y plane and the floor [rad]; also 0 if it is upside down."""
        return math.acos(min(1.0, abs(float(self.turn[2, 2]))))


IDENTITY = Transform(np.eye(3), np.zeros(3))


def planar(x: float, y: float, yaw: float) -> Transform:
    """Return the transform of a planar pose [m, m, rad]."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return Transform(turn, np.array([x, y, 0.0]))


def rotation(x: float, y: float, z: float, w: float) -> Floats | None:
    """Return the rotation matrix (3, 3) of a quaternion; None if its length is not about 1."""
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
        """Names of all frames, including parents."""
        return sorted({*self._frames, *(parent for parent, _ in self._frames.values())})

    def add(self, transforms: Iterable[Any]) -> None:
        """Add TransformStamped messages, except invalid ones."""
        for stamped in transforms:
            translation, quaternion = stamped.transform.translation, stamped.transform.rotation
            turn = rotation(quaternion.x, quaternion.y, quaternion.z, quaternion.w)
            shift = np.array([translation.x, translation.y, translation.z])
            child = _without_slash(stamped.child_frame_id)
            parent = _without_slash(stamped.header.frame_id)
            if turn is None or not np.isfinite(shift).all() or not child or child == parent:
                continue
            if child in self._frames or len(self._frames) < MAX_FRAMES:
                self._frames[child] = (parent, Transform(turn, shift))

    def find(self, frame: str, base: str) -> Transform | None:
        """Return the transform of `frame` in `base`; None if they are not connected."""
        from_frame = self._to_root(_without_slash(frame))
        from_base = self._to_root(_without_slash(base))
        common = next((name for name in from_frame if name in from_base), None)
        if common is None:
            return None
        frame_pose, base_pose = from_frame[common], from_base[common]
        turn = base_pose.turn.T
        return Transform(turn, -turn @ base_pose.shift).then(frame_pose)

    def _to_root(self, frame: str) -> dict[str, Transform]:
        """Return the poses of a frame in itself and in each of its ancestors, nearest first."""
        found = {frame: IDENTITY}
        place = IDENTITY
        while frame in self._frames:
            frame, own = self._frames[frame]
            if frame in found:  # a cycle
                break
            place = own.then(place)
            found[frame] = place
        return found


def _without_slash(frame: str) -> str:
    """Return the name without a leading slash, as in tf2."""
    return frame.lstrip("/")
