"""Poses in the plane: x [m], y [m], yaw [rad], in arrays of shape (..., 3)."""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose

IDENTITY: Floats = np.zeros(3)
IDENTITY.flags.writeable = False


def from_pose(pose: Pose) -> Floats:
    """Return `pose` as an array (3,)."""
    return np.array((pose.x, pose.y, pose.yaw))


def wrap(angle: Floats) -> Floats:
    """Return the same angles within -pi to pi [rad]."""
    return np.asarray(np.remainder(angle + np.pi, 2 * np.pi) - np.pi)


def wrapped(pose: Floats) -> Floats:
    """Return the same poses with their yaw within -pi to pi."""
    if pose.ndim == 1:
        x, y, yaw = pose.tolist()
        return np.array((x, y, _wrapped(yaw)))
    return np.concatenate((pose[..., :2], wrap(pose[..., 2:])), axis=-1)


def compose(first: Floats, second: Floats) -> Floats:
    """Transform pose `second` from the frame `first` to the parent frame."""
    if first.ndim == second.ndim == 1:
        return np.array(composed(*first.tolist(), *second.tolist()))
    cos, sin = np.cos(first[..., 2]), np.sin(first[..., 2])
    x = first[..., 0] + cos * second[..., 0] - sin * second[..., 1]
    y = first[..., 1] + sin * second[..., 0] + cos * second[..., 1]
    return np.stack((x, y, wrap(first[..., 2] + second[..., 2])), axis=-1)


def inverse(pose: Floats) -> Floats:
    """Return the inverse transform: the parent frame as seen from `pose`."""
    if pose.ndim == 1:
        return np.array(_inverted(*pose.tolist()))
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = -cos * pose[..., 0] - sin * pose[..., 1]
    y = sin * pose[..., 0] - cos * pose[..., 1]
    return np.stack((x, y, wrap(-pose[..., 2])), axis=-1)


# the same for single poses; numpy takes six times as long for one


def _wrapped(angle: float) -> float:
    return (angle + math.pi) % math.tau - math.pi


def composed(
    x: float, y: float, yaw: float, x2: float, y2: float, yaw2: float
) -> tuple[float, float, float]:
    """Transform the second pose from the frame of the first to the parent frame."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return x + cos * x2 - sin * y2, y + sin * x2 + cos * y2, _wrapped(yaw + yaw2)


def _inverted(x: float, y: float, yaw: float) -> tuple[float, float, float]:
    cos, sin = math.cos(yaw), math.sin(yaw)
    return -cos * x - sin * y, sin * x - cos * y, _wrapped(-yaw)


def between(first: Floats, second: Floats) -> Floats:
    """Return `second` relative to `first`, both given in the same frame."""
    if first.ndim == second.ndim == 1:
        return np.array(composed(*_inverted(*first.tolist()), *second.tolist()))
    return compose(inverse(first), second)


def rotation(yaw: float) -> Floats:
    """Return the (3, 3) matrix that turns x and y by `yaw` and keeps the third."""
    cos, sin = float(np.cos(yaw)), float(np.sin(yaw))
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def turned(covariance: Floats, yaw: float) -> Floats:
    """Return a (3, 3) covariance of x, y, yaw with its axes turned by `yaw`."""
    turn = rotation(yaw)
    return np.asarray(turn @ covariance @ turn.T)


def inverse_of(matrix: Floats) -> Floats:
    """Return the inverse of a (3, 3) covariance or information matrix."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def transform(pose: Floats, points: NDArray[np.floating]) -> Floats:
    """Transform points (n, 2) from the frame `pose` to its parent frame."""
    turn = rotation(float(pose[2]))[:2, :2]
    return np.asarray(points @ turn.T + pose[:2], dtype=np.float64)
