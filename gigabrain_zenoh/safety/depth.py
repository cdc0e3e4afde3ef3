"""Obstacles in one depth picture: what stands above the floor, and where the floor is missing.

Safety's own code, by numpy alone, on the picture at half its width and height. All that it decides
about a pixel is a depth that was computed once for the camera's place: nearer than `above` the
pixel shows something that stands on the floor, beyond `below` it looks through a hole in it.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import MAX_CAMERAS, BodyDescription, Camera
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.geometry.sweep import depth as outside
from gigabrain_zenoh.geometry.sweep import edges, radius

MOUNT_M, MOUNT_RAD = 0.005, math.radians(0.5)  # to which the mounting of a camera is known
NOISE_PER_M2, SIGMAS = 0.0015, 3.0  # [1/m], the deviation of a depth z is this times z^2
MEMORY_M = 0.3  # beyond the stopping distance, what is seen is remembered
UNDISTORT_STEPS, UNDISTORTED = 20, 1e-3  # and how far off a ray may be then, 1 m ahead
MIN_DIVISOR = 1e-3  # of the rational model of a lens; that of a real one is larger
WIDEST = 20.0  # [m] aside of what is 1 m ahead: no lens sees that
NEVER = 65535  # [mm], a depth that no pixel has
KEPT_VIEWS = 8  # of all cameras and tilts
# beyond depth_min, of depth_max: the floor must be seen there
JUDGED_NEAR_M, JUDGED_SHARE = 0.05, 0.8
ALIKE_M, ALIKE_SHARE = 0.015, 0.02  # by which depths on one surface differ from pixel to pixel
BESIDE, CERTAIN_BESIDE = 2, 4  # of 8 neighbours alike: to be believed if confirmed, at once
HOLE_BESIDE, CERTAIN_HOLE_BESIDE = 3, 6  # the same of holes
BLIND_FLOOR, BLIND = 0.8, 0.95  # share of unknown pixels
GAP_PX = 5  # side of a square without any floor that is no flaw of the picture

Pixels = NDArray[np.uint16]
Mask = NDArray[np.bool_]
Up = tuple[float, float]  # x and y of the vertical in the body's frame; (0, 0) for a level body


class View(NamedTuple):
    """A camera on a body; arrays are (height / 2, width / 2), by pixel."""

    mount: Floats  # (3,) [m], in the body's frame, z from the floor
    rays: NDArray[np.float32]  # (h, w, 3), from there for each metre of depth
    flat: NDArray[np.float32]  # (h, w), length of `rays` in the plane
    above: Pixels  # [mm], any depth below this one shows something that stands on the floor
    own: Pixels  # [mm], up to here it is the body itself
    within: Pixels  # [mm], up to here that is an obstacle: in reach, and not over the body
    below: Pixels  # [mm], a depth beyond this one shows a hole; NEVER beyond reach
    floor: NDArray[np.float32]  # (h, w) [m], depth at which the ray meets the floor
    sure: Mask  # the floor is so near that it must be seen, or what stands on it
    upright: bool  # columns of the picture are vertical
    known: float  # share of the pixels whose ray is known


class Sighting(NamedTuple):
    """Points of obstacles in one picture, in the body's frame."""

    points: Floats  # (n, 3) [m]; of a hole its edge on the floor
    hole: Mask  # (n,)
    sure: Mask  # (n,), enough of it is seen to believe it at once


def reach_of(body: BodyDescription) -> float:
    """Return how far from the body's middle obstacles are remembered [m]."""
    return brakes(body)["forward"].reach + radius(body.footprint) + MEMORY_M


class _Level(NamedTuple):
    """A camera on a level body, and what its views from a tilted one are computed from."""

    view: View
    rays: Floats  # (h, w, 3), as in `view`, exact
    angle: Floats  # (h, w), error of heights for each metre of depth
    known: Mask  # (h, w)


