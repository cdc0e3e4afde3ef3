"""Finds things on the floor, or on the table of an arm, in a depth picture.

It omits things that are cut off by an edge of the picture, hidden by nearer things, too near for
the camera, or touched by the robot's own arm: a fit to a part of a thing would be wrong.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.depth_picture import DepthView
from gigabrain_zenoh.vision.outlines import connected
from gigabrain_zenoh.vision.solid_fit import MIN_POINTS, SolidFit, fit_solid

REACH_M = 1.2  # from the camera
MAX_WIDTH_M = 0.35  # larger things are furniture
LINK_M = 0.006  # least gap between two things
NEARER_M = 0.02  # points this much nearer than a thing may hide a part of it
RING_PX, MAX_HIDDEN = 2, 0.08  # width of a ring round a thing, and its share that may be nearer
EDGE_PX = 2  # margin at the edges of a picture
BLIND_M = 0.01  # margin beyond the camera's least depth, where parts may be invisible
TOUCH_M = 0.01  # an arm this near to a thing hides a part of it, or holds it
THROUGH_M = 0.01  # points this far behind a thing show that it is gone
Mask = NDArray[np.bool_]


def find_solids(view: DepthView, model: CameraModel, own: Mask) -> list[SolidFit]:
    """Return the things in a picture, in the body's frame.

    `own` (n,) marks the points of `view.obstacles` on the body's own arm.
    """
    floor, eye = view.floor.coefficients, model.origin
    raw = view.obstacles.astype(np.float64)
    height = raw[:, 2].copy()
    raw[:, 2] += floor[0] + raw[:, :2] @ floor[1:]
    near = np.hypot(*(raw[:, :2] - eye[:2]).T) < REACH_M
    mine, raw, height = raw[own], raw[near & ~own], height[near & ~own]
    level = (raw - eye) @ _levelling(floor).T + eye
    level[:, 2] = height
    over = np.array([eye[0], eye[1], eye[2] - floor[0] - eye[:2] @ floor[1:]])
    rows, columns, depth = model.project(raw)
    pixels = np.stack((rows, columns), axis=1)
    spacing = 1.0 / model.camera.pinhole[0]  # [m] at a depth of 1 m
    found = []
    for group in _groups(level[:, :2]):
        far = float(depth[group].mean())
        blind = bool(depth[group].min() < model.camera.depth_min + BLIND_M)
        if blind or _is_cut(view, pixels[group], far) or _near(raw[group], mine):
            continue
        if fit := fit_solid(level[group], over, far * spacing):
            found.append(fit)
    return found


def is_gone(view: DepthView, model: CameraModel, place: Floats) -> bool:
    """Return whether the picture sees through a place (3,) in the body's frame [m]."""
    rows, columns, depth = model.project(place[None])
    row, column = int(rows[0]), int(columns[0])
    height, width = view.depth.shape
    if not (EDGE_PX <= row < height - EDGE_PX and EDGE_PX <= column < width - EDGE_PX):
        return False
    seen = view.depth[row - 1 : row + 2, column - 1 : column + 2]
    return bool((seen > depth[0] + THROUGH_M).all())


def _levelling(floor: Floats) -> Floats:
    """Return the rotation (3, 3) that makes a floor level: a tilt of the camera shifts things."""
    normal = np.array([-floor[1], -floor[2], 1.0])
    normal /= np.linalg.norm(normal)
    x, y = normal[1], -normal[0]  # normal x up
    cross = np.array([[0.0, 0.0, y], [0.0, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1.0 + normal[2]))


def _groups(flat: Floats) -> Iterator[NDArray[np.intp]]:
    """Yield the indices of the points (n, 2) of each group that may be a thing."""
    labels = connected(flat, LINK_M)
    order = np.argsort(labels, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(labels[order])) + 1):
        if len(group) >= MIN_POINTS and float(np.ptp(flat[group], axis=0).max()) < MAX_WIDTH_M:
            yield group


def _is_cut(view: DepthView, pixels: NDArray[np.intp], far: float) -> bool:
    """Return whether a thing of these pixels (n, 2) is partly outside the picture, or hidden."""
    height, width = view.depth.shape
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    inside = (low >= EDGE_PX).all() and (high < np.array((height, width)) - EDGE_PX).all()
    if not inside:
        return True
    mask = np.zeros((height, width), np.uint8)
    mask[pixels[:, 0], pixels[:, 1]] = 1
    kernel = np.ones((2 * RING_PX + 1,) * 2, np.uint8)
    ring = (cv2.dilate(mask, kernel) > 0) & (mask == 0)
    around = view.depth[ring]
    hiding = (around > 0) & (around < far - NEARER_M)
    return bool(hiding.mean() > MAX_HIDDEN)


def _near(points: Floats, others: Floats) -> bool:
    """Return whether any of the points (n, 3) is near one of the others (m, 3)."""
    if not len(others):
        return False
    low, high = points.min(axis=0) - TOUCH_M, points.max(axis=0) + TOUCH_M
    return bool(((others > low) & (others < high)).all(axis=1).any())
