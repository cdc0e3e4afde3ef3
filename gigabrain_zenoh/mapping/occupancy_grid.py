"""Occupancy grid in log-odds, and the scans that it is drawn from.

Thrun, Burgard, Fox: Probabilistic Robotics, chapter 9. Log-odds are tenths and bounded, so that
newer scans outweigh older ones. A cell changes once per scan; hits take precedence.
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
HIT, PASS = 9, -5  # tenths of log-odds: one hit is 0.71, one beam that goes on is 0.38
MAX_LOG_ODDS, MIN_LOG_ODDS = 35, -25  # no surer than 0.97 and 0.08
GROWTH = 64  # cells; the grid grows by so many at least
MAX_CELLS = 2800  # along one side: a message of 8 MB holds no more
Cells = NDArray[np.int8]
Stamps = NDArray[np.int32]
ODDS = np.arange(-128, 128) / 10
PERCENT = np.round(100 / (1 + np.exp(-ODDS))).astype(np.int8)  # at log-odds + 128

APART_M, APART_RAD = 0.1, math.radians(10)  # nearer ones replace one another
SQUARE_M, SECTOR_RAD = 0.5, math.pi / 2  # a place, and a direction in which it is looked from
NEWEST = 3  # sweeps that stay of each of them
Place = tuple[int, int, int]


class LogOddsGrid:
    """Cells of `CELL` metres that grow with what is drawn."""

    def __init__(self) -> None:
        self.origin_x = self.origin_y = 0.0  # [m], the corner of cell (0, 0)
        self.log_odds: Cells = np.zeros((0, 0), np.int8)
        self._stamps: Stamps = np.zeros((0, 0), np.int32)  # the newest scan of each cell; 0: none
        self.scans = 0  # that were drawn
        self.full = False  # whether something was left out because the grid may grow no more

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
        held = copy.copy(self)
        held.log_odds, held._stamps = self.log_odds.copy(), self._stamps.copy()
        return held

    def draw(self, sensor: Floats, hits: Points, free: Points) -> None:
        """Draw one scan from `sensor`, a pose in the map; beams are in the sensor's frame.

        `hits` (n, 2) are the ends of beams [m], `free` (m, 2) how far other beams are known to be
        free.
        """
        ends, clear = transform(sensor, hits), transform(sensor, free)
        around = np.vstack((sensor[None, :2], ends, clear))
        self._cover(around.min(axis=0), around.max(axis=0), sensor[:2])
        self.scans += 1
        corner = np.array((self.origin_x, self.origin_y))
        start = ((sensor[:2] - corner) / CELL).astype(np.int64)
        cells, far = _cells(ends, corner), _cells(clear, corner)
        _draw(self.log_odds, self._stamps, self.scans, start, cells, far)

    def known(self) -> NDArray[np.bool_]:
        """Return which cells a beam has touched (height, width)."""
        return self._stamps > 0

    def percent(self) -> Cells:
        """Return the cells (height, width): 0 free to 100 occupied, -1 unknown."""
        shown = np.empty(self.log_odds.shape, np.int8)
        _show(self.log_odds, self._stamps, PERCENT, shown)
        return shown

    def around(self, x: float, y: float, reach: float) -> tuple[Cells, tuple[float, float]]:
        """Return `percent` of a square of `reach` [m] around a place, and its corner."""
        height, width = self.log_odds.shape
        left = min(max(int((x - reach - self.origin_x) / CELL), 0), width)
        low = min(max(int((y - reach - self.origin_y) / CELL), 0), height)
        side = int(2 * reach / CELL)
        part = np.s_[low : low + side, left : left + side]
        shown = np.empty(self.log_odds[part].shape, np.int8)
        _show(self.log_odds[part], self._stamps[part], PERCENT, shown)
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

    def _cover(self, low: Floats, high: Floats, sensor: Floats) -> None:
        """Grow until the rectangle from `low` to `high` [m] lies within, or up to the limit."""
        height, width = self.log_odds.shape
        if width == 0:
            corner = np.where(high - low < MAX_CELLS * CELL, low, sensor)
            self.origin_x, self.origin_y = (math.floor(v / CELL) * CELL for v in corner.tolist())
        (low_x, low_y), (high_x, high_y), (x, y) = low.tolist(), high.tolist(), sensor.tolist()
        left, right, narrow = _missing(low_x, high_x, x, self.origin_x, width)
        below, above, short = _missing(low_y, high_y, y, self.origin_y, height)
        self.full |= narrow or short
        if not (left or right or below or above):
            return
        room = ((below, above), (left, right))
        self.log_odds = np.pad(self.log_odds, room)
        self._stamps = np.pad(self._stamps, room)
        self.origin_x -= left * CELL
        self.origin_y -= below * CELL


def _missing(
    low: float, high: float, sensor: float, origin: float, count: int
) -> tuple[int, int, bool]:
    """Return how many cells to add before and after the existing ones, and if they do not suffice.

    Where not all may be added, those on both sides of the sensor are.
    """
    before = math.floor((origin - low) / CELL) + 1 if low < origin else 0
    after = max(math.floor((high - origin) / CELL) + 1 - count, 0)
    left, right, room = _rounded(before), _rounded(after), MAX_CELLS - count
    if left + right > room:
        middle = MAX_CELLS // 2 - math.floor((sensor - origin) / CELL)
        left = min(max(sorted((before, room - after, middle))[1], 0), room)
        right = room - left
    return left, right, before + after > room


def _rounded(cells: int) -> int:
    return math.ceil(cells / GROWTH) * GROWTH if cells > 0 else 0


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
            _pass(log_odds, stamps, stamp, (start[0], start[1]), (x, y))


@kernel
def _pass(
    log_odds: Cells, stamps: Stamps, stamp: int, start: tuple[int, int], end: tuple[int, int]
) -> None:
    """Free the cells from `start` (x, y) to before `end` (Bresenham's line)."""
    (height, width), (x, y), (end_x, end_y) = log_odds.shape, start, end
    across, up = abs(end_x - x), -abs(end_y - y)
    step_x, step_y = 1 if x < end_x else -1, 1 if y < end_y else -1
    off = across + up
    while x != end_x or y != end_y:
        if 0 <= x < width and 0 <= y < height and stamps[y, x] != stamp:
            stamps[y, x] = stamp
            log_odds[y, x] = max(log_odds[y, x] + PASS, MIN_LOG_ODDS)
        twice = 2 * off
        if twice >= up:
            off += up
            x += step_x
        if twice <= across:
            off += across
            y += step_y


@kernel
def _show(log_odds: Cells, stamps: Stamps, percent: Cells, shown: Cells) -> None:
    height, width = log_odds.shape
    for y in range(height):
        for x in range(width):
            shown[y, x] = percent[log_odds[y, x] + 128] if stamps[y, x] else -1


def warm_up() -> None:
    """Compile what a driving robot calls."""
    points, grid = np.array([[1.0, 0.0]], np.float32), LogOddsGrid()
    grid.draw(np.zeros(3), points, points)
    grid.percent()
    grid.around(0.0, 0.0, CELL)


@dataclass(frozen=True, slots=True)
class GridScan:
    """One scan that was drawn."""

    keyframe: int  # on which it hangs
    relative: Floats  # (3,), of the body in that keyframe's frame
    hits: Points  # (n, 2), in the body's frame [m]
    free: Points  # (m, 2)
    sensor: Floats  # (2,), where the beams start

    def draw(self, into: LogOddsGrid, keyframe: Floats) -> None:
        """Draw it, `keyframe` (3,) being in the map now."""
        pose = compose(keyframe, self.relative)
        beam = compose(pose, np.array((self.sensor[0], self.sensor[1], 0.0)))
        offset = self.sensor.astype(np.float32)
        into.draw(beam, self.hits - offset, self.free - offset)


class GridScans:
    """All drawn scans of a map, in the order in which they were taken."""

    def __init__(self) -> None:
        self._kept: dict[int, GridScan] = {}  # by their number
        self._at: dict[Place, list[int]] = defaultdict(list)  # numbers, the oldest first
        self._place: Floats | None = None  # in the map, of the newest that stays
        self._standing = False  # whether the last one gives way to the next
        self.seen = 0  # how many were added, but for those that gave way where the robot stood

    def __len__(self) -> int:
        return len(self._kept)

    def all(self) -> list[GridScan]:
        """Return the scans in the order in which they were added."""
        return list(self._kept.values())

    def add(self, view: View, keyframe: int, relative: Floats, pose: Floats) -> GridScan:
        """Add a scan seen from `pose` in the map; at rest it replaces the last."""
        sweep = GridScan(keyframe, relative, view.scan.points, view.scan.free, view.sensor)
        if self._standing:
            self._kept.popitem()
            self._kept[self.seen] = sweep
        else:
            numbers = self._keep(sweep, pose)
            while len(numbers) > NEWEST:
                del self._kept[numbers.pop(0)]
        self._standing = self._place is not None and not _apart(self._place, pose)
        if not self._standing:
            self._place = pose
        return sweep

    def _keep(self, sweep: GridScan, pose: Floats) -> list[int]:
        """Keep the sweep, and return the numbers of all that were seen from the same place."""
        self.seen += 1
        self._kept[self.seen] = sweep
        x, y, yaw = (pose / (SQUARE_M, SQUARE_M, SECTOR_RAD)).tolist()
        numbers = self._at[math.floor(x), math.floor(y), math.floor(yaw)]
        numbers.append(self.seen)
        return numbers

    def still(self) -> "GridScans":
        """Return a copy for `freeze`."""
        held = GridScans()
        held._kept, held.seen = dict(self._kept), self.seen
        return held

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
        on = arrays["sweep_keyframes"].astype(int)
        relative = arrays["sweep_relative"].astype(np.float64)
        if len(on) and not 0 <= on.min() <= on.max() < keyframes:
            raise ValueError(f"a sweep hangs on keyframe {on.max()} of {keyframes}")
        sensor = arrays["sweep_sensor"].astype(np.float64)
        for name, values, columns in (("poses", relative, 3), ("sensors", sensor, 2)):
            near = np.abs(values) <= REACH_M
            if values.shape != (len(on), columns) or not near.all():
                raise ValueError(f"{len(on)} sweeps, but {name} of shape {values.shape}")
        hits = split(arrays["sweep_hits"], arrays["sweep_hits_each"])
        free = split(arrays["sweep_free"], arrays["sweep_free_each"])
        rows = zip(on, relative, hits, free, sensor, strict=True)
        thawed = cls()
        for keyframe, *rest in rows:
            sweep = GridScan(int(keyframe), *rest)
            thawed._keep(sweep, compose(poses[sweep.keyframe], sweep.relative))
        return thawed


def _apart(one: Floats, other: Floats) -> bool:
    x, y, yaw = between(one, other).tolist()
    return math.hypot(x, y) > APART_M or abs(yaw) > APART_RAD