@lru_cache(maxsize=KEPT_VIEWS)
def view_of(body: BodyDescription, camera: Camera, up: Up = (0.0, 0.0)) -> View:
    """Return the view of a camera on a body, whose vertical is `up` in its own frame.

    The floor is where the height above it is 0 within a tolerance t that grows with the depth z:

        t(z) = 5 mm + tan(0.5 deg) (|a| + |b|) z + 3 * 1.5 mm / m^2 z^2 |s|

    by the mounting's place, its pitch and roll (a and b are the ray's ways ahead and aside per
    metre of depth), and the noise of the depth (s is its way up). Straight ahead of a camera 0.1 m
    up that is 10 mm at 0.5 m, 15 mm at 1 m and 24 mm at 2 m: a thing of 3 cm counts up to 2.5 m,
    if it fills three pixels. A body that is tilted stands on a slope, or on a sill: nothing is an
    obstacle that would be the floor of one of the two.
    """
    view, rays, angle, known = _level(body, camera)
    if up == (0.0, 0.0):
        return view
    vertical = np.array((*up, math.sqrt(max(0.0, 1.0 - up[0] ** 2 - up[1] ** 2))))
    height = float(view.mount @ vertical)
    above, top, below = _bounds(height, rays @ vertical, angle, body.body_height)
    return view._replace(
        above=np.where(known, np.minimum(view.above, above), np.uint16(NEVER)),
        within=np.minimum(view.within, np.minimum(above, top)),
        below=np.maximum(view.below, below),
    )


@lru_cache(maxsize=MAX_CAMERAS)
def _level(body: BodyDescription, camera: Camera) -> _Level:
    """Return the view of a camera on a level body; this takes far longer than another tilt."""
    mount, (rays, known) = np.array((camera.x, camera.y, camera.z)), _rays(camera)
    ahead = np.array((math.cos(camera.yaw), math.sin(camera.yaw)))
    aside = np.array((-ahead[1], ahead[0]))
    way = np.abs(rays[..., :2] @ ahead) + np.abs(rays[..., :2] @ aside)
    angle, height, slope = math.tan(MOUNT_RAD) * way, camera.z, rays[..., 2]
    above, top, below = _bounds(height, slope, angle, body.body_height)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(slope < 0, -height / slope, np.inf)
    reach = np.minimum(_reach(mount, rays, reach_of(body)), camera.depth_max)
    within = np.minimum(np.minimum(above, top), _millimetres(reach))
    crossing = mount[:2] + np.minimum(floor, 1e6)[..., None] * rays[..., :2]
    away = np.hypot(crossing[..., 0], crossing[..., 1])
    near = known & (away <= reach_of(body)) & (outside(edges(body.footprint), crossing) > 0)
    sure = near & (floor >= camera.depth_min + JUDGED_NEAR_M)
    sure &= floor <= JUDGED_SHARE * camera.depth_max
    view = View(
        mount=mount,
        rays=rays.astype(np.float32),
        flat=np.hypot(rays[..., 0], rays[..., 1]).astype(np.float32),
        above=np.where(known, above, np.uint16(NEVER)),
        own=_millimetres(_inside(body, mount, rays)),
        within=np.where(known, within, np.uint16(0)),
        below=np.where(near, below, np.uint16(NEVER)),
        floor=floor.astype(np.float32),
        sure=sure,
        upright=abs(math.cos(camera.roll)) >= abs(math.sin(camera.roll)),
        known=float(known.mean()),
    )
    return _Level(view, rays, angle, known)


def _rays(camera: Camera) -> tuple[Floats, Mask]:
    """Return the direction of every second pixel in the body's frame, (h, w, 3), 1 m of depth.

    And the pixels (h, w) for which that is known: no light reaches the others through the lens.
    """
    fx, fy, cx, cy = camera.pinhole
    right, down = np.meshgrid(
        (np.arange(0, camera.width, 2) - cx) / fx, (np.arange(0, camera.height, 2) - cy) / fy
    )
    seen_x, seen_y = right, down
    for _ in range(UNDISTORT_STEPS if camera.distortion else 0):
        x, y = _distorted(camera, right, down)
        right = (right + (seen_x - x)).clip(-WIDEST, WIDEST)
        down = (down + (seen_y - y)).clip(-WIDEST, WIDEST)
    x, y = _distorted(camera, right, down)
    rays = np.stack([np.ones_like(right), -right, -down], axis=-1) @ turn_of(camera).T
    return rays, np.hypot(x - seen_x, y - seen_y) < UNDISTORTED


def _distorted(camera: Camera, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return where a lens shows what is at x (right) and y (down), 1 m before it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, *[0.0] * 8)[:8]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    radial /= np.maximum(1.0 + square * (k4 + square * (k5 + square * k6)), MIN_DIVISOR)
    return (
        x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
        y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
    )


