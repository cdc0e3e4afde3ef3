"""Conversion between camera pixels and points in the body's frame.

Distortion is Brown's model (k1, k2, p1, p2, k3), or the rational one (plus k4, k5, k6), as in
OpenCV and ROS.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera

Singles = NDArray[np.float32]
Pixels = NDArray[np.intp]
Floating = NDArray[np.floating]
UNDISTORT_ROUNDS = 12
MAX_TANGENT = 6.0  # of the angle between a ray and the axis, 80 degrees
MAX_BACK_ERROR_PX = 0.5  # of a pixel's ray projected back; beyond, the model is not invertible


class CameraModel:
    """Rays and projection of a camera with the mounting in the robot's file."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.origin: Floats = np.array((camera.x, camera.y, camera.z))  # [m], body's frame
        self.rotation = rotation(camera.roll, camera.pitch, camera.yaw)  # to the body's frame
        self._distortion = (*camera.distortion, *[0.0] * 8)[:8]
        self.rays: Singles = self._rays()
        # (3, height, width): in the body's frame, for a depth of 1 m; NaN for pixels without a ray

    def _rays(self) -> Singles:
        camera = self.camera
        fx, fy, cx, cy = camera.pinhole
        u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
        seen_x, seen_y = (u - cx) / fx, (v - cy) / fy
        x, y = seen_x, seen_y
        if any(self._distortion):
            with np.errstate(all="ignore"):
                for _ in range(UNDISTORT_ROUNDS):
                    off_x, off_y = self._distorted(x, y)
                    x, y = x - (off_x - seen_x), y - (off_y - seen_y)
                off_x, off_y = self._distorted(x, y)
                off = np.hypot((off_x - seen_x) * fx, (off_y - seen_y) * fy)
                wrong = ~(off < MAX_BACK_ERROR_PX) | ~(np.hypot(x, y) < MAX_TANGENT)
            x, y = np.where(wrong, np.nan, x), np.where(wrong, np.nan, y)
        in_camera = np.stack((np.ones_like(x), -x, -y))
        turned = np.tensordot(self.rotation, in_camera, axes=1)
        return np.ascontiguousarray(turned, dtype=np.float32)

    def _distorted(self, x: Floating, y: Floating) -> tuple[Floating, Floating]:
        k1, k2, p1, p2, k3, k4, k5, k6 = self._distortion
        square = x * x + y * y
        radial = 1 + square * (k1 + square * (k2 + square * k3))
        radial /= 1 + square * (k4 + square * (k5 + square * k6))
        return (
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )

    def project(self, points: NDArray[np.floating]) -> tuple[Pixels, Pixels, Floats]:
        """Return row, column and depth [m] of points (n, 3) in the body's frame.

        Row and column are -1 for points outside the picture.
        """
        camera = self.camera
        fx, fy, cx, cy = camera.pinhole
        depth, left, up = self.rotation.T @ (points - self.origin).T
        ahead = depth > camera.depth_min / 2
        scale = np.where(ahead, depth, 1.0)
        x, y = -left / scale, -up / scale
        ahead &= np.hypot(x, y) < MAX_TANGENT
        if any(self._distortion):
            with np.errstate(all="ignore"):
                x, y = self._distorted(x, y)
        column, row = np.rint(x * fx + cx), np.rint(y * fy + cy)
        inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0)
        inside &= row < camera.height
        return (
            np.where(inside, row, -1).astype(np.intp),
            np.where(inside, column, -1).astype(np.intp),
            depth,
        )


def rotation(roll: float, pitch: float, yaw: float) -> Floats:
    """Return the (3, 3) matrix from the camera's frame to the body's: about x, then y, then z."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(about_z @ about_y @ about_x, dtype=np.float64)
