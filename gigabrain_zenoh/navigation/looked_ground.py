"""Ground that cameras have looked at; elsewhere, low obstacles may be unknown.

A camera sees a wedge ahead. Beside the body, or closer than the camera sees the floor, there may be
a sill or a step down that was never in view. Such ground, unless the body has stood on it, costs
like an obstacle MARGIN_M away. So the body turns more in place, and looks.

Unseen ground is not forbidden: a body without room to turn would stand for ever. A body that can
move sideways keeps its heading and does not turn to look. For it, unseen ground is as far away as
its stopping distance, so that it need not brake. A stuck body turns to look where its way leads, or
backs off to see the ground. Narrow gaps near it then count as seen.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_zenoh.geometry.polygon import points_on_edges
from gigabrain_zenoh.geometry.stopping import brakes
from gigabrain_zenoh.geometry.sweep import radius
from gigabrain_zenoh.navigation.footprint import MAX_DISTANCE_M, DistanceGrid
from gigabrain_zenoh.navigation.local_costmap import (
    CELL_M,
    Chamfer,
    Pose2D,
    Singles,
    fill_disc,
)
from gigabrain_zenoh.navigation.zones import fill

RELIABLE_M = 1.5  # range within which a camera shows obstacles 3 cm high
EDGE_RAD = math.radians(1.5)  # at the left and right of a picture, not trusted
SOON_M = 0.25  # beyond the circle of a turning body, that it may reach before it has looked
PLACED_M = 0.1  # beyond that circle, assumed to be clear at the start
MARGIN_M = 0.06  # distance of the obstacle whose cost unseen ground has
GAP_M = 0.12  # unseen gaps narrower than this hide no obstacle
BIN_RAD = math.radians(3.0)  # of bearings round a camera
SHADE_STEP_M = 0.015  # between points of an outline that is_unseen_ahead the ground behind it
BEHIND_M = 0.05  # behind the nearest point of an outline, still seen
Mask = NDArray[np.bool_]


class LookedGround:
    """Cells of a window that the cameras of `body` have seen, or that it has stood on.

    The window has the cells of a LocalCostmap. Before the first look of a trusted camera, no ground
    counts as unseen.
    """

    def __init__(self, body: BodyDescription, side: int) -> None:
        self._body, self._side = body, side
        self._turning_radius = radius(body.footprint)
        along, aside = brakes(body)["forward"], body.max_lateral_speed > 0.0
        self._margin = along.reach if aside else MARGIN_M
        self._looked = np.zeros((side, side), np.uint8)
        self._row = self._column = 0  # of the window's first cell
        self._chamfer = Chamfer(side, CELL_M, MAX_DISTANCE_M)
        self._has_looked = False

    def limited(
        self, grid: DistanceGrid, place: Pose2D, cameras: Sequence[str], outlines: Sequence[Floats]
    ) -> DistanceGrid:
        """Look, and return `grid` with unseen ground near `place` as distant obstacles.

        For the arguments see `look`. The cells of `grid` are those of the window.
        """
        self.look(place, cameras, outlines, grid.x, grid.y)
        unseen = self._unseen(place)
        if unseen is None:
            return grid
        return grid._replace(distance=np.minimum(grid.distance, unseen))

    def look(
        self, place: Pose2D, cameras: Sequence[str], outlines: Sequence[Floats], x: float, y: float
    ) -> None:
        """Add the ground that the trusted `cameras` see from `place`.

        The corner of the window is at (x, y) [m]. Polygons `outlines` (n, 2) [m] hide the ground
        behind them.
        """
        seeing = [
            camera for camera in self._body.cameras if camera.name in cameras and camera.depth
        ]
        if not seeing and not self._has_looked:
            return
        self._move_window(round(y / CELL_M), round(x / CELL_M))
        if not self._has_looked:
            self._has_looked = True
            reach = math.ceil((self._turning_radius + PLACED_M) / CELL_M)
            fill_disc(self._looked, *self._cell(place.x, place.y), reach)
        cos, sin = math.cos(place.yaw), math.sin(place.yaw)
        turn = np.array([[cos, sin], [-sin, cos]])
        stood = np.array(self._body.footprint) @ turn + (place.x, place.y)
        fill(self._looked, (stood - self._corner) / CELL_M, 1)
        for camera in seeing:
            eye = np.array((camera.x, camera.y)) @ turn + (place.x, place.y)
            self._see(camera, eye, place.yaw + camera.yaw, outlines)

    def fill_gaps(self, place: Pose2D) -> None:
        """Count unseen gaps near `place` that are narrower than GAP_M as seen."""
        if not self._has_looked:
            return
        deep = self._chamfer.distance((self._looked == 0).view(np.uint8)) > GAP_M / 2
        beyond = self._chamfer.distance((~deep).view(np.uint8)) > GAP_M / 2
        self._looked[self._near(place) & beyond] = 1

    def is_unseen_ahead(self, place: Pose2D, bearing: float, half_width: float) -> bool:
        """Return whether there is unseen ground near `place` in the direction `bearing` [rad].

        The strip ahead is `half_width` [m] wide to both sides. It begins at the circle of the
        turning body.
        """
        if not self._has_looked:
            return False
        rows, columns = np.nonzero(self._near(place) & (self._looked == 0))
        x = (columns + self._column + 0.5) * CELL_M - place.x
        y = (rows + self._row + 0.5) * CELL_M - place.y
        cos, sin = math.cos(bearing), math.sin(bearing)
        ahead, aside = cos * x + sin * y, cos * y - sin * x
        return bool(np.any((ahead > self._turning_radius) & (np.abs(aside) <= half_width)))

    def _near(self, place: Pose2D) -> Mask:
        """Return the cells that a body at `place` may reach soon."""
        near = np.zeros((self._side, self._side), np.uint8)
        reach = math.ceil((self._turning_radius + SOON_M) / CELL_M)
        fill_disc(near, *self._cell(place.x, place.y), reach)
        return near > 0

    def _unseen(self, place: Pose2D) -> Singles | None:
        """Return distances (side, side) to unseen ground near `place`; None without any."""
        if not self._has_looked:
            return None
        unseen = self._near(place) & (self._looked == 0)
        if not unseen.any():
            return None
        return self._chamfer.distance((~unseen).view(np.uint8)) + np.float32(self._margin)

    @property
    def _corner(self) -> Floats:
        return np.array((self._column, self._row)) * CELL_M

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(y / CELL_M) - self._row, math.floor(x / CELL_M) - self._column

    def _move_window(self, row: int, column: int) -> None:
        """Move the window, and forget cells outside."""
        down, right = row - self._row, column - self._column
        if down or right:
            old, self._looked = self._looked, np.zeros_like(self._looked)
            (to_y, from_y), (to_x, from_x) = _overlap(down, self._side), _overlap(right, self._side)
            self._looked[to_y, to_x] = old[from_y, from_x]
            self._row, self._column = row, column

    def _see(self, camera: Camera, eye: Floats, yaw: float, outlines: Sequence[Floats]) -> None:
        """Mark the floor in view of a camera at `eye` (2,)."""
        near, far, half = floor_in_view(camera)
        if near >= far:
            return
        reach = math.ceil(far / math.cos(half) / CELL_M) + 1
        row, column = self._cell(float(eye[0]), float(eye[1]))
        rows = slice(max(row - reach, 0), max(row + reach + 1, 0))
        columns = slice(max(column - reach, 0), max(column + reach + 1, 0))
        part = self._looked[rows, columns]
        y, x = np.indices(part.shape)
        right = self._corner[0] + (x + columns.start + 0.5) * CELL_M - eye[0]
        up = self._corner[1] + (y + rows.start + 0.5) * CELL_M - eye[1]
        bearing, away = _polar(right, up, yaw)
        ahead = away * np.cos(bearing)
        seen = (np.abs(bearing) < half) & (ahead >= near) & (ahead <= far)
        free = _outline_distances(eye, yaw, outlines)
        seen &= away <= free[_bin(bearing, len(free))] + BEHIND_M
        part[seen] = 1


def floor_in_view(camera: Camera) -> tuple[float, float, float]:
    """Return the nearest and farthest floor in view [m], and half the view angle [rad]."""
    fx, fy, _, cy = camera.pinhole
    lowest = camera.pitch + math.atan2(camera.height - cy, fy)
    highest = camera.pitch - math.atan2(cy, fy)
    near = camera.z / math.tan(lowest) if 0.0 < lowest < math.pi / 2 else math.inf
    far = camera.z / math.tan(highest) if highest > 0.0 else math.inf
    half = math.atan2(camera.width / 2, fx) - EDGE_RAD
    return max(near, camera.depth_min), min(far, camera.depth_max, RELIABLE_M), half


def _overlap(shift: int, side: int) -> tuple[slice, slice]:
    """Return the new and the old slice of the cells that stay in a window moved by `shift`."""
    count = max(side - abs(shift), 0)
    to, from_ = max(-shift, 0), max(shift, 0)
    return slice(to, to + count), slice(from_, from_ + count)


def _polar(x: Floats, y: Floats, yaw: float) -> tuple[Floats, Floats]:
    bearing = np.remainder(np.arctan2(y, x) - yaw + math.pi, math.tau) - math.pi
    return bearing, np.hypot(x, y)


def _bin(bearing: Floats, count: int) -> NDArray[np.intp]:
    return np.minimum(((bearing + math.pi) / BIN_RAD).astype(np.intp), count - 1)


def _outline_distances(eye: Floats, yaw: float, outlines: Sequence[Floats]) -> Floats:
    """Return the distance of the nearest outline in each bin of bearings (n,) [m]."""
    free = np.full(round(math.tau / BIN_RAD), np.inf)
    if outlines:
        points = points_on_edges(outlines, SHADE_STEP_M) - eye
        bearing, away = _polar(points[:, 0], points[:, 1], yaw)
        np.minimum.at(free, _bin(bearing, len(free)), away)
    return free