@lru_cache(maxsize=16)
def turn_of(camera: Camera) -> Floats:
    """Return the matrix (3, 3) that turns the camera's frame into the body's."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(angle), math.sin(angle)) for angle in (camera.roll, camera.pitch, camera.yaw)
    )
    roll = np.array(((1.0, 0.0, 0.0), (0.0, cr, -sr), (0.0, sr, cr)))
    pitch = np.array(((cp, 0.0, sp), (0.0, 1.0, 0.0), (-sp, 0.0, cp)))
    yaw = np.array(((cy, -sy, 0.0), (sy, cy, 0.0), (0.0, 0.0, 1.0)))
    turn: Floats = yaw @ pitch @ roll
    return turn


def _bounds(
    height: float, slope: Floats, angle: Floats, body_height: float
) -> tuple[Pixels, Pixels, Pixels]:
    """Return depths by pixel [mm]: above the floor, below the body's top, below the floor.

    The height at depth z is h + s z, and its tolerance t + a z + q z^2.
    """
    noise, falls = SIGMAS * NOISE_PER_M2 * np.abs(slope), angle - slope
    return (
        _crossed(height - MOUNT_M, falls, noise),
        _crossed(body_height - height, -falls, -noise),
        _crossed(height + MOUNT_M, -slope - angle, -noise),
    )


def _crossed(height: float, slope: Floats, noise: Floats) -> Pixels:
    """Return the depths z [mm] at which s z + q z^2 is `height`: 2 h / (s + sqrt(s^2 + 4 q h)).

    It works in place: where the tilt changes, this is done for each picture.
    """
    height = max(0.0, height)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = 4 * height * noise
        root += slope * slope
        np.sqrt(root, out=root)
        root += slope
        np.maximum(root, 0.0, out=root)
        return _millimetres(np.divide(2 * height, root, out=root))


def _reach(mount: Floats, rays: Floats, reach: float) -> Floats:
    """Return the depths (h, w) [m] at which rays leave the circle of `reach` [m] round the body."""
    a = (rays[..., :2] ** 2).sum(axis=-1)
    b = rays[..., :2] @ mount[:2]
    c = float(mount[:2] @ mount[:2]) - reach * reach
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (-b + np.sqrt(b * b - a * c)) / a
    return np.where(np.isfinite(depth), np.maximum(depth, 0.0), np.inf)


def _inside(body: BodyDescription, mount: Floats, rays: Floats) -> Floats:
    """Return the depths (h, w) [m] up to which rays are over the body's footprint; 0 without."""
    hull = edges(body.footprint)
    room = hull.offsets - hull.normals @ mount[:2]
    if (room <= 0).any():
        return np.zeros(rays.shape[:2])
    towards = rays[..., :2] @ hull.normals.T
    with np.errstate(divide="ignore"):
        leaves: Floats = np.where(towards > 0, room / towards, np.inf).min(axis=-1)
    return leaves


def _millimetres(depth: Floats) -> Pixels:
    """Return depths [m] >= 0 in millimetres; NEVER for one that is not known."""
    depth = depth * 1000.0
    return np.fmin(depth, NEVER, out=depth).astype(np.uint16)


def unknown(camera: Camera, picture: Pixels) -> Mask:
    """Return the pixels (h, w) without a depth that the camera can measure."""
    dark: Mask = (picture == 0) | (picture > _farthest(camera))
    return dark


def _farthest(camera: Camera) -> int:
    return min(NEVER - 1, round(camera.depth_max * 1000.0))


def blind(camera: Camera, view: View, picture: Pixels) -> bool:
    """Return whether next to nothing is known of the floor that must be seen.

    A camera that looks over it is blind where next to nothing is known at all.
    """
    dark = unknown(camera, picture)
    floor = dark[view.sure]
    watched, share = (floor, BLIND_FLOOR) if 20 * floor.size >= dark.size else (dark, BLIND)
    return bool(np.count_nonzero(watched) > share * watched.size)


def sight(body: BodyDescription, camera: Camera, view: View, picture: Pixels) -> Sighting:
    """Return the nearest obstacle points in each column of a picture (h, w) [mm].

    A point needs neighbours: a single pixel is noise.
    """
    dark = unknown(camera, picture)
    hull = edges(body.footprint)
    # 0 wraps round: it is no depth
    stands = ((picture - np.uint16(1)) < view.within) & (picture > view.own)
    found: list[tuple[Floats, bool, bool]] = []
    if stands.any():
        beside, metres = _alike(stands, picture), picture * np.float32(0.001)
        sure, doubtful = beside >= CERTAIN_BESIDE, stands & (beside >= BESIDE)
        for points, known in _nearest(view, stands & sure, doubtful, metres):
            found.append((points[outside(hull, points[:, :2]) > 0], False, known))
    hole = (picture > view.below) & ~dark
    holes = _beside(hole) if hole.any() else hole.view(np.uint8)
    gap = _squares(hole | (dark & view.sure))
    doubtful = (hole & (holes >= HOLE_BESIDE)) | gap
    if doubtful.any():
        for points, known in _nearest(
            view, hole & (holes >= CERTAIN_HOLE_BESIDE), doubtful, view.floor
        ):
            found.append((points, True, known))
    if not found:
        return Sighting(np.empty((0, 3)), np.empty(0, bool), np.empty(0, bool))
    counts = [len(points) for points, _, _ in found]
    return Sighting(
        np.concatenate([points for points, _, _ in found]),
        np.repeat([is_hole for _, is_hole, _ in found], counts),
        np.repeat([sure for _, _, sure in found], counts),
    )


