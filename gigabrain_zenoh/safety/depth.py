"""Obstacles in one depth picture: objects on the floor, and holes in it.

This is safety's own code, by numpy only, on the picture at half its width and height. Each pixel is
compared with depths that are computed once for the camera's mounting. Nearer than `above` it shows
an object on the floor; beyond `below` it shows a hole.
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

MOUNT_M, MOUNT_RAD = 0.005, math.radians(0.5)  # accuracy of a camera's mounting
NOISE_PER_M2, SIGMAS = 0.0015, 3.0  # [1/m], times z^2: standard deviation of a depth z
MEMORY_M = 0.3  # obstacles are remembered this far beyond the stopping distance
UNDISTORT_STEPS, MAX_UNDISTORT_ERROR = 20, 1e-3  # iterations; [m] at 1 m ahead
MIN_DIVISOR = 1e-3  # of a lens's rational model; real lenses have larger ones
MAX_ASIDE_M = 20.0  # at 1 m ahead; no lens sees more
NEVER = 65535  # [mm], a depth that no pixel has
MAX_CACHED_VIEWS = 8  # of all cameras and tilts
# the floor must be visible from depth_min + JUDGED_NEAR_M to JUDGED_SHARE * depth_max
JUDGED_NEAR_M, JUDGED_SHARE = 0.05, 0.8
ALIKE_M, ALIKE_SHARE = 0.015, 0.02  # maximum difference of neighbouring depths on one surface
MIN_NEIGHBOURS, SURE_NEIGHBOURS = 2, 4  # alike, of 8, of a doubtful and a sure point
MIN_HOLE_NEIGHBOURS, SURE_HOLE_NEIGHBOURS = 3, 6  # the same for holes
MAX_UNKNOWN_FLOOR, MAX_UNKNOWN = 0.8, 0.95  # shares of pixels; with more the camera is blind
GAP_PX = 5  # a square of this side without any floor is no flaw of the picture

Pixels = NDArray[np.uint16]
Mask = NDArray[np.bool_]
Up = tuple[float, float]  # x and y of the vertical in the body's frame; (0, 0) for a level body


class View(NamedTuple):
    """A camera on a body; arrays are (height / 2, width / 2), by pixel."""

    mount: Floats  # (3,) [m], in the body's frame, z from the floor
    rays: NDArray[np.float32]  # (h, w, 3), from `mount`, for 1 m of depth
    flat: NDArray[np.float32]  # (h, w), horizontal length of `rays`
    above: Pixels  # [mm], a smaller depth shows an object on the floor
    own: Pixels  # [mm], a depth up to here shows the body itself
    within: Pixels  # [mm], an object up to here is in reach, and not above the body's top
    below: Pixels  # [mm], a larger depth shows a hole; NEVER beyond reach
    floor: NDArray[np.float32]  # (h, w) [m], depth at which the ray meets the floor
    sure: Mask  # the floor, or an object on it, must be visible
    upright: bool  # columns of the picture are vertical
    known: float  # share of the pixels with a known ray


class Sighting(NamedTuple):
    """Points of obstacles in one picture, in the body's frame."""

    points: Floats  # (n, 3) [m]; for a hole, its edge on the floor
    hole: Mask  # (n,)
    sure: Mask  # (n,), large enough to count at once


def reach_of(body: BodyDescription) -> float:
    """Return the distance from the body's middle up to which obstacles are remembered [m]."""
    return brakes(body)["forward"].reach + radius(body.footprint) + MEMORY_M


class _Level(NamedTuple):
    """The view of a camera on a level body, and the data for views of a tilted one."""

    view: View
    rays: Floats  # (h, w, 3), as in `view`, exact
    angle: Floats  # (h, w), height error per metre of depth
    known: Mask  # (h, w)


