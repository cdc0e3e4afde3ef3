"""Rays and pixels of distorted cameras, with OpenCV's own projection as the judge."""

import cv2
import numpy as np
import pytest

from gigabrain_schemas.body import Camera
from gigabrain_zenoh.safety.depth import seen_through, view_of
from gigabrain_zenoh.vision.camera_model import CameraModel
from tests.unit.vision.scenes import body

PLUMB_BOB = (-0.055, 0.065, 0.001, -0.001, -0.02)
RATIONAL = (0.49, -2.66, 0.0006, -0.0002, 1.56, 0.37, -2.48, 1.48)  # of an Azure Kinect
SHORT = (0.1, -0.2, 0.0, 0.0, 0.05, 0.02)  # the other two are 0
LENSES = pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL, SHORT])


def lens(distortion: tuple[float, ...]) -> Camera:
    pinhole = (303.0, 303.5, 160.0, 119.0)
    return Camera(name="front", depth=True, z=0.3, intrinsics=pinhole, distortion=distortion)


def projected(camera: Camera, rays: np.ndarray) -> np.ndarray:
    """Return the pixels (n, 2) at which OpenCV sees rays (n, 3) of a level camera."""
    fx, fy, cx, cy = camera.pinhole
    matrix = np.array(((fx, 0, cx), (0, fy, cy), (0, 0, 1.0)))
    given = np.zeros(8)
    given[: len(camera.distortion)] = camera.distortion
    ahead = np.column_stack((-rays[:, 1], -rays[:, 2], rays[:, 0])).astype(np.float64)
    return cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), matrix, given)[0].reshape(-1, 2)


@LENSES
def test_rays_come_back_to_their_pixels_through_the_whole_lens(
    distortion: tuple[float, ...],
) -> None:
    camera = lens(distortion)
    model = CameraModel(camera)
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    pixels = np.column_stack((u.ravel(), v.ravel()))
    rays = model.rays.reshape(3, -1).T
    assert np.abs(projected(camera, rays) - pixels).max() < 0.1
    row, column, _ = model.project(model.origin + 2.0 * rays.astype(np.float64))
    inner = (row >= 0) & (column >= 0)
    assert inner.mean() > 0.98  # those on the rim may be rounded out of the picture
    assert np.abs(np.column_stack((column, row)) - pixels)[inner].max() <= 1


@LENSES
def test_safety_sees_through_the_same_lens(distortion: tuple[float, ...]) -> None:
    camera = lens(distortion)
    view = view_of(body(camera), camera)
    assert view.known == 1.0
    u, v = np.meshgrid(np.arange(0, 320, 2), np.arange(0, 240, 2))
    rays = view.rays.reshape(-1, 3)
    assert np.abs(projected(camera, rays) - np.column_stack((u.ravel(), v.ravel()))).max() < 0.5
    pixels = np.full((120, 160), 1000, np.uint16)
    pixels[60, 150] = 4000  # one pixel sees past what stands 2 m away
    there = view.mount + 2.0 * view.rays.astype(np.float64)[[60, 60], [150, 140]]
    gone = seen_through(camera, view, pixels, there, np.zeros(2, bool))
    assert gone.tolist() == [True, False]
