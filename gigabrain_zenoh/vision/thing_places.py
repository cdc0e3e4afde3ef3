"""Computes a thing's place and size from the depth inside its box in a picture.

A camera measures the nearest face of a thing. Its middle is half its thickness farther. The
thickness is estimated from the width: round things are as thick as wide.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.objects import Box, Extent, Point
from gigabrain_zenoh.vision.camera_model import CameraModel

# the middle's distance behind the median of what is seen of the inner part, of the width
BEHIND = {
    "ball": 0.43,
    "box": 0.38,
    "can": 0.47,
    "charger": 0.3,
    "cube": 0.42,
    "cylinder": 0.47,
    "door": 0.05,
    "person": 0.4,
    "robot": 0.42,
}
ROUND = {"ball"}
# [m], least and most width; others are something else: a can that looks like a small robot, a wall
WIDTHS_M = {
    "ball": (0.0, 0.6),
    "box": (0.0, 1.2),
    "can": (0.0, 0.3),
    "charger": (0.12, 1.0),
    "cube": (0.0, 0.8),
    "cylinder": (0.0, 0.8),
    "door": (0.4, 2.5),
    "person": (0.12, 1.5),
    "robot": (0.1, 1.2),
}
OTHERS_BEHIND, MAX_BEHIND_M = 0.35, 0.35  # of other things, and of all
INNER = (0.2, 0.15, 0.8, 0.75)  # left, top, right, bottom of the evaluated part of a box
MIN_PIXELS, MIN_SHARE = 8, 0.15  # with depth, in that part
LAYER_SHARE = 0.3  # least share of depths in a layer; nearer ones are edges of other things
THIN_M, THICKNESS = 0.06, 0.7  # largest thickness of a layer: at least, and relative to the width
EDGE_PX = 2.0  # a box this near to an edge may continue beyond it
# what stands free; others, as doors and pictures, may be in a wall or on it
STANDING = {"ball", "box", "can", "charger", "cube", "cylinder", "person", "robot"}
STRIP = (0.1, 0.4)  # its start and end outside a box's side, relative to the box's width
NARROW_M = 0.15  # narrower things protrude too little from a wall
FLAT_M, BENT_M = 0.02, 0.05  # distance from a plane: mean inside a box, and beside it


class ThingPlace(NamedTuple):
    """The position and size of a thing, in the body's frame."""

    position: Point  # [m], of its middle
    size: Extent | None  # [m], width and height; None if it is partly outside the picture


def thing_place(
    label: str, box: Box, model: CameraModel, depth: NDArray[np.uint16]
) -> ThingPlace | None:
    """Return the place of the thing in a box [px], by depth [mm]; None if that is insufficient.

    A thing that is cut off at a side of the picture has an unknown middle.
    """
    left, top, right, bottom = box
    height, width = depth.shape
    if left < EDGE_PX or right > width - EDGE_PX:
        return None
    fx, fy, _, _ = model.camera.pinhole
    wide, high = (right - left) / fx, (bottom - top) / fy  # [m] at a depth of 1 m
    front = _front(_inside(box, depth), wide)
    if front is None:
        return None
    behind = BEHIND.get(label, OTHERS_BEHIND)
    farther = min(front * behind * wide / (1 - behind * min(wide, 1.0)), MAX_BEHIND_M)
    middle = front + farther
    row = round(min(max((top + bottom) / 2, 0), height - 1))
    ray = model.rays[:, row, round((left + right) / 2)].astype(np.float64)
    x, y, z = (model.origin + middle * ray).tolist()
    if not np.isfinite((x, y, z)).all():
        return None
    whole = top >= EDGE_PX and bottom <= height - EDGE_PX
    tall = high * (middle if label in ROUND else front)  # the upper edge of others is in front
    return ThingPlace((x, y, z), (wide * middle, tall) if whole else None)


def fits(label: str, place: ThingPlace) -> bool:
    """Return whether a thing of class `label` may have the width of `place`."""
    least, most = WIDTHS_M.get(label, (0.0, math.inf))
    return place.size is None or least <= place.size[0] <= most


