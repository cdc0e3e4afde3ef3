"""Occupancy grid in log-odds, and the scans that it is drawn from.

Thrun, Burgard, Fox: Probabilistic Robotics, chapter 9. Log-odds are tenths and bounded, so that
newer scans outweigh older ones. A cell changes once per scan; a hit overrides passing beams.
"""

import copy
import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.geometry.se2 import between, compose, transform
from gigabrain_zenoh.kernels.jit import kernel
from gigabrain_zenoh.mapping.keyframes import REACH_M, Points, View, split

CELL = 0.05  # [m]
HIT, PASS = 9, -5  # tenths of log-odds: a hit means 0.71, a passing beam 0.38
MAX_LOG_ODDS, MIN_LOG_ODDS = 35, -25  # 0.97 and 0.08
GROWTH_CELLS = 64  # the grid grows by multiples of it
MAX_CELLS = 2800  # per side, for a message of 8 MB
Cells = NDArray[np.int8]
Stamps = NDArray[np.int32]
ODDS = np.arange(-128, 128) / 10
PERCENT = np.round(100 / (1 + np.exp(-ODDS))).astype(np.int8)  # at log-odds + 128

MIN_APART_M, MIN_APART_RAD = 0.1, math.radians(10)  # a sweep after less motion replaces the last
SQUARE_M, SECTOR_RAD = 0.5, math.pi / 2  # size of a place
MAX_SWEEPS_PER_PLACE = 3
Place = tuple[int, int, int]  # square in x and y, and sector of yaw


class LogOddsGrid:
    """Log-odds in cells of `CELL` metres. It grows with the drawn scans."""

    def __init__(self) -> None:
        self.origin_x = self.origin_y = 0.0  # [m], the corner of cell (0, 0)
        self.log_odds: Cells = np.zeros((0, 0), np.int8)
        self._stamps: Stamps = np.zeros((0, 0), np.int32)  # the newest scan of each cell; 0: none
        self.scans = 0  # number of drawn scans
        self.full = False  # the grid may not grow, and some beams were left out

    @classmethod
    def of(
        cls, log_odds: Cells, known: NDArray[np.bool_], origin: tuple[float, float]
    ) -> "LogOddsGrid":
        """Restore a saved grid."""
        grid = cls()
        grid.origin_x, grid.origin_y = origin
        grid.log_odds = np.array(log_odds, np.int8)
        grid._stamps, grid.scans = known.astype(np.int32), 1
        return grid

    def still(self) -> "LogOddsGrid":
        """Return a copy."""
        copied = copy.copy(self)
        copied.log_odds, copied._stamps = self.log_odds.copy(), self._stamps.copy()
        return copied

    def draw(self, sensor: Floats, hits: Points, free: Points) -> None:
        """Draw one scan from `sensor`, a pose in the map; beams are in the sensor's frame.

        `hits` (n, 2) are ends of beams [m]; `free` (m, 2) are free ends of other beams.
        """
        ends, clear = transform(sensor, hits), transform(sensor, free)
        around = np.vstack((sensor[None, :2], ends, clear))
        self._grow(around.min(axis=0), around.max(axis=0), sensor[:2])
        self.scans += 1
        corner = np.array((self.origin_x, self.origin_y))
        start = ((sensor[:2] - corner) / CELL).astype(np.int64)
        cells, far = _cells(ends, corner), _cells(clear, corner)
        _draw(self.log_odds, self._stamps, self.scans, start, cells, far)

    def known(self) -> NDArray[np.bool_]:
        """Return the cells that beams have touched (height, width)."""
        return self._stamps > 0

    def percent(self) -> Cells:
        """Return the cells (height, width): 0 free to 100 occupied, -1 unknown."""
        shown = np.empty(self.log_odds.shape, np.int8)
        _to_percent(self.log_odds, self._stamps, PERCENT, shown)
        return shown

    def around(self, x: float, y: float, reach: float) -> tuple[Cells, tuple[float, float]]:
        """Return `percent` of a square, `reach` [m] to each side of (x, y), and its corner."""
        height, width = self.log_odds.shape
        left = min(max(int((x - reach - self.origin_x) / CELL), 0), width)
        low = min(max(int((y - reach - self.origin_y) / CELL), 0), height)
        side = int(2 * reach / CELL)
        part = np.s_[low : low + side, left : left + side]
        shown = np.empty(self.log_odds[part].shape, np.int8)
        _to_percent(self.log_odds[part], self._stamps[part], PERCENT, shown)
        return shown, (self.origin_x + left * CELL, self.origin_y + low * CELL)

    def message(self) -> OccupancyGrid:
        """Return the grid as a message."""
        height, width = self.log_odds.shape
        return OccupancyGrid(
            resolution=CELL,
            width=width,
            height=height,
            origin_x=self.origin_x,
            origin_y=self.origin_y,
            cells=self.percent().tobytes(),
        )

    def _grow(self, low: Floats, high: Floats, sensor: Floats) -> None:
        """Grow until the rectangle from `low` to `high` [m] fits, or up to the limit."""
        height, width = self.log_odds.shape
        if width == 0:
            corner = np.where(high - low < MAX_CELLS * CELL, low, sensor)
            self.origin_x, self.origin_y = (math.floor(v / CELL) * CELL for v in corner.tolist())
        (low_x, low_y), (high_x, high_y), (x, y) = low.tolist(), high.tolist(), sensor.tolist()
        left, right, too_wide = _cells_to_add(low_x, high_x, x, self.origin_x, width)
        below, above, too_high = _cells_to_add(low_y, high_y, y, self.origin_y, height)
        self.full |= too_wide or too_high
        if not (left or right or below or above):
            return
        padding = ((below, above), (left, right))
        self.log_odds = np.pad(self.log_odds, padding)
        self._stamps = np.pad(self._stamps, padding)
        self.origin_x -= left * CELL
        self.origin_y -= below * CELL