@lru_cache(maxsize=MAX_CACHED_VIEWS)
def view_of(body: BodyDescription, camera: Camera, up: Up = (0.0, 0.0)) -> View:
    """Return the view of a camera on a body; `up` is the vertical in the body's frame.

    A pixel shows the floor if its height is 0 within a tolerance t, which grows with the depth z:

        t(z) = 5 mm + tan(0.5 deg) (|a| + |b|) z + 3 * 1.5 mm / m^2 z^2 |s|

    The terms come from the mounting's position, its pitch and roll, and the depth's noise. Per
    metre of depth, a ray goes a ahead, b aside and s up. Straight ahead of a camera 0.1 m up, t is
    10 mm at 0.5 m, 15 mm at 1 m and 24 mm at 2 m. So an object of 3 cm counts up to 2.5 m, if it
    fills three pixels. A tilted body stands on a slope or on a sill: a surface that is the floor
    in one of these cases is no obstacle.
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
    """Return the view of a camera on a level body. A view of another tilt is much faster."""
    mount, (rays, known) = np.array((camera.x, camera.y, camera.z)), _rays(camera)
    ahead = np.array((math.cos(camera.yaw), math.sin(camera.yaw)))
    aside = np.array((-ahead[1], ahead[0]))
    across = np.abs(rays[..., :2] @ ahead) + np.abs(rays[..., :2] @ aside)
    angle, height, slope = math.tan(MOUNT_RAD) * across, camera.z, rays[..., 2]
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
    """Return the rays of every second pixel in the body's frame (h, w, 3), for 1 m of depth.

    The mask (h, w) has the pixels with a known ray; the lens shows nothing in the others.
    """
    fx, fy, cx, cy = camera.pinhole
    right, down = np.meshgrid(
        (np.arange(0, camera.width, 2) - cx) / fx, (np.arange(0, camera.height, 2) - cy) / fy
    )
    seen_x, seen_y = right, down
    for _ in range(UNDISTORT_STEPS if camera.distortion else 0):
        x, y = _distort(camera, right, down)
        right = (right + (seen_x - x)).clip(-MAX_ASIDE_M, MAX_ASIDE_M)
        down = (down + (seen_y - y)).clip(-MAX_ASIDE_M, MAX_ASIDE_M)
    x, y = _distort(camera, right, down)
    rays = np.stack([np.ones_like(right), -right, -down], axis=-1) @ turn_of(camera).T
    return rays, np.hypot(x - seen_x, y - seen_y) < MAX_UNDISTORT_ERROR


def _distort(camera: Camera, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return where a lens shows the point at x (right) and y (down), 1 m ahead."""
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
    """Return the depths `above`, below the body's top, and `below` by pixel [mm]; see View.

    The height at depth z is h + s z, and its tolerance t + a z + q z^2.
    """
    noise, falls = SIGMAS * NOISE_PER_M2 * np.abs(slope), angle - slope
    return (
        _depths_at(height - MOUNT_M, falls, noise),
        _depths_at(body_height - height, -falls, -noise),
        _depths_at(height + MOUNT_M, -slope - angle, -noise),
    )


def _depths_at(height: float, slope: Floats, noise: Floats) -> Pixels:
    """Return the depths z [mm] at which s z + q z^2 is `height`: 2 h / (s + sqrt(s^2 + 4 q h)).

    It works in place to save time: while the tilt changes, it runs for each picture.
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
    """Return the depths (h, w) [m] up to which rays are over the footprint; 0 outside it."""
    hull = edges(body.footprint)
    room = hull.offsets - hull.normals @ mount[:2]
    if (room <= 0).any():
        return np.zeros(rays.shape[:2])
    towards = rays[..., :2] @ hull.normals.T
    with np.errstate(divide="ignore"):
        leaves: Floats = np.where(towards > 0, room / towards, np.inf).min(axis=-1)
    return leaves


def _millimetres(depth: Floats) -> Pixels:
    """Return depths [m] >= 0 in millimetres; NEVER for nan."""
    depth = depth * 1000.0
    return np.fmin(depth, NEVER, out=depth).astype(np.uint16)


def unknown(camera: Camera, picture: Pixels) -> Mask:
    """Return a mask (h, w) of the pixels without a depth in the camera's range."""
    dark: Mask = (picture == 0) | (picture > _max_depth_mm(camera))
    return dark


def _max_depth_mm(camera: Camera) -> int:
    return min(NEVER - 1, round(camera.depth_max * 1000.0))


def blind(camera: Camera, view: View, picture: Pixels) -> bool:
    """Return whether nearly all of the floor that must be visible is unknown.

    A camera that looks over the floor is blind if nearly the whole picture is unknown.
    """
    dark = unknown(camera, picture)
    floor = dark[view.sure]
    watched, share = (
        (floor, MAX_UNKNOWN_FLOOR) if 20 * floor.size >= dark.size else (dark, MAX_UNKNOWN)
    )
    return bool(np.count_nonzero(watched) > share * watched.size)


