"""Memory of obstacles seen by cameras: cells in the odometry's plane, with height and age.

A cell is removed when pictures show what is behind it, or the floor under it. Cells out of view
stay until the odometry has drifted too far since they were seen.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_zenoh.vision.camera_model import CameraModel, Singles
from gigabrain_zenoh.vision.depth_picture import SIGMA_AT_1M, Mask

CELL_M = 0.025
OBSTACLE, HOLE, MISSING, COLOUR = range(4)  # kinds of cells
MAX_AGE_S = 120.0  # without being seen; later the thing may be gone
MAX_AGE_ONCE_S = 1.0  # of a cell that only one picture showed
DRIFT_PER_M, DRIFT_PER_RAD = 0.02, 0.02  # of odometry: per metre driven; per rad and metre away
MAX_DRIFT_M = 0.15  # since it was seen; planners' clearance is smaller
MAX_DISTANCE_M = 5.0  # from the robot
GONE_STRIKES = 3.0  # number of pictures that see through a removed cell; one for a new cell
BESIDE_STRIKES = 0.05  # for a picture that shows something just beside the cell
STEADY_POINTS = 3.0  # least pixels of a cell that counts in its first picture
CONFIRMED_PICTURES = 4.0  # a cell is confirmed after this many pictures
SHARES = (0.2, 0.45, 0.7)  # of its height, where a cell is checked
THROUGH_M = 0.02  # behind a cell, beyond noise
NEIGHBOURS = tuple((row, column) for row in (-1, 0, 1) for column in (-1, 0, 1))
MAX_CELLS = 8000  # the newest; a picture has at most some thousand
MIN_HALF_M = 0.004  # of a cell's box
KEY_SPAN = 1 << 20
CELLS = np.dtype(
    [
        ("key", "i8"),
        ("kind", "i8"),
        ("low", "f8", 2),  # [m], corner of the box that holds what was seen, in the odometry frame
        ("high", "f8", 2),
        ("bottom", "f8"),  # [m] above the floor
        ("top", "f8"),
        ("points", "f8"),  # pixels in the newest picture that showed it
        ("seen", "f8"),  # pictures that showed it
        ("strikes", "f8"),  # pictures that showed it empty, since
        ("stamp", "f8"),  # [s], when it was last seen
        ("driven", "f8"),  # [m] and
        ("turned", "f8"),  # [rad] of odometry until then
        ("track", "i8"),
    ]
)
Cells = NDArray[np.void]


@dataclass(frozen=True, slots=True)
class Picture:
    """Depth and floor of a picture, to find cells whose thing is gone."""

    model: CameraModel
    depth: Singles  # (height, width) [m]; 0 is unknown
    is_floor: Mask  # (height, width)
    floor: Floats  # (3,): offset and slopes of the floor in the body's frame


class CellMemory:
    """Occupied cells. Positions and times are those of the odometry."""

    def __init__(self) -> None:
        self.cells: Cells = np.empty(0, CELLS)
        self._pose: Pose | None = None
        self._driven = self._turned = self._now = 0.0

    def move(self, pose: Pose, now: float) -> None:
        """Set the robot's pose at `now` [s], and remove cells that are too old or too far away."""
        if self._pose:
            self._driven += math.hypot(pose.x - self._pose.x, pose.y - self._pose.y)
            self._turned += abs(math.remainder(pose.yaw - self._pose.yaw, math.tau))
        if now < self._now:  # another clock: ages would be wrong
            self.cells["stamp"] = np.minimum(self.cells["stamp"], now)
        self._pose, self._now = pose, now
        if not len(self.cells):
            return
        cells = self.cells
        middle = (cells["low"] + cells["high"]) / 2
        away = np.hypot(middle[:, 0] - pose.x, middle[:, 1] - pose.y)
        drift = DRIFT_PER_M * (self._driven - cells["driven"])
        drift += DRIFT_PER_RAD * (self._turned - cells["turned"]) * away
        kept = (
            (now - cells["stamp"] <= MAX_AGE_S) & (drift <= MAX_DRIFT_M) & (away <= MAX_DISTANCE_M)
        )
        kept &= (cells["seen"] > 1) | (now - cells["stamp"] <= MAX_AGE_ONCE_S)
        self.cells = cells[kept]

    def look(self, picture: Picture, kinds: tuple[int, ...]) -> None:
        """Strike cells of these kinds that a picture sees through. Call `move` before."""
        chosen = np.flatnonzero(np.isin(self.cells["kind"], kinds))
        if not len(chosen):
            return
        cells = self.cells[chosen]
        through, beside = self._seen_through(picture, cells)
        self.cells["strikes"][chosen] += np.where(through, 1.0, BESIDE_STRIKES * beside)
        self.cells["seen"][chosen] -= through & (cells["seen"] > 1)

    def _seen_through(self, picture: Picture, cells: Cells) -> tuple[Mask, Mask]:
        """Return masks of cells that a picture shows as empty, and as occupied."""
        flat = cells["kind"] != OBSTACLE
        middle = self.to_body((cells["low"] + cells["high"]) / 2)
        ground = picture.floor[0] + middle @ picture.floor[1:]
        free, held = np.zeros(len(cells), np.bool_), np.zeros(len(cells), np.bool_)
        for share in SHARES:
            height = cells["bottom"] + share * (cells["top"] - cells["bottom"])
            height = np.where(flat, 0.0, height) + ground
            through, there = _look_at(picture, np.column_stack((middle, height)), flat)
            free |= through
            held |= there
        return free & ~held, held

    def add(self, points: NDArray[np.floating], kind: int) -> None:
        """Add the newest picture's points (n, 3), x and y in the body's frame.

        The third value is the height above the floor [m]. Call `look` before.
        """
        new = self._binned(points, kind)
        place = np.searchsorted(self.cells["key"], new["key"])
        place = np.minimum(place, max(len(self.cells) - 1, 0))
        known = self.cells["key"][place] == new["key"] if len(self.cells) else np.zeros(0, bool)
        if len(self.cells):
            self._refresh(place[known], new[known])
            new = new[~known]
        cells = self.cells
        gone = cells["strikes"] >= np.where(cells["seen"] > 1, GONE_STRIKES, 1.0)
        gone &= cells["stamp"] < self._now
        if gone.any():
            cells = self.cells = cells[~gone]
        if not len(new):
            return
        cells = np.concatenate((cells, new))
        if len(cells) > MAX_CELLS:
            cells = cells[np.argsort(-cells["stamp"], kind="stable")[:MAX_CELLS]]
        self.cells = cells[np.argsort(cells["key"], kind="stable")]

    def _refresh(self, at: NDArray[np.intp], new: Cells) -> None:
        cells = self.cells
        for name in ("low", "high"):
            cells[name][at] += 0.5 * (new[name] - cells[name][at])
        cells["bottom"][at] = np.minimum(cells["bottom"][at], new["bottom"])
        cells["top"][at] = np.maximum(cells["top"][at], new["top"])
        cells["seen"][at] = np.minimum(cells["seen"][at] + 1, CONFIRMED_PICTURES)
        cells["strikes"][at] = 0.0
        for name in ("points", "stamp", "driven", "turned"):
            cells[name][at] = new[name]

    def _binned(self, points: NDArray[np.floating], kind: int) -> Cells:
        """Return one cell for all points within it."""
        places = self.to_odometry(points[:, :2])
        index = np.floor(places / CELL_M).astype(np.int64) + KEY_SPAN // 2
        key = (index[:, 0] * KEY_SPAN + index[:, 1]) * 4 + kind
        order = np.argsort(key)
        key, places = key[order], places[order]
        height = points[order, 2].astype(np.float64)
        first = np.flatnonzero(np.diff(key, prepend=-1))
        cells = np.zeros(len(first), CELLS)
        if not len(first):
            return cells
        count = np.diff(first, append=len(key))
        mean = np.add.reduceat(places, first) / count[:, None]
        spread = np.add.reduceat(places * places, first) / count[:, None] - mean * mean
        half = np.sqrt(3 * np.maximum(spread, 0.0))  # of a box evenly filled
        corner = ((key[first] // 4)[:, None] // (KEY_SPAN, 1) % KEY_SPAN - KEY_SPAN // 2) * CELL_M
        cells["low"] = np.minimum(np.maximum(mean - half, corner), mean - MIN_HALF_M)
        cells["high"] = np.maximum(np.minimum(mean + half, corner + CELL_M), mean + MIN_HALF_M)
        cells["key"], cells["kind"], cells["points"] = key[first], kind, count
        cells["bottom"] = np.minimum.reduceat(height, first)
        cells["top"] = np.maximum.reduceat(height, first)
        cells["seen"], cells["stamp"] = 1.0, self._now
        cells["driven"], cells["turned"] = self._driven, self._turned
        return cells

    def steady(self) -> Mask:
        """Return which cells most pictures show; pixels at edges show others only at times."""
        cells = self.cells
        doubts = np.where(cells["seen"] > 2, 2.0, 1.0)
        many = (cells["seen"] > 1) | (cells["points"] >= STEADY_POINTS)
        return np.asarray(many & (cells["strikes"] < doubts))

    def to_odometry(self, places: NDArray[np.floating]) -> Floats:
        """Transform (n, 2) from the body's frame to the odometry's."""
        x, y, cos, sin = self._placed()
        px, py = places[:, 0], places[:, 1]
        return np.column_stack((x + cos * px - sin * py, y + sin * px + cos * py))

    def to_body(self, places: Floats) -> Floats:
        """Transform (n, 2) from the odometry's frame to the body's."""
        x, y, cos, sin = self._placed()
        dx, dy = places[:, 0] - x, places[:, 1] - y
        return np.column_stack((cos * dx + sin * dy, cos * dy - sin * dx))

    @property
    def place(self) -> Floats:
        """Return the robot's position (2,), in the odometry frame [m]."""
        return np.array(self._placed()[:2])

    def _placed(self) -> tuple[float, float, float, float]:
        pose = self._pose or Pose(x=0.0, y=0.0, yaw=0.0)
        return pose.x, pose.y, math.cos(pose.yaw), math.sin(pose.yaw)


def _look_at(picture: Picture, points: Floats, flat: Mask) -> tuple[Mask, Mask]:
    """Return masks of points (n, 3) that a picture sees through, and that it sees.

    All pixels round a point must agree. On the floor (`flat`) only floor counts as empty.
    """
    row, column, away = picture.model.project(points)
    height, width = picture.depth.shape
    inside = (row > 0) & (column > 0) & (row < height - 1) & (column < width - 1)
    at = np.where(inside, row * width + column, width + 1)
    depth, is_floor = picture.depth.reshape(-1), picture.is_floor.reshape(-1)
    margin = THROUGH_M + 4 * SIGMA_AT_1M * away * away
    free = np.zeros(len(points), np.intp)
    there = np.zeros(len(points), np.bool_)
    hidden = np.zeros(len(points), np.bool_)
    for down, right in NEIGHBOURS:
        beside = at + (down * width + right)
        measured, floor = depth[beside], is_floor[beside]
        known = measured > 0
        through = known & (floor | ((measured > away + margin) & ~flat))
        free += through
        there |= known & ~through & (measured > away - margin)
        hidden |= known & ~through & (measured <= away - margin)
    empty = inside & (free > len(NEIGHBOURS) // 2) & ~there & ~hidden
    return empty, inside & there