def _cells_to_add(
    low: float, high: float, sensor: float, origin: float, count: int
) -> tuple[int, int, bool]:
    """Return the numbers of cells to add before and after, and whether they are too few.

    If not all may be added, those near the sensor are.
    """
    before = math.floor((origin - low) / CELL) + 1 if low < origin else 0
    after = max(math.floor((high - origin) / CELL) + 1 - count, 0)
    left, right, free_cells = _round_up(before), _round_up(after), MAX_CELLS - count
    if left + right > free_cells:
        middle = MAX_CELLS // 2 - math.floor((sensor - origin) / CELL)
        left = min(max(sorted((before, free_cells - after, middle))[1], 0), free_cells)
        right = free_cells - left
    return left, right, before + after > free_cells


def _round_up(cells: int) -> int:
    return math.ceil(cells / GROWTH_CELLS) * GROWTH_CELLS if cells > 0 else 0


def _cells(points: Floats, corner: Floats) -> NDArray[np.int64]:
    """Return the cells (n, 2) of `points` [m] as x, y."""
    return np.floor((points - corner) / CELL).astype(np.int64)


@kernel
def _draw(
    log_odds: Cells,
    stamps: Stamps,
    stamp: int,
    start: NDArray[np.int64],
    hits: NDArray[np.int64],
    free: NDArray[np.int64],
) -> None:
    height, width = log_odds.shape
    for x, y in hits:
        if 0 <= x < width and 0 <= y < height and stamps[y, x] != stamp:
            stamps[y, x] = stamp
            log_odds[y, x] = min(log_odds[y, x] + HIT, MAX_LOG_ODDS)
    for ends in (hits, free):
        for x, y in ends:
            _draw_beam(log_odds, stamps, stamp, (start[0], start[1]), (x, y))


@kernel
def _draw_beam(
    log_odds: Cells, stamps: Stamps, stamp: int, start: tuple[int, int], end: tuple[int, int]
) -> None:
    """Free the cells from `start` (x, y) up to but not including `end` (Bresenham's line)."""
    (height, width), (x, y), (end_x, end_y) = log_odds.shape, start, end
    across, up = abs(end_x - x), -abs(end_y - y)
    step_x, step_y = 1 if x < end_x else -1, 1 if y < end_y else -1
    error = across + up
    while x != end_x or y != end_y:
        if 0 <= x < width and 0 <= y < height and stamps[y, x] != stamp:
            stamps[y, x] = stamp
            log_odds[y, x] = max(log_odds[y, x] + PASS, MIN_LOG_ODDS)
        twice = 2 * error
        if twice >= up:
            error += up
            x += step_x
        if twice <= across:
            error += across
            y += step_y


@kernel
def _to_percent(log_odds: Cells, stamps: Stamps, percent: Cells, shown: Cells) -> None:
    height, width = log_odds.shape
    for y in range(height):
        for x in range(width):
            shown[y, x] = percent[log_odds[y, x] + 128] if stamps[y, x] else -1


def warm_up() -> None:
    """Compile the kernels that a driving robot calls."""
    points, grid = np.array([[1.0, 0.0]], np.float32), LogOddsGrid()
    grid.draw(np.zeros(3), points, points)
    grid.percent()
    grid.around(0.0, 0.0, CELL)


@dataclass(frozen=True, slots=True)
class GridScan:
    """One drawn scan, a sweep."""

    keyframe: int  # that moves it
    relative: Floats  # (3,), of the body in that keyframe's frame
    hits: Points  # (n, 2), in the body's frame [m]
    free: Points  # (m, 2)
    sensor: Floats  # (2,), where the beams start

    def draw(self, into: LogOddsGrid, keyframe: Floats) -> None:
        """Draw the scan; `keyframe` (3,) is the present pose of its keyframe."""
        pose = compose(keyframe, self.relative)
        beam = compose(pose, np.array((self.sensor[0], self.sensor[1], 0.0)))
        offset = self.sensor.astype(np.float32)
        into.draw(beam, self.hits - offset, self.free - offset)


