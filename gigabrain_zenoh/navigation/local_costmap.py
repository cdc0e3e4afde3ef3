"""Local costmap: a window around the robot that remembers recent lidar hits.

A hit marks a cell; two beams that pass it clear it. What no beam can check expires, as odometry
drifts. Distances are a 5 x 5 chamfer (Borgefors 1986), in a third of the time that
cv2.distanceTransform takes; it differs in the last bits.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS
from gigabrain_zenoh.kernels.images import connected_parts
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel
from gigabrain_zenoh.navigation.contours import covered
from gigabrain_zenoh.navigation.footprint import MAX_DISTANCE_M, DistanceGrid
from gigabrain_zenoh.navigation.zones import fill

RIM_CELLS = 2  # cells round the window, from which nothing is near
UNIT = 1 << 20  # of a cell
STRAIGHT, SLANT, KNIGHT = UNIT, round(1.4 * UNIT), round(2.1969 * UNIT)
UNREACHED = np.int32(1 << 29)
WORD, ALL_FREE = 8, np.uint64(0x0101010101010101)  # cells that are looked at together
FreeCells = NDArray[np.uint8]
Steps = NDArray[np.int32]
Singles = NDArray[np.float32]
Words = NDArray[np.uint64]

CELL_M = 0.025
BEARING_BINS = 720  # of the bearings round the lidar
MARK_LEVEL = 2  # of a cell that was just hit; each beam that passes takes one
BEYOND_M = 0.1  # [m], how far past a cell a beam must go to have passed it

DISC_MARGIN_M = 0.1  # [m], hits so near a moving thing are its own
LATE_TICKS = 10  # so much longer than it seems a disc may have been over a cell

STATIC_TICKS = 20  # a cell that was hit so long ago, and is now, belongs to what stands
MAX_STATIC_SHARE = 0.5  # share of its cells that may, of a thing that moves
RECENTER_SHARE = 0.05  # share of the window that the robot may be off its middle


class Chamfer:
    """Distances in windows of (side, side) cells of so many metres, `most` [m] at most."""

    def __init__(self, side: int, cell: float, most: float) -> None:
        self._steps = np.full(
            (side + 2 * RIM_CELLS, side + 2 * RIM_CELLS), UNREACHED, dtype=np.int32
        )
        self._cell, self._most = cell, most

    def distance(self, free: FreeCells) -> Singles:
        """Return the distance of each cell to the nearest 0 in `free`, by their centres [m]."""
        distance = np.empty(free.shape, dtype=np.float32)
        _chamfer(free, self._steps, np.float32(self._cell), np.float32(self._most), distance)
        return distance


@kernel
def _chamfer(
    free: FreeCells, steps: Steps, cell: np.float32, most: np.float32, distance: Singles
) -> None:
    """Fill `distance` by steps along rows first, then from row to row: their order is free."""
    rows, columns = free.shape
    for row in range(rows):
        here, cells = steps[row + RIM_CELLS, RIM_CELLS : RIM_CELLS + columns], free[row]
        words = cells[: columns // WORD * WORD].view(np.uint64)
        _along(cells, words, here)
        _from_beside(steps[row + 1], steps[row], here)
    unit = np.float32(1.0 / UNIT)
    for row in range(rows - 1, -1, -1):
        here, out = steps[row + RIM_CELLS, RIM_CELLS : RIM_CELLS + columns], distance[row]
        _from_beside(steps[row + RIM_CELLS + 1], steps[row + RIM_CELLS + 2], here)
        for column in range(columns):
            away = np.float32(here[column]) * unit * cell
            out[column] = away if away < most else most


@lean_kernel
def _along(cells: FreeCells, words: Words, here: Steps) -> None:
    """Fill `here` with the steps within a row to the nearest 0 in `cells`, also in `words`."""
    n, last = len(cells), -1
    for word in range(len(words) + 1):
        if word < len(words) and words[word] == ALL_FREE:
            continue
        for j in range(word * WORD, min(n, (word + 1) * WORD)):
            if not cells[j]:
                middle = (last + j + 1) // 2 if last >= 0 else 0
                if last >= 0:
                    _rise(here[last:middle])
                _fall(here[middle : j + 1])
                last = j
    if last >= 0:
        _rise(here[last:])
    else:
        here[:] = UNREACHED


@lean_kernel
def _rise(here: Steps) -> None:
    for k in range(len(here)):
        here[k] = np.int32(np.int32(k) * STRAIGHT)


@lean_kernel
def _fall(here: Steps) -> None:
    last = np.int32(len(here) - 1)
    for k in range(len(here)):
        here[k] = np.int32(np.int32(last - np.int32(k)) * STRAIGHT)


@lean_kernel
def _from_beside(beside: Steps, beyond: Steps, here: Steps) -> None:
    """Lower `here` by steps from the two rows on one side. Slices, and 32 bits: vectorised."""
    n = len(here)
    a, b, c, d, e = beside[:n], beside[1 : n + 1], beside[2 : n + 2], beside[3 : n + 3], beside[4:]
    f, g = beyond[1 : n + 1], beyond[3 : n + 3]
    for j in range(n):
        knight = np.int32(min(min(a[j], e[j]), min(f[j], g[j])) + KNIGHT)
        slant, straight = np.int32(min(b[j], d[j]) + SLANT), np.int32(c[j] + STRAIGHT)
        here[j] = min(min(here[j], straight), min(slant, knight))


class Pose2D(NamedTuple):
    """A pose in the frame that is planned in."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]


