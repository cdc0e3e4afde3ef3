"""Depth pictures of scenes of boxes on a floor, computed without a renderer."""

import math
import zlib
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace

from gigabrain_drivers.cameras.depth_noise import SENSOR, DepthErrors, DepthSensor
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.safety.depth import turn_of
from gigabrain_zenoh.testing.samples import BOOT, WAFFLE

CAMERA = Camera(name="front", depth=True, x=0.07, z=0.1)
SEEING: BodyDescription = replace(WAFFLE, cameras=(CAMERA,), body_height=0.15)
LOW = (0.6, 0.63, -0.015, 0.015, 0.0, 0.03)  # 3 cm in each direction, 0.6 m ahead

Box = tuple[float, float, float, float, float, float]  # x, y and z from and to [m]


@dataclass(kw_only=True)
class Scene:
    """Boxes on a floor at z = 0, in a room. At `edge` the floor steps down by `drop`."""

    boxes: tuple[Box, ...] = ()
    edge: float = math.inf  # [m], along x
    drop: float = 0.1  # [m]
    room: float = 4.0  # [m], distance of its walls

    def depth(self, camera: Camera, pose: Pose) -> Floats:
        """Return the true depth (height, width) [m] from a body at `pose`."""
        fx, fy, cx, cy = camera.pinhole
        right, down = np.meshgrid(
            (np.arange(camera.width) - cx) / fx, (np.arange(camera.height) - cy) / fy
        )
        rays = np.stack([np.ones_like(right), -right, -down], axis=-1) @ turn_of(camera).T
        cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
        turn = np.array(((cosine, -sine, 0.0), (sine, cosine, 0.0), (0.0, 0.0, 1.0)))
        eye = turn @ (camera.x, camera.y, camera.z) + (pose.x, pose.y, 0.0)
        rays = rays @ turn.T
        return self._cast(eye, rays)

    def _cast(self, eye: Floats, rays: Floats) -> Floats:
        with np.errstate(divide="ignore", invalid="ignore"):
            floor = np.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], np.inf)
            beyond = eye[0] + floor * rays[..., 0] > self.edge
            lower = (eye[2] + self.drop) / -rays[..., 2]
            nearest = np.where(beyond, lower, floor)
            for axis in (0, 1):
                wall = (np.sign(rays[..., axis]) * self.room - eye[axis]) / rays[..., axis]
                nearest = np.fmin(nearest, np.where(wall > 0, wall, np.inf))
            for box in self.boxes:
                low, high = np.array(box[::2]), np.array(box[1::2])
                one, other = (low - eye) / rays, (high - eye) / rays
                enter = np.minimum(one, other).max(axis=-1)
                leave = np.maximum(one, other).min(axis=-1)
                hit = (enter <= leave) & (enter > 0)
                nearest = np.where(hit, np.minimum(nearest, enter), nearest)
        return nearest


class Eye:
    """A depth camera in a scene, with the errors of a sensor. It fills the first plane only."""

    def __init__(
        self, camera: Camera = CAMERA, seed: int = 0, errors: DepthErrors = SENSOR
    ) -> None:
        fx, fy, cx, cy = (value / 2 for value in camera.pinhole)
        half = replace(
            camera,
            width=camera.width // 2,
            height=camera.height // 2,
            intrinsics=(fx, fy, cx, cy),
        )
        self._camera, self._sensor = camera, DepthSensor(half, seed, errors)

    def picture(self, scene: Scene, pose: Pose, tick: int = 1) -> DepthImage:
        """Return the picture from a body at `pose`."""
        pixels = self._sensor.measure(scene.depth(self._sensor.mounted, pose))
        plane = zlib.compress(pixels.astype("<u2").tobytes(), 1)
        return DepthImage(
            frame_id="front", height=self._camera.height, width=self._camera.width,
            planes=(plane, b"", b"", b""), boot=BOOT, tick=tick, basis=tick,
        )  # fmt: skip


def image(pixels: np.ndarray, tick: int = 1) -> DepthImage:
    """Return a message with `pixels` (height, width) [mm]."""
    height, width = pixels.shape
    return DepthImage(
        frame_id="front", height=height, width=width,
        planes=pack_depth(pixels.astype(np.uint16)), boot=BOOT, tick=tick, basis=tick,
    )  # fmt: skip