class GridScans:
    """The sweeps of a map, in order of time."""

    def __init__(self) -> None:
        self._sweeps: dict[int, GridScan] = {}  # by number
        self._numbers_by_place: dict[Place, list[int]] = defaultdict(list)  # oldest first
        self._last_pose: Floats | None = None  # (3,) in the map, of the newest sweep that stays
        self._at_rest = False  # the next sweep replaces the last
        self.seen = 0  # number of added sweeps, without those that were replaced at rest

    def __len__(self) -> int:
        return len(self._sweeps)

    def all(self) -> list[GridScan]:
        """Return the sweeps in order of time."""
        return list(self._sweeps.values())

    def add(self, view: View, keyframe: int, relative: Floats, pose: Floats) -> GridScan:
        """Add a scan from `pose` (3,) in the map; at rest it replaces the last."""
        sweep = GridScan(keyframe, relative, view.scan.points, view.scan.free, view.sensor)
        if self._at_rest:
            self._sweeps.popitem()
            self._sweeps[self.seen] = sweep
        else:
            numbers = self._append(sweep, pose)
            while len(numbers) > MAX_SWEEPS_PER_PLACE:
                del self._sweeps[numbers.pop(0)]
        self._at_rest = self._last_pose is not None and not _has_moved(self._last_pose, pose)
        if not self._at_rest:
            self._last_pose = pose
        return sweep

    def _append(self, sweep: GridScan, pose: Floats) -> list[int]:
        """Add the sweep, and return the numbers of all sweeps of its place."""
        self.seen += 1
        self._sweeps[self.seen] = sweep
        x, y, yaw = (pose / (SQUARE_M, SQUARE_M, SECTOR_RAD)).tolist()
        numbers = self._numbers_by_place[math.floor(x), math.floor(y), math.floor(yaw)]
        numbers.append(self.seen)
        return numbers

    def still(self) -> "GridScans":
        """Return a copy for `freeze`."""
        copied = GridScans()
        copied._sweeps, copied.seen = dict(self._sweeps), self.seen
        return copied

    def freeze(self) -> dict[str, NDArray[Any]]:
        """Return all scans as arrays, to be saved."""
        empty, kept = np.empty((0, 2), np.float32), self.all()
        return {
            "sweep_keyframes": np.array([one.keyframe for one in kept], np.int32),
            "sweep_relative": np.array([one.relative for one in kept]).reshape(-1, 3),
            "sweep_sensor": np.array([one.sensor for one in kept]).reshape(-1, 2),
            "sweep_hits": np.concatenate([empty, *(one.hits for one in kept)]),
            "sweep_hits_each": np.array([len(one.hits) for one in kept], np.int32),
            "sweep_free": np.concatenate([empty, *(one.free for one in kept)]),
            "sweep_free_each": np.array([len(one.free) for one in kept], np.int32),
        }

    @classmethod
    def thaw(cls, arrays: Mapping[str, NDArray[Any]], poses: Floats) -> "GridScans":
        """Restore saved scans, with keyframes at `poses` (n, 3) in the map.

        Raises KeyError or ValueError if the arrays do not belong together.
        """
        keyframes = len(poses)
        keyframe_ids = arrays["sweep_keyframes"].astype(int)
        relative = arrays["sweep_relative"].astype(np.float64)
        if len(keyframe_ids) and not 0 <= keyframe_ids.min() <= keyframe_ids.max() < keyframes:
            raise ValueError(f"a sweep hangs on keyframe {keyframe_ids.max()} of {keyframes}")
        sensor = arrays["sweep_sensor"].astype(np.float64)
        for name, values, columns in (("poses", relative, 3), ("sensors", sensor, 2)):
            near = np.abs(values) <= REACH_M
            if values.shape != (len(keyframe_ids), columns) or not near.all():
                raise ValueError(f"{len(keyframe_ids)} sweeps, but {name} of shape {values.shape}")
        hits = split(arrays["sweep_hits"], arrays["sweep_hits_each"])
        free = split(arrays["sweep_free"], arrays["sweep_free_each"])
        rows = zip(keyframe_ids, relative, hits, free, sensor, strict=True)
        thawed = cls()
        for keyframe, *rest in rows:
            sweep = GridScan(int(keyframe), *rest)
            thawed._append(sweep, compose(poses[sweep.keyframe], sweep.relative))
        return thawed


def _has_moved(one: Floats, other: Floats) -> bool:
    x, y, yaw = between(one, other).tolist()
    return math.hypot(x, y) > MIN_APART_M or abs(yaw) > MIN_APART_RAD
