"""Contours that cameras see: their polygons, and a memory for global paths."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import Contour
from gigabrain_zenoh.geometry.polygon import edges, spread
from gigabrain_zenoh.geometry.se2 import from_pose, transform
from gigabrain_zenoh.navigation.zones import EDGE_STEP

CELL_M = 0.05  # spacing of remembered points
NEAR_M = 1.5  # from the body, within which perception itself remembers contours
FAR_M = 10.0  # contours farther away are ignored
KEPT_TICKS = 60_000_000_000 // TICK_NS  # of a contour out of sight
MAX_POINTS = 20_000


def placed(contours: Sequence[Contour], pose: Pose) -> tuple[Floats, ...]:
    """Return the polygons (n, 2) [m] of `contours`, seen from a body at `pose`."""
    return tuple(transform(from_pose(pose), np.array(contour.polygon)) for contour in contours)


def covered(polygons: Sequence[Floats], side: int) -> NDArray[np.bool_]:
    """Return the cells (side, side) that any of `polygons` (n, 2), in cells, covers or touches.

    Corners may be in either order. All polygons are filled at once: 128 of them take 3 ms.
    """
    if not polygons:
        return np.zeros((side, side), np.bool_)
    corners, ends, first = edges(polygons)
    doubled = corners[:, 0] * ends[:, 1] - ends[:, 0] * corners[:, 1]
    sign = np.where(np.add.reduceat(doubled, first) < 0, -1, 1).astype(np.int16)
    mask = _inside(corners, ends, np.repeat(sign, np.diff(first, append=len(corners))), side)
    begin, along = _clipped_edges(corners, ends, side)
    edge, step = spread(np.ceil(np.abs(along).max(axis=1) / EDGE_STEP).astype(np.intp) + 1)
    share = step * EDGE_STEP / np.maximum(np.abs(along).max(axis=1), EDGE_STEP)[edge]
    points = begin[edge] + np.minimum(share, 1.0)[:, None] * along[edge]
    columns, rows = points[((points >= 0) & (points < side)).all(axis=1)].astype(np.intp).T
    mask[rows, columns] = True
    return mask


def _inside(corners: Floats, ends: Floats, sign: NDArray[np.int16], side: int) -> NDArray[np.bool_]:
    """Return the cells (side, side) whose middle is inside a polygon, by winding numbers."""
    crossings = np.zeros((side, side + 1), np.int16)  # before a cell's middle
    both = np.ceil(np.stack((corners[:, 1], ends[:, 1])) - 0.5).clip(0, side).astype(np.intp)
    first_row, last_row = both.min(axis=0), both.max(axis=0)
    edge, rows = spread(last_row - first_row)
    rows += first_row[edge]
    (x, y), (to_x, to_y) = corners[edge].T, ends[edge].T
    at = x + (rows + 0.5 - y) / np.where(to_y == y, 1.0, to_y - y) * (to_x - x)
    columns = np.ceil(at - 0.5).clip(0, side).astype(np.intp)
    np.add.at(crossings, (rows, columns), np.where(to_y < y, sign[edge], -sign[edge]))
    inside: NDArray[np.bool_] = np.cumsum(crossings[:, :-1], axis=1, dtype=np.int16) != 0
    return inside


def _clipped_edges(corners: Floats, ends: Floats, side: int) -> tuple[Floats, Floats]:
    """Clip edges to the square of `side`: return their begins and vectors, (n, 2) each.

    Liang and Barsky, A new concept and method for line clipping, ACM TOG 1984.
    """
    along = ends - corners
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -corners / along, (side - corners) / along
    still = along == 0.0
    enter = np.where(still, 0.0, np.minimum(low, high)).max(axis=1).clip(0.0, 1.0)
    leave = np.where(still, 1.0, np.maximum(low, high)).min(axis=1).clip(0.0, 1.0)
    length = np.maximum(leave - enter, 0.0)
    return corners + enter[:, None] * along, length[:, None] * along


class ContourMemory:
    """Points (n, 2) [m] of the map that contours cover, also contours out of sight.

    Points that are near the body or in view of a camera, but in no contour, are removed. Without
    the memory, a path would lead through an obstacle again as soon as the body has turned away.
    """

    def __init__(self) -> None:
        self.version = 0  # changes with the points
        self._cells = np.empty((0, 2), np.int64)
        self._ticks = np.empty(0, np.int64)

    def forget(self) -> None:
        """Remove all points."""
        self.version += len(self._cells) > 0
        self._cells, self._ticks = self._cells[:0], self._ticks[:0]

    @property
    def points(self) -> Floats:
        """The middles of the cells (n, 2) [m]."""
        found: Floats = (self._cells.astype(np.float64) + 0.5) * CELL_M
        return found

    def update(
        self, tick: int, here: Pose, body: BodyDescription, contours: Sequence[Floats]
    ) -> None:
        """Update with all present polygons (n, 2) [m], in the map, seen from `here`."""
        if not len(contours) and not len(self._cells):
            return
        fresh = _cells_of(contours, here)
        kept = (
            (tick - self._ticks <= KEPT_TICKS)
            & (tick >= self._ticks)
            & ~_watched(body, here, self.points)
        )
        cells = np.concatenate((fresh, self._cells[kept]))
        ticks = np.concatenate((np.full(len(fresh), tick), self._ticks[kept]))
        cells, first = np.unique(cells, axis=0, return_index=True)
        ticks = ticks[first]
        if len(cells) > MAX_POINTS:
            newest = np.sort(np.argsort(-ticks, kind="stable")[:MAX_POINTS])
            cells, ticks = cells[newest], ticks[newest]
        if not np.array_equal(cells, self._cells):
            self.version += 1
        self._cells, self._ticks = cells, ticks


def _cells_of(contours: Sequence[Floats], here: Pose) -> NDArray[np.int64]:
    """Return the cells (n, 2: column, row) that polygons cover within FAR_M of `here`."""
    side = round(2 * FAR_M / CELL_M)
    corner = np.floor((np.array((here.x, here.y)) - FAR_M) / CELL_M).astype(np.float64)
    rows, columns = np.nonzero(covered([polygon / CELL_M - corner for polygon in contours], side))
    return np.column_stack((columns, rows)).astype(np.int64) + corner.astype(np.int64)


def _watched(body: BodyDescription, here: Pose, points: Floats) -> NDArray[np.bool_]:
    """Return which `points` (n, 2) of the map a body at `here` would see as contours."""
    away = points - (here.x, here.y)
    distance = np.hypot(away[:, 0], away[:, 1])
    bearing = np.arctan2(away[:, 1], away[:, 0]) - here.yaw
    watched = distance <= NEAR_M
    for camera in body.fixed_cameras:
        half = math.atan2(camera.width / 2, camera.pinhole[0])
        off = np.abs(np.remainder(bearing - camera.yaw + math.pi, math.tau) - math.pi)
        watched |= (off <= half) & (distance <= camera.depth_max)
    return watched