class WindowCells(NamedTuple):
    """The window as compiled functions take it, (rows, columns) each."""

    level: NDArray[np.uint8]  # 0 where nothing is
    seen: NDArray[np.int64]  # tick of the last hit
    since: NDArray[np.int64]  # tick of the first hit since it was last free
    x: float  # [m], of the corner of cell (0, 0)
    y: float


@kernel
def observe(
    cells: WindowCells,
    place: Pose2D,
    lidar: tuple[float, float],
    hits: Floats,
    ticks: tuple[int, int],
) -> None:
    """Mark the hits of a scan, clear cells that its beams have passed, and expire old ones.

    The `ticks` are that of the scan, and the oldest last hit of a cell that does not expire.
    """
    level, seen, (tick, oldest) = cells.level, cells.seen, ticks
    cosine, sine = math.cos(place.yaw), math.sin(place.yaw)
    eye_x = place.x + cosine * lidar[0] - sine * lidar[1]
    eye_y = place.y + sine * lidar[0] + cosine * lidar[1]
    reach = np.full(BEARING_BINS, -1.0)
    count = hits.shape[0]
    points = np.empty((count, 2))
    for i in range(count):
        x = place.x + cosine * hits[i, 0] - sine * hits[i, 1]
        y = place.y + sine * hits[i, 0] + cosine * hits[i, 1]
        points[i, 0], points[i, 1] = x, y
        k = _bin(x - eye_x, y - eye_y)
        r = math.hypot(x - eye_x, y - eye_y)
        if reach[k] < 0.0 or r < reach[k]:
            reach[k] = r
    (rows, columns), passed = level.shape, _passed(reach)
    for n in _marked(level):
        i, j = n // columns, n % columns
        x = cells.x + (j + 0.5) * CELL_M
        y = cells.y + (i + 0.5) * CELL_M
        if seen[i, j] < oldest:
            level[i, j] = 0
        elif math.hypot(x - eye_x, y - eye_y) + BEYOND_M < passed[_bin(x - eye_x, y - eye_y)]:
            level[i, j] -= 1
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        row = math.floor((y - cells.y) / CELL_M)
        column = math.floor((x - cells.x) / CELL_M)
        if 0 <= row < rows and 0 <= column < columns:
            if level[row, column] == 0:
                cells.since[row, column] = tick
            level[row, column] = MARK_LEVEL
            seen[row, column] = tick


