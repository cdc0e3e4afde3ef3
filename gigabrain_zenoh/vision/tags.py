"""Finds AprilTags in a picture, and their poses in the body's frame.

A square in a picture has two possible poses that look similar (Collins and Bartoli, IPPE). Depth
decides between them, and measures distance and tilt better than corners. Without depth, ambiguous
tags are omitted.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.objects import Pixel, TagDetection
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.tag_corners import refined

FAMILIES = {
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
}
MIN_SIDE_PX = 12.0  # of the shortest side
FROM_LOWER_LEFT = (1, 0, 3, 2)  # OpenCV draws these families upside down, from the upper left
TURNED_RAD = 0.35  # least difference between two poses that count as different
MIN_ERROR_RATIO = 1.5  # of the second pose's error to the first's, without depth
INNER = 0.85  # share of a tag's sides where depth is used, because edges mix with the background
MIN_POINTS = 20  # with depth
MAX_TILT_ERROR = 0.06  # [rad], of a plane by depth
SAME_SIZE = (0.8, 1.25)  # range of size by depth / size in the settings
EDGE_ON = -0.05  # largest cosine of the angle between a ray and a face's normal
MAX_TAGS = 64
Grey = NDArray[np.uint8]
Depth = NDArray[np.uint16]


class TagFinder:
    """Finds the tags of one family. `size` is that of the black square [m]; `sizes`, by id."""

    def __init__(
        self, family: str = "36h11", size: float = 0.16, sizes: Mapping[int, float] | None = None
    ) -> None:
        self._size, self._sizes = size, dict(sizes or {})
        self.other_sizes: dict[int, float] = {}  # [m], by depth, if it differs from the settings
        found = cv2.aruco.DetectorParameters()
        found.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        found.minMarkerPerimeterRate = 0.03  # of the longer side of a picture
        dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
        self._detector = cv2.aruco.ArucoDetector(dictionary, found)

    def find(
        self, grey: Grey, model: CameraModel, depth: Depth | None = None
    ) -> tuple[TagDetection, ...]:
        """Return the tags in a picture (h, w) of the camera, with its depth [mm], if it has any."""
        quads, ids, _ = self._detector.detectMarkers(grey)
        if not len(quads):
            return ()
        found = {}
        for tag, quad in zip(map(int, np.ravel(ids)), quads, strict=True):
            corners = np.asarray(quad, np.float64).reshape(4, 2)[list(FROM_LOWER_LEFT)]
            if _shortest_side(corners) < MIN_SIDE_PX or tag in found:
                continue
            corners = refined(grey, corners)
            size = self._sizes.get(tag, self._size)
            plane = None if depth is None else _plane(corners, model, depth)
            if plane and plane.tilt_error <= MAX_TILT_ERROR:
                self._compare(tag, size, _measured(corners, model, plane))
            placed = place(corners, size, model, plane)
            if placed:
                found[tag] = _detection(tag, corners, size, placed)
        return tuple(found.values())[:MAX_TAGS]

    def _compare(self, tag: int, size: float, measured: float) -> None:
        """Record a tag whose size by depth differs from the settings."""
        if SAME_SIZE[0] < measured / size < SAME_SIZE[1]:
            self.other_sizes.pop(tag, None)
        elif math.isfinite(measured) and len(self.other_sizes) < MAX_TAGS:
            self.other_sizes[tag] = measured


class Placed(NamedTuple):
    """A tag's pose in the body's frame."""

    position: Floats  # [m], of its middle
    axes: Floats  # (3, 3), its axes as columns: out of its face, to its left, to its top


class Plane(NamedTuple):
    """A plane through a point, from the camera, in the body's axes."""

    point: Floats  # [m]
    normal: Floats  # towards the camera
    tilt_error: float  # [rad], of the normal


