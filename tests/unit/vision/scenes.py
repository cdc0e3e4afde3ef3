"""Scenes of boxes on a floor with pits, and the exact depth of each of their pixels."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_schemas.brain import Contour
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.geometry.polygon import contains, distance
from gigabrain_zenoh.vision.camera_model import rotation
from gigabrain_zenoh.vision.obstacle_contours import ObstacleContours

LOW = Camera(name="front", depth=True, x=0.07, z=0.107)
HIGH = Camera(name="front", depth=True, x=0.1, z=0.5, pitch=math.radians(25.0))
START = Pose(x=0.0, y=0.0, yaw=0.0)
FAR_M = 1000.0


@dataclass(frozen=True)
class Box:
    """A box with upright sides along x and y [m]; `bottom` above the floor."""

    x: float
    y: float
    half_x: float
    half_y: float
    top: float
    bottom: float = 0.0


def body(camera: Camera, height: float = 0.2) -> BodyDescription:
    return BodyDescription(
        robot_type="tester",
        drive_type="differential",
        footprint=((-0.2, -0.15), (0.06, -0.15), (0.06, 0.15), (-0.2, 0.15)),
        max_linear_speed=0.3,
        max_angular_speed=1.8,
        body_height=height,
        cameras=(camera,),
    )


def depth_of(
    camera: Camera,
    boxes: tuple[Box, ...] = (),
    pits: tuple[Box, ...] = (),
    pose: Pose = START,
    floor: bool = True,
) -> NDArray[np.float64]:
    """Return the depth of each pixel [m]. `pits` are as deep as their `bottom` says."""
    fx, fy, cx, cy = camera.pinhole
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack((np.ones(u.shape), -(u - cx) / fx, -(v - cy) / fy), axis=-1)
    turn = rotation(0, 0, pose.yaw)
    rays = rays @ (turn @ rotation(camera.roll, camera.pitch, camera.yaw)).T
    origin = turn @ (camera.x, camera.y, camera.z) + (pose.x, pose.y, 0.0)
    depth = np.full(u.shape, FAR_M)
    with np.errstate(divide="ignore", invalid="ignore"):
        if floor:
            at = np.where(rays[..., 2] < 0, -origin[2] / rays[..., 2], FAR_M)
            for pit in pits:
                x, y = (origin[axis] + at * rays[..., axis] for axis in (0, 1))
                within = (abs(x - pit.x) < pit.half_x) & (abs(y - pit.y) < pit.half_y)
                deeper = (pit.bottom - origin[2]) / rays[..., 2]
                side = _enter(rays, origin, pit, leaving=True)
                at = np.where(within, np.minimum(deeper, side), at)
            depth = np.minimum(depth, at)
        for box in boxes:
            depth = np.minimum(depth, _enter(rays, origin, box))
    return depth


def _enter(
    rays: NDArray[np.float64], origin: NDArray[np.float64], box: Box, *, leaving: bool = False
) -> NDArray[np.float64]:
    low = np.array((box.x - box.half_x, box.y - box.half_y, box.bottom))
    high = np.array((box.x + box.half_x, box.y + box.half_y, box.top))
    one, other = (low - origin) / rays, (high - origin) / rays
    begin, end = np.minimum(one, other).max(axis=-1), np.maximum(one, other).min(axis=-1)
    hit = (begin <= end) & (begin > 0)
    return np.where(hit, end if leaving else begin, FAR_M)


def millimetres(camera: Camera, depth: NDArray[np.float64]) -> NDArray[np.uint16]:
    """Return what a camera without errors measures."""
    known = (depth >= camera.depth_min) & (depth <= camera.depth_max)
    return np.rint(np.where(known, depth, 0) * 1000).astype(np.uint16)


def image(pixels: NDArray[np.uint16]) -> DepthImage:
    height, width = pixels.shape
    return DepthImage(frame_id="front", height=height, width=width, planes=pack_depth(pixels))


def feed(
    eyes: ObstacleContours,
    camera: Camera,
    *boxes: Box,
    pits: tuple[Box, ...] = (),
    pose: Pose = START,
    begin: float = 0.0,
    pictures: int = 3,
) -> tuple[Contour, ...]:
    """Show a scene for some pictures at 10 Hz, and return the contours after the last one."""
    picture = image(millimetres(camera, depth_of(camera, boxes, pits, pose)))
    for number in range(pictures):
        assert eyes.add_depth(camera.name, picture, pose, begin + number / 10) == ""
    return eyes.contours(pose, begin + (pictures - 1) / 10)


def near(contours: tuple[Contour, ...], x: float, y: float, within: float = 0.05) -> list[Contour]:
    """Return the contours that are nearer to a point than `within` [m]."""
    point = np.array([[x, y]])
    return [one for one in contours if distance(np.array(one.polygon), point)[0] <= within]


def covers(contour: Contour, x: float, y: float) -> bool:
    """Return whether a contour covers a point."""
    return bool(contains(np.array(contour.polygon), np.array([[x, y]]))[0])
