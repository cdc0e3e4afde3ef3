"""Fits a box, an upright cylinder or a sphere to the points of a thing that stands on a floor.

Hidden parts are assumed to be like visible ones: a thing with only its front visible is as thick as
wide. The sides of boxes minimise the points' distances to them: X. Zhang et al., "Efficient L-Shape
Fitting for Vehicle Detection Using Laser Scanners", IV 2017.
"""

import math
from typing import Literal, NamedTuple

import cv2
import numpy as np

from gigabrain_schemas.arrays import Floats

ShapeName = Literal["box", "cylinder", "sphere"]
MIN_POINTS = 12
FROM_ABOVE = math.tan(math.radians(20))  # least slope of sight that shows a whole top
TOP_SHARE = 0.97  # quantile of the heights that is the top
LID_M = 0.004  # points this near to the top belong to its rim
STEP_M = 0.0015  # between points along an outline
ANGLES = np.radians(np.arange(0.0, 90.0, 2.0))
FINE_RAD = np.radians(np.arange(-2.0, 2.1, 0.25))
CLOSE_M = 0.001  # smaller distances to a side count as this
FLAT_M = 0.008  # largest visible depth of a box with one visible side
MIN_ARC = 1.2  # least visible arc of a round thing, relative to its radius
MAX_RADIUS_M = 0.2
ROUNDS = 8  # of Gauss-Newton
UNDECIDED = 0.9  # a thing is round if a circle fits better than sides by this factor
RESTS = 0.35  # largest height error of a ball's middle, relative to its radius


class SolidFit(NamedTuple):
    """A fitted thing, in the frame of its points."""

    shape: ShapeName
    size: tuple[float, ...]  # [m]: box: x, y, z; cylinder: radius, height; sphere: radius
    position: tuple[float, float, float]  # [m], of its middle; z from the floor
    yaw: float  # [rad] of a box, from -45 to 45 degrees
    error: float  # [m], mean distance of the points that count from its outline


class _Outline(NamedTuple):
    """A circle or a rectangle, seen from above."""

    x: float
    y: float
    yaw: float
    size: tuple[float, ...]  # [m], the radius, or both lengths
    error: float  # [m]


def fit_solid(points: Floats, eye: Floats, spacing: float) -> SolidFit | None:
    """Return the best fitting solid, or None if there are too few points or no solid fits.

    Args:
        points: (n, 3) x, y and height above the floor [m].
        eye: (3,) of the camera, in the same frame.
        spacing: Distance of neighbouring points across the line of sight [m].
    """
    if len(points) < MIN_POINTS:
        return None
    top = float(np.quantile(points[:, 2], TOP_SHARE))
    flat = points[:, :2]
    away = float(np.hypot(*(flat.mean(axis=0) - eye[:2])))
    whole = eye[2] - top > FROM_ABOVE * away  # the rim of its top is seen all round
    widest = _circle(_rim(flat), whole=True, spacing=spacing) if whole else None
    if widest and (ball := _ball(points, widest, top)):
        return ball
    lid = points[:, 2] > top - LID_M  # pixels at the edge of a top see a bit of the floor
    outline = _rim(flat[lid]) if whole else _front(flat, eye[:2], spacing)
    if len(outline) < 4:
        return None
    box = _rectangle(outline, eye[:2], spacing / 2 if whole else spacing)
    circle = _circle(outline, whole=whole, spacing=spacing)
    if circle is None or circle.error > UNDECIDED * box.error:
        return SolidFit("box", (*box.size, top), (box.x, box.y, top / 2), box.yaw, box.error)
    if not whole and (ball := _ball(points, circle, top)):
        return ball
    lengths = (*circle.size, top)
    return SolidFit("cylinder", lengths, (circle.x, circle.y, top / 2), 0.0, circle.error)


def _ball(points: Floats, circle: _Outline, top: float) -> SolidFit | None:
    """Return the sphere round a circle, if points (n, 3) are nearer to it than to a cylinder."""
    (radius,) = circle.size
    if abs(top - 2 * radius) > RESTS * radius:
        return None
    beside = np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y)
    below = np.abs(points[:, 2] - top)
    off_cylinder = float(np.minimum(np.abs(beside - radius), below).mean())
    off = float(np.abs(np.hypot(beside, points[:, 2] - top + radius) - radius).mean())
    if off > off_cylinder:
        return None
    radius = (radius + top / 2) / 2  # both are measured
    return SolidFit("sphere", (radius,), (circle.x, circle.y, radius), 0.0, off)