def place(corners: Floats, size: float, model: CameraModel, plane: Plane | None) -> Placed | None:
    """Return the pose of a tag from its corners [px], (4, 2), lower left first; None if ambiguous.

    `plane` is its plane by depth.
    """
    poses = _poses(corners, size, model)
    if not poses:
        return None
    if plane is not None and plane.tilt_error <= MAX_TILT_ERROR:
        by_depth = _on_plane(corners, model, plane, size)
        if by_depth is not None:
            return by_depth
    (best, error), *others = poses
    for other, other_error in others:
        turned = math.acos(np.clip(best.axes[:, 0] @ other.axes[:, 0], -1.0, 1.0))
        if turned > TURNED_RAD and other_error < MIN_ERROR_RATIO * error:
            return None
    return best if plane is None else _at_depth(best, model, plane)


def _at_depth(placed: Placed, model: CameraModel, plane: Plane) -> Placed:
    """Return a pose moved along its ray to the depth's plane; unchanged if that is far away."""
    ray, out = placed.position - model.origin, placed.axes[:, 0]
    farther = float(plane.point @ out / (ray @ out))
    if not SAME_SIZE[0] < farther < SAME_SIZE[1]:
        return placed
    return Placed(model.origin + farther * ray, placed.axes)


def _poses(corners: Floats, size: float, model: CameraModel) -> list[tuple[Placed, float]]:
    """Return the possible poses, best first, each with its error [px]."""
    half = size / 2
    square = np.array(((-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)))
    seen = corners[[3, 2, 1, 0]]  # from the upper left, clockwise
    matrix, distortion = _lens(model)
    count, turns, shifts, errors = cv2.solvePnPGeneric(
        square, seen, matrix, distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    found = []
    for turn, shift, error in zip(turns, shifts, np.ravel(errors)[:count], strict=True):
        right, up, out = cv2.Rodrigues(turn)[0].T
        if np.isfinite(shift).all() and shift[2, 0] > 0:
            axes = np.stack([_to_body(axis, model) for axis in (out, right, up)], axis=1)
            there = _to_body(np.asarray(shift, np.float64).ravel(), model)
            placed = Placed(model.origin + there, axes)
            found.append((placed, float(error)))
    return sorted(found, key=lambda one: one[1])


def _lens(model: CameraModel) -> tuple[Floats, Floats]:
    fx, fy, cx, cy = model.camera.pinhole
    matrix = np.array(((fx, 0, cx), (0, fy, cy), (0, 0, 1.0)))
    return matrix, np.array((*model.camera.distortion, *[0.0] * 8)[:8])


def _to_body(vector: Floats, model: CameraModel) -> Floats:
    """Turn a vector of OpenCV's frame of a camera (right, down, ahead) into the body's axes."""
    right, down, ahead = vector
    turned: Floats = model.rotation @ np.array((ahead, -right, -down))
    return turned


def _plane(corners: Floats, model: CameraModel, depth: Depth) -> Plane | None:
    """Return the plane of a tag by the depth inside it; None if too little is known."""
    middle = corners.mean(axis=0)
    inner = middle + INNER * (corners - middle)
    mask = np.zeros(depth.shape, np.uint8)
    cv2.fillConvexPoly(mask, np.rint(inner).astype(np.int32), 1)
    rows, columns = np.nonzero(mask.astype(bool) & (depth > 0))
    points = (model.rays[:, rows, columns] * (depth[rows, columns] * 1e-3)).T.astype(np.float64)
    points = points[np.isfinite(points).all(axis=1)]
    for _ in range(2):
        if len(points) < MIN_POINTS:
            return None
        point = points.mean(axis=0)
        _, spread, axes = np.linalg.svd(points - point, full_matrices=False)
        off = np.abs((points - point) @ axes[2])
        near = off <= 3 * max(float(np.median(off)), 1e-4)
        if near.all():
            break
        points = points[near]
    tilt_error = 2 * spread[2] / max(spread[1], 1e-9) / math.sqrt(len(points))
    normal = axes[2] if axes[2] @ point < 0 else -axes[2]
    return Plane(point, normal, float(tilt_error))


def _on_plane(corners: Floats, model: CameraModel, plane: Plane, size: float) -> Placed | None:
    """Return the pose of a tag whose corners are on a plane; None if they are not its size."""
    if not SAME_SIZE[0] < _measured(corners, model, plane) / size < SAME_SIZE[1]:
        return None
    lower_left, lower_right, upper_right, upper_left = placed = _cast(corners, model, plane)
    up = (upper_left - lower_left) + (upper_right - lower_right)
    up -= (up @ plane.normal) * plane.normal
    up /= np.linalg.norm(up)
    axes = np.stack((plane.normal, np.cross(up, plane.normal), up), axis=1)
    return Placed(model.origin + placed.mean(axis=0), axes)


def _measured(corners: Floats, model: CameraModel, plane: Plane) -> float:
    """Return the mean side of a tag on a plane [m]; NaN if it is seen edge-on."""
    placed = _cast(corners, model, plane)
    return float(np.linalg.norm(placed - np.roll(placed, 1, axis=0), axis=1).mean())


def _cast(corners: Floats, model: CameraModel, plane: Plane) -> Floats:
    """Intersect rays through pixels (n, 2) with a plane; from the camera, in the body's axes."""
    straight = cv2.undistortPoints(corners.reshape(-1, 1, 2), *_lens(model)).reshape(4, 2)
    rays = np.stack([_to_body(np.array((x, y, 1.0)), model) for x, y in straight])
    slant = rays @ plane.normal
    slant[slant > EDGE_ON] = np.nan  # seen from its edge, or from behind
    return np.asarray(rays * (plane.point @ plane.normal / slant)[:, None], np.float64)


def _shortest_side(corners: Floats) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).min())