def sight(body: BodyDescription, camera: Camera, view: View, picture: Pixels) -> Sighting:
    """Return the nearest obstacle points in each column of a picture (h, w) [mm].

    A point needs neighbours: a single pixel is noise.
    """
    dark = unknown(camera, picture)
    hull = edges(body.footprint)
    # 0, which is no depth, wraps around to the maximum
    standing = ((picture - np.uint16(1)) < view.within) & (picture > view.own)
    found: list[tuple[Floats, bool, bool]] = []
    if standing.any():
        alike, metres = _count_alike(standing, picture), picture * np.float32(0.001)
        sure, doubtful = alike >= SURE_NEIGHBOURS, standing & (alike >= MIN_NEIGHBOURS)
        for points, known in _nearest(view, standing & sure, doubtful, metres):
            found.append((points[outside(hull, points[:, :2]) > 0], False, known))
    hole = (picture > view.below) & ~dark
    beside = _count_neighbours(hole) if hole.any() else hole.view(np.uint8)
    gap = _gap_centers(hole | (dark & view.sure))
    doubtful = (hole & (beside >= MIN_HOLE_NEIGHBOURS)) | gap
    if doubtful.any():
        for points, known in _nearest(
            view, hole & (beside >= SURE_HOLE_NEIGHBOURS), doubtful, view.floor
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

    These are the `sure` points, then the `doubtful` ones that are nearer still.
    """
    distance, rays = metres * view.flat, view.rays
    if not view.upright:
        distance, metres, rays = distance.T, metres.T, rays.transpose(1, 0, 2)
        sure, doubtful = sure.T, doubtful.T
    column, found = np.arange(distance.shape[1]), []
    limit = np.full(distance.shape[1], np.inf, np.float32)
    for mask, known in ((sure, True), (doubtful, False)):
        masked = np.where(mask, distance, np.float32(np.inf))
        row = masked.argmin(axis=0)
        nearest = masked[row, column]
        nearer = np.flatnonzero(nearest < limit)
        limit = np.minimum(limit, nearest)
        row = row[nearer]
        points = metres[row, nearer, None].astype(np.float64) * rays[row, nearer]
        found.append((view.mount + points, known))
    return found[0], found[1]


def _count_neighbours(mask: Mask) -> NDArray[np.uint8]:
    """Return for each pixel how many of its 8 neighbours are in `mask`."""
    padded = np.pad(mask.view(np.uint8), 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    around: NDArray[np.uint8] = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    return around - mask


def _gap_centers(mask: Mask) -> Mask:
    """Return a mask of the middles of all squares of GAP_PX pixels in `mask`."""
    found = np.pad(mask, GAP_PX // 2, mode="edge")
    for _ in range(GAP_PX - 1):
        found = found[1:, 1:] & found[:-1, 1:] & found[1:, :-1] & found[:-1, :-1]
    return found


def _count_alike(mask: Mask, picture: Pixels) -> NDArray[np.uint8]:
    """Return for each pixel how many of its 8 neighbours in `mask` have a similar depth."""
    count = np.zeros(mask.shape, np.uint8)
    depth = picture.astype(np.int32)
    max_mm = depth // round(1 / ALIKE_SHARE) + round(1000 * ALIKE_M)
    head, tail = slice(None, -1), slice(1, None)
    whole = slice(None)
    for first, second in (
        ((whole, head), (whole, tail)),
        ((head, whole), (tail, whole)),
        ((head, head), (tail, tail)),
        ((head, tail), (tail, head)),
    ):
        alike = np.abs(depth[first] - depth[second]) <= max_mm[first]
        alike &= mask[first] & mask[second]
        count[first] += alike
        count[second] += alike
    return count


def seen_through(camera: Camera, view: View, picture: Pixels, points: Floats, hole: Mask) -> Mask:
    """Return a mask of the `points` (n, 3) [m], in the body's frame, that are gone.

    An object is gone if the picture shows the floor, or anything farther. A hole is gone if the
    picture shows the floor. Unknown pixels show nothing.
    """
    seen = (points - view.mount) @ turn_of(camera)
    fx, fy, cx, cy = camera.pinhole
    depth = np.maximum(seen[:, 0], 1e-6)
    right, down = _distort(camera, -seen[:, 1] / depth, -seen[:, 2] / depth)
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