def _rim(flat: Floats) -> Floats:
    """Return points (m, 2) along the convex hull of points (n, 2)."""
    corners = cv2.convexHull(flat.astype(np.float32))[:, 0].astype(np.float64)
    ends = np.roll(corners, -1, axis=0)
    found = []
    for begin, end in zip(corners, ends, strict=True):
        count = max(1, round(float(np.hypot(*(end - begin))) / STEP_M))
        found.append(begin + (end - begin) * (np.arange(count) / count)[:, None])
    return np.concatenate(found)


def _front(flat: Floats, eye: Floats, spacing: float) -> Floats:
    """Return the nearest of the points (n, 2) in each direction from the eye (2,)."""
    off = flat - eye
    away = np.hypot(*off.T)
    mean = off.mean(axis=0)
    bearing = np.arctan2(
        mean[0] * off[:, 1] - mean[1] * off[:, 0], off @ mean
    )  # from the middle of them
    part = np.floor(bearing * away.mean() / max(spacing, 1e-4)).astype(np.intp)
    order = np.lexsort((away, part))
    first = order[np.flatnonzero(np.diff(part[order], prepend=part.min() - 1))]
    return np.asarray(flat[first])


def _rectangle(outline: Floats, eye: Floats, spacing: float) -> _Outline:
    """Return the rectangle whose sides the points (m, 2) are nearest to."""
    coarse = min(ANGLES, key=lambda angle: _off_sides(outline, float(angle)))
    best = float(coarse + min(FINE_RAD, key=lambda off: _off_sides(outline, float(coarse + off))))
    turned = outline @ _axes(best)
    low, high = turned.min(axis=0), turned.max(axis=0)
    lengths = high - low + spacing
    middle = (low + high) / 2
    thin = int(np.argmin(lengths))
    if lengths[thin] < max(FLAT_M, 2 * spacing):  # one side alone is seen: it goes on behind it
        towards = math.copysign(1.0, float((eye @ _axes(best))[thin] - middle[thin]))
        middle[thin] += towards * (lengths[thin] - spacing - lengths[1 - thin]) / 2
        lengths[thin] = lengths[1 - thin]
    x, y = (_axes(best) @ middle).tolist()
    wide, deep = lengths.tolist()
    yaw = best
    if yaw > math.pi / 4:  # the same, by its other side
        yaw, wide, deep = yaw - math.pi / 2, deep, wide
    return _Outline(x, y, yaw, (wide, deep), _off_sides(outline, best))


def _axes(angle: float) -> Floats:
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def _off_sides(outline: Floats, angle: float) -> float:
    """Return the mean distance of points (m, 2) from the nearest side of a rectangle's [m]."""
    turned = outline @ _axes(angle)
    near = np.minimum(turned - turned.min(axis=0), turned.max(axis=0) - turned).min(axis=1)
    return float(np.maximum(near, 0.0).mean())


def _circle(outline: Floats, *, whole: bool, spacing: float) -> _Outline | None:
    """Return the circle that points (m, 2) are nearest to, if enough of it is seen."""
    middle = outline.mean(axis=0)
    off = outline - middle
    design = np.column_stack((2 * off, np.ones(len(off))))
    (x, y, rest), *_ = np.linalg.lstsq(design, (off**2).sum(axis=1), rcond=None)
    radius = math.sqrt(max(float(rest + x * x + y * y), 0.0))
    for _ in range(ROUNDS):
        way = off - (x, y)
        far = np.maximum(np.hypot(*way.T), 1e-9)
        slope = np.column_stack((-way / far[:, None], -np.ones(len(far))))
        step, *_ = np.linalg.lstsq(slope, radius - far, rcond=None)
        x, y, radius = x + step[0], y + step[1], radius + float(step[2])
    span = float(np.hypot(*(off.max(axis=0) - off.min(axis=0))))
    if not 0.0 < radius < MAX_RADIUS_M or span < MIN_ARC * radius:
        return None
    error = float(np.abs(np.hypot(*(off - (x, y)).T) - radius).mean())
    radius += spacing / 2 if whole else 0.0  # its rim lies between two points
    return _Outline(float(middle[0] + x), float(middle[1] + y), 0.0, (radius,), error)