def _detection(tag: int, corners: Floats, size: float, placed: Placed) -> TagDetection:
    lower_left, lower_right, upper_right, upper_left = corners.tolist()
    pixels: tuple[Pixel, Pixel, Pixel, Pixel] = (
        tuple(lower_left), tuple(lower_right), tuple(upper_right), tuple(upper_left),
    )  # fmt: skip
    x, y, z = placed.position.tolist()
    return TagDetection(
        id=tag,
        corners=pixels,
        size=size,
        position=(x, y, z),
        orientation=quaternion(placed.axes),
    )


def quaternion(axes: Floats) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a rotation matrix (3, 3)."""
    symmetric = np.array((
        (axes[0, 0] - axes[1, 1] - axes[2, 2], 0, 0, 0),
        (axes[1, 0] + axes[0, 1], axes[1, 1] - axes[0, 0] - axes[2, 2], 0, 0),
        (axes[2, 0] + axes[0, 2], axes[2, 1] + axes[1, 2], axes[2, 2] - axes[0, 0] - axes[1, 1], 0),
        (
            axes[2, 1] - axes[1, 2], axes[0, 2] - axes[2, 0], axes[1, 0] - axes[0, 1],
            axes[0, 0] + axes[1, 1] + axes[2, 2],
        ),
    )) / 3.0  # fmt: skip
    _, vectors = np.linalg.eigh(symmetric)  # by its lower half (Bar-Itzhack 2000)
    x, y, z, w = (vectors[:, -1] * (1.0 if vectors[3, -1] >= 0 else -1.0)).tolist()
    return x, y, z, w


def yaw_of(orientation: tuple[float, float, float, float]) -> float:
    """Return the yaw of the x axis of a quaternion x, y, z, w [rad]."""
    x, y, z, w = orientation
    return math.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def cells(tag: int, family: str = "36h11") -> NDArray[np.bool_]:
    """Return a mask of a tag's white cells (n, n), including its black border, top first.

    Raises ValueError for a tag that its family does not have.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[family])
    if not 0 <= tag < len(dictionary.bytesList):
        raise ValueError(f"no tag {tag} in {family}; expected 0 to {len(dictionary.bytesList) - 1}")
    side = dictionary.markerSize + 2
    drawn = cv2.aruco.generateImageMarker(dictionary, tag, side, borderBits=1)
    upright: NDArray[np.bool_] = np.rot90(drawn, 2) > 127
    return upright