def part_of_wall(label: str, box: Box, model: CameraModel, depth: NDArray[np.uint16]) -> bool:
    """Return whether the surface in a box continues on both sides, as a wall between pillars.

    It may also be a floor. A side at the edge of the picture, or with unknown depth beside it,
    gives no evidence.
    """
    left, _, right, _ = np.clip(box, 0, (*depth.shape[::-1],) * 2)
    wide, fx = right - left, model.camera.pinhole[0]
    if label not in STANDING:
        return False
    near, far = STRIP[0] * wide, STRIP[1] * wide
    profile = _profile(box, depth)
    inner = profile[math.floor(left) : math.ceil(right)]
    known = inner[np.isfinite(inner)]
    if len(known) < MIN_PIXELS or wide / fx < NARROW_M * np.median(known):
        return False
    goes_on = [
        _goes_on(profile, (left + near, left + far), (left - far, left - near)),
        _goes_on(profile, (right - far, right - near), (right + near, right + far)),
    ]
    answers = [one for one in goes_on if one is not None]
    return bool(answers) and all(answers)


def _profile(box: Box, depth: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return the inverse of the median depth [1/m] in each column, nan where it is unknown.

    Along a row of pixels, that of a plane is a straight line.
    """
    _, top, _, bottom = box
    high = bottom - top
    inner = slice(max(0, round(top + INNER[1] * high)), max(0, round(top + INNER[3] * high)) + 1)
    columns = np.sort(depth[inner].T.copy())  # unknown ones first
    known = np.count_nonzero(columns, axis=1)
    enough = known * 2 > columns.shape[1]
    profile = np.full(len(columns), np.nan)
    median = columns[np.arange(len(columns)), columns.shape[1] - 1 - known // 2]
    profile[enough] = 1e3 / median[enough]
    return profile


def _goes_on(
    profile: NDArray[np.float64], inside: tuple[float, float], beside: tuple[float, float]
) -> bool | None:
    """Return whether columns `inside` are a plane that may continue `beside`; None if unknown.

    It may if the depth there is no farther: the plane itself, or something before it.
    """
    columns = np.arange(len(profile))
    known = np.isfinite(profile)
    within = columns[known & (columns >= inside[0]) & (columns < inside[1])]
    beyond = columns[known & (columns >= beside[0]) & (columns < beside[1])]
    if len(within) < MIN_PIXELS // 2 or not len(beyond):
        return None
    slope, offset = np.polyfit(within, profile[within], 1)
    farther = (slope * columns + offset - profile) / profile**2  # [m], to first order
    flat = np.abs(farther[within]).mean() < FLAT_M
    return bool(flat and np.median(farther[beyond]) < BENT_M)


def _inside(box: Box, depth: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return the depths of the inner part of a box [m], ascending; 0 is unknown."""
    left, top, right, bottom = box
    wide, high = right - left, bottom - top
    columns = slice(max(0, round(left + INNER[0] * wide)), round(left + INNER[2] * wide) + 1)
    rows = slice(max(0, round(top + INNER[1] * high)), round(top + INNER[3] * high) + 1)
    return np.sort(depth[rows, columns].ravel()).astype(np.float64) * 1e-3


def _front(depths: NDArray[np.float64], wide: float) -> float | None:
    """Return the median depth of the nearest layer that is not only an edge [m]."""
    known = depths[depths > 0]
    needed = max(MIN_PIXELS, MIN_SHARE * len(depths))
    if len(known) < needed:
        return None
    far = known + np.maximum(THIN_M, THICKNESS * wide * known)
    within = np.searchsorted(known, far, side="right") - np.arange(len(known))
    begins = np.flatnonzero(within >= max(MIN_PIXELS, LAYER_SHARE * len(known)))
    if not len(begins):
        return None
    first = int(begins[0])
    front = float(np.median(known[first : first + within[first]]))
    half = max(THIN_M, THICKNESS * wide * front) / 2
    return float(np.median(known[np.abs(known - front) <= half]))