def _nearest(
    view: View, sure: Mask, doubtful: Mask, metres: NDArray[np.float32]
) -> tuple[tuple[Floats, bool], tuple[Floats, bool]]:
    """Return the nearest points (n, 3) [m] in each column, at depths `metres` (h, w).

    First those that are `sure`, then those `doubtful` ones that are nearer still.
    """
    way, rays = metres * view.flat, view.rays
    if not view.upright:
        way, metres, rays = way.T, metres.T, rays.transpose(1, 0, 2)
        sure, doubtful = sure.T, doubtful.T
    column, found = np.arange(way.shape[1]), []
    least = np.full(way.shape[1], np.inf, np.float32)
    for mask, known in ((sure, True), (doubtful, False)):
        away = np.where(mask, way, np.float32(np.inf))
        row = away.argmin(axis=0)
        nearest = away[row, column]
        nearer = np.flatnonzero(nearest < least)
        least = np.minimum(least, nearest)
        row = row[nearer]
        points = metres[row, nearer, None].astype(np.float64) * rays[row, nearer]
        found.append((view.mount + points, known))
    return found[0], found[1]


def _beside(mask: Mask) -> NDArray[np.uint8]:
    """Return how many of its 8 neighbours are in `mask` too, for each of its pixels."""
    padded = np.pad(mask.view(np.uint8), 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    around: NDArray[np.uint8] = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return around - mask


def _squares(mask: Mask) -> Mask:
    """Return the middles of all squares of GAP_PX pixels that are in `mask`."""
    found = np.pad(mask, GAP_PX // 2, mode="edge")
    for _ in range(GAP_PX - 1):
        found = found[1:, 1:] & found[:-1, 1:] & found[1:, :-1] & found[:-1, :-1]
    return found


def _alike(mask: Mask, picture: Pixels) -> NDArray[np.uint8]:
    """Return how many of its 8 neighbours in `mask` have about its depth, for each pixel."""
    count = np.zeros(mask.shape, np.uint8)
    depth = picture.astype(np.int32)
    most = depth // round(1 / ALIKE_SHARE) + round(1000 * ALIKE_M)
    here, there = slice(None, -1), slice(1, None)
    whole = slice(None)
    for one, other in (
        ((whole, here), (whole, there)),
        ((here, whole), (there, whole)),
        ((here, here), (there, there)),
        ((here, there), (there, here)),
    ):
        alike = np.abs(depth[one] - depth[other]) <= most[one]
        alike &= mask[one] & mask[other]
        count[one] += alike
        count[other] += alike
    return count


def seen_through(camera: Camera, view: View, picture: Pixels, points: Floats, hole: Mask) -> Mask:
    """Return which `points` (n, 3) [m] in the body's frame the picture shows to be gone.

    A thing is gone where the picture looks past it, or shows the floor; a hole where the picture
    shows the floor. What is unknown shows nothing.
    """
    seen = (points - view.mount) @ turn_of(camera)
    fx, fy, cx, cy = camera.pinhole
    depth = np.maximum(seen[:, 0], 1e-6)
    right, down = _distorted(camera, -seen[:, 1] / depth, -seen[:, 2] / depth)
    height, width = picture.shape
    column = np.rint((cx + fx * right) / 2).clip(-1, width).astype(np.intp)
    row = np.rint((cy + fy * down) / 2).clip(-1, height).astype(np.intp)
    inside = (seen[:, 0] > 0.05) & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    row, column = np.where(inside, row, 0), np.where(inside, column, 0)
    shown = picture[row, column]
    margin = 0.02 + SIGMAS * NOISE_PER_M2 * depth * depth
    past = shown > 1000.0 * (depth + margin)
    on_floor = shown > view.above[row, column]
    gone = np.where(hole, on_floor & (shown <= view.below[row, column]), past | on_floor)
    result: Mask = inside & (shown > 0) & gone
    return result