@kernel
def _marked(level: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the indices of the marked cells (n,), row by row."""
    flat, count = level.reshape(-1), 0
    words = flat[: len(flat) // WORD * WORD].view(np.uint64)
    found = np.empty(len(flat), np.int64)
    for word in range(len(words) + 1):
        if word < len(words) and words[word] == 0:
            continue
        for n in range(word * WORD, min(len(flat), (word + 1) * WORD)):
            if flat[n]:
                found[count], count = n, count + 1
    return found[:count]


@kernel
def _bin(x: float, y: float) -> int:
    """Return the bearing bin of the direction (x, y), by a series that is faster than atan2.

    Abramowitz and Stegun, 4.4.47: to 1e-5 rad, a thousandth of a bin.
    """
    far, near = max(abs(x), abs(y), 1e-12), min(abs(x), abs(y))
    r = near / far
    s = r * r
    series = -0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))
    turn = r * (0.9998660 + s * series)
    turn = 0.5 * math.pi - turn if abs(y) > abs(x) else turn
    turn = math.pi - turn if x < 0.0 else turn
    turn = -turn if y < 0.0 else turn
    return math.floor((turn / math.tau + 0.5) * BEARING_BINS) % BEARING_BINS


@kernel
def _passed(reach: Floats) -> Floats:
    """Return the least range of the beams around each bin [m]; -1 where there are none."""
    passed = np.full(BEARING_BINS, -1.0)
    for k in range(BEARING_BINS):
        for n in (k - 1, k, k + 1):
            r, nearest = reach[n % BEARING_BINS], passed[k]
            if r >= 0.0 and (nearest < 0.0 or r < nearest):
                passed[k] = r
    return passed


@kernel
def stays(cells: WindowCells, disc: Floats, tick: int, long_ago: int) -> float:
    """Return the share of a disc's cells hit at `tick` that were hit `long_ago` already."""
    x, y, radius = disc[0], disc[1], disc[4] + DISC_MARGIN_M
    top, bottom, left, end = _box(cells, x, y, radius)
    hit = old = 0
    for i in range(top, bottom):
        down = cells.y + (i + 0.5) * CELL_M - y
        for j in range(left, end):
            near = math.hypot(cells.x + (j + 0.5) * CELL_M - x, down) <= radius
            if near and cells.level[i, j] > 0 and cells.seen[i, j] == tick:
                hit += 1
                old += cells.since[i, j] <= long_ago
    return old / hit if hit else 0.0


@kernel
def take_back(cells: WindowCells, disc: Floats, tick: int) -> None:
    """Free the cells that were first hit after `disc` had come to be over them."""
    x, y, vx, vy, radius = disc[0], disc[1], disc[2], disc[3], disc[4] + DISC_MARGIN_M
    square, (top, bottom, left, end) = max(vx * vx + vy * vy, 1e-6), _box(cells, x, y, radius)
    for i in range(top, bottom):
        down = cells.y + (i + 0.5) * CELL_M - y
        for j in range(left, end):
            right = cells.x + (j + 0.5) * CELL_M - x
            inside, along = radius**2 - right**2 - down**2, right * vx + down * vy
            if inside >= 0.0 and cells.level[i, j] > 0:
                ago = (math.sqrt(along**2 + square * inside) - along) / square * 1e9 / TICK_NS
                if cells.since[i, j] >= tick - ago - LATE_TICKS:
                    cells.level[i, j] = 0


@kernel
def _box(cells: WindowCells, x: float, y: float, radius: float) -> tuple[int, int, int, int]:
    """Return the cells that a disc may touch: first row, row after the last; same of columns."""
    rows, columns = cells.level.shape
    top, bottom = (y - radius - cells.y) / CELL_M, (y + radius - cells.y) / CELL_M
    left, end = (x - radius - cells.x) / CELL_M, (x + radius - cells.x) / CELL_M
    return (
        max(0, int(top)),
        min(rows, int(bottom) + 1),
        max(0, int(left)),
        min(columns, int(end) + 1),
    )


class LocalCostmap:
    """A square of `size` [m] round the robot, its axes those of the frame that is planned in."""

    def __init__(self, size: float, memory_s: float) -> None:
        self.cells = 2 * round(size / CELL_M / 2)
        self._chamfer = Chamfer(self.cells, CELL_M, MAX_DISTANCE_M)
        self._memory = round(memory_s * 1e9 / TICK_NS)
        self._held, self._spare = _nothing(self.cells), _nothing(self.cells)
        self._row = self._column = 0  # of cell (0, 0), counted from the frame's origin
        self._empty = True

    @property
    def x(self) -> float:
        """The corner of the window [m]."""
        return self._column * CELL_M

    @property
    def y(self) -> float:
        """The corner of the window [m]."""
        return self._row * CELL_M

    def see(self, tick: int, place: Pose2D, lidar: tuple[float, float], hits: Floats) -> None:
        """Take in a scan: `hits` (n, 2) [m] in the body's frame, the `lidar` at (x, y) in it."""
        self._follow(place)
        observe(self._held, place, lidar, hits, (tick, tick - self._memory))

    def moving(self, tick: int, discs: Floats) -> Floats:
        """Return the `discs` (n, 6), with x, y [m] first and the radius fifth, that really move.

        A moving disc hits cells that were free a moment ago. Posts and corners mistaken for one
        another seem to move, but keep hitting the same cells.
        """
        if not len(discs):
            return discs
        held, long_ago = self._held, tick - STATIC_TICKS
        return discs[[stays(held, disc, tick, long_ago) <= MAX_STATIC_SHARE for disc in discs]]

    def take_back(self, tick: int, discs: Floats) -> None:
        """Free what each of `discs` (n, 6) covered on its way here: nothing stands there."""
        for disc in discs:
            take_back(self._held, disc, tick)

    def grid(
        self,
        tick: int,
        known: Floats,
        moving: Floats,
        keepouts: Sequence[Floats] = (),
        body: Floats | None = None,
        contours: Sequence[Floats] = (),
    ) -> DistanceGrid:
        """Return distances to the nearest obstacle, seen or among the `known` points (n, 2) [m].

        Recent hits on one of the discs `moving` do not count: it will be elsewhere soon. Polygons
        `keepouts` and `contours` (m, 2) [m] are obstacles; those that a point of the `body` (k, 2)
        [m] is in only where it would be farther inside. So it can leave, and sees the obstacles in
        there.
        """
        free = (self._held.level == 0).view(np.uint8)
        if len(moving):
            near = np.zeros_like(free)
            for x, y, radius in moving[:, [0, 1, 4]].tolist():
                column, row = round((x - self.x) / CELL_M), round((y - self.y) / CELL_M)
                fill_disc(near, row, column, math.ceil((radius + DISC_MARGIN_M) / CELL_M))
            free |= near & (self._held.since > tick - STATIC_TICKS)
        if len(known):
            cells = np.floor((known - (self.x, self.y)) / CELL_M).astype(np.int64)
            cells = cells[((cells >= 0) & (cells < self.cells)).all(axis=1)]
            free[cells[:, 1], cells[:, 0]] = 0
        if len(keepouts) or len(contours):
            free[self._keep_out(keepouts, contours, body)] = 0
        return DistanceGrid(self._chamfer.distance(free), CELL_M, self.x, self.y)

    def _keep_out(
        self, keepouts: Sequence[Floats], contours: Sequence[Floats], body: Floats | None
    ) -> NDArray[np.bool_]:
        """Return the cells (side, side) that zones and contours keep the body out of."""
        zones = np.zeros((self.cells, self.cells), np.uint8)
        for corners in keepouts:
            fill(zones, (corners - (self.x, self.y)) / CELL_M, 1)
        if len(contours):
            seen = [(corners - (self.x, self.y)) / CELL_M for corners in contours]
            zones[covered(seen, self.cells)] = 1
        if body is None:
            return zones > 0
        at = np.floor((body - (self.x, self.y)) / CELL_M).astype(np.int64).clip(0, self.cells - 1)
        rows, columns = at[:, 1], at[:, 0]
        if not zones[rows, columns].any():
            return zones > 0
        entered = _parts_at(zones > 0, rows * self.cells + columns)
        depth = self._chamfer.distance(zones)
        deepest = depth[rows, columns].max() + CELL_M
        keep_out: NDArray[np.bool_] = (zones > 0) & (~entered | (depth > deepest))
        return keep_out

    def _follow(self, place: Pose2D) -> None:
        """Keep the robot in the middle; what leaves the window is forgotten."""
        half = self.cells // 2
        row = math.floor(place.y / CELL_M) - half
        column = math.floor(place.x / CELL_M) - half
        down, right = row - self._row, column - self._column
        if max(abs(down), abs(right)) <= RECENTER_SHARE * self.cells and not self._empty:
            return
        _carry(self._held, self._spare, down, right)
        self._row, self._column, self._empty = row, column, False
        self._held, self._spare = self._spare._replace(x=self.x, y=self.y), self._held


def fill_disc(cells: FreeCells, row: int, column: int, radius: int) -> None:
    """Set the cells within `radius` cells of one, as far as they are there."""
    top, left = max(row - radius, 0), max(column - radius, 0)
    part = cells[top : max(row + radius + 1, 0), left : max(column + radius + 1, 0)]
    y = np.arange(part.shape[0])[:, None] + top - row
    x = np.arange(part.shape[1]) + left - column
    part[x * x + y * y <= radius * radius] = 1


def _parts_at(mask: NDArray[np.bool_], indices: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return those connected parts of `mask` (h, w) that hold one of the cells `indices` (n,)."""
    cells, begins = connected_parts(mask)
    found = np.zeros(mask.size, np.bool_)
    for begin, end in itertools.pairwise(begins.tolist()):
        if np.isin(cells[begin:end], indices).any():
            found[cells[begin:end]] = True
    return found.reshape(mask.shape)


def _nothing(side: int) -> WindowCells:
    ticks = np.zeros((2, side, side), dtype=np.int64)
    return WindowCells(np.zeros((side, side), dtype=np.uint8), ticks[0], ticks[1], 0.0, 0.0)


def _carry(cells: WindowCells, to: WindowCells, down: int, right: int) -> None:
    """Fill `to` with what a window over `cells` sees that has moved on by so many of them."""
    side = len(cells.level)
    at = np.array(divmod(_marked(cells.level), side))
    then = at - np.array([[down], [right]])
    stays = ((then >= 0) & (then < side)).all(axis=0)
    (i, j), (row, column) = at[:, stays], then[:, stays]
    to.level.fill(0)
    to.level[row, column] = cells.level[i, j]
    to.seen[row, column], to.since[row, column] = cells.seen[i, j], cells.since[i, j]
