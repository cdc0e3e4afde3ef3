"""Pictures of AprilTags at known poses: warped from the plane of the tag, with depth."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_schemas.body import Camera
from gigabrain_zenoh.vision.camera_model import CameraModel, rotation
from gigabrain_zenoh.vision.tags import cells

CELL_PX = 24  # of the tag that is warped
FINER = 3  # a picture is drawn as many times larger, and made smaller
CAMERA = Camera(name="front", width=320, height=240, depth=True, x=0.06, z=0.1)


class Plate(NamedTuple):
    """A tag on a white plate, one cell wider than its black square all round."""

    tag: int
    size: float  # [m], of its black square
    position: NDArray[np.float64]  # [m], of its middle, in the body's frame
    axes: NDArray[np.float64]  # (3, 3): out of its face, to its left, to its top, as columns


def judge() -> Any:
    """Return the detector of pupil-apriltags, which works out corners by other code than ours."""
    module = pytest.importorskip("pupil_apriltags", reason="no wheel here")
    detector = module.Detector("tag36h11", quad_decimate=1.0)
    # it would free the families before the detector, which still writes to them
    detector.tag_families.clear()
    return detector


def facing(
    tag: int, size: float, place: tuple[float, float, float], yaw: float, pitch: float, roll: float
) -> Plate:
    """Return a plate that faces the body, then turned."""
    towards = rotation(0.0, 0.0, np.pi)
    return Plate(tag, size, np.array(place), towards @ rotation(roll, pitch, yaw))


def draw(plate: Plate, model: CameraModel, rng: np.random.Generator, noise: float = 4.0):
    """Return a grey picture (h, w), and the depth [mm] of the plate and of a wall behind it."""
    camera = model.camera
    drawn = np.pad(cells(plate.tag), 1, constant_values=True).astype(np.uint8) * 190 + 30
    side = len(drawn)
    large = cv2.resize(drawn, None, fx=CELL_PX, fy=CELL_PX, interpolation=cv2.INTER_NEAREST)
    cell = plate.size / (side - 2)
    half = side * cell / 2
    corners = [(-half, half), (half, half), (half, -half), (-half, -half)]  # its left and up
    points = [plate.position + plate.axes @ np.array((0, left, up)) for left, up in corners]
    there = project(model, np.array(points))
    scale = (there + 0.5) * FINER - 0.5
    edge = side * CELL_PX - 0.5
    here = np.array(((-0.5, -0.5), (edge, -0.5), (edge, edge), (-0.5, edge)))
    shape = FINER * camera.width, FINER * camera.height
    homography = cv2.getPerspectiveTransform(here.astype(np.float32), scale.astype(np.float32))
    picture = np.full(shape[::-1], 120, np.uint8)
    cv2.warpPerspective(
        large, homography, shape, dst=picture, flags=cv2.INTER_AREA,
        borderMode=cv2.BORDER_TRANSPARENT,
    )  # fmt: skip
    small = cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    noisy = np.clip(small + rng.normal(0, noise, small.shape), 0, 255).astype(np.uint8)
    return noisy, depth_of(plate, model, rng, half)


def project(model: CameraModel, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pixels (n, 2) of points in the body's frame, by OpenCV's own projection."""
    fx, fy, cx, cy = model.camera.pinhole
    ahead, left, up = model.rotation.T @ (points - model.origin).T
    in_camera = np.stack((-left, -up, ahead), axis=1)
    matrix = np.array(((fx, 0, cx), (0, fy, cy), (0, 0, 1.0)))
    lens = np.array((*model.camera.distortion, *[0.0] * 8)[:8])
    return cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), matrix, lens)[0].reshape(-1, 2)


def depth_of(plate: Plate, model: CameraModel, rng: np.random.Generator, half: float):
    """Return a depth picture [mm] with a sensor's noise and holes."""
    rays = model.rays.reshape(3, -1).astype(float)
    out = plate.axes[:, 0]
    with np.errstate(all="ignore"):
        depth = (plate.position - model.origin) @ out / (out @ rays)
    on = (rays * depth).T + model.origin - plate.position
    outside = (np.abs(on @ plate.axes[:, 1]) > half) | (np.abs(on @ plate.axes[:, 2]) > half)
    depth[outside | ~(depth > 0)] = plate.position[0] + 1.0
    depth += rng.normal(0, 1, depth.shape) * 0.0015 * depth**2
    depth[rng.random(depth.shape) < 0.02] = 0
    return np.clip(depth * 1000, 0, 65535).astype(np.uint16).reshape(model.rays.shape[1:])
