"""Local costmap: a window around the robot that remembers recent lidar hits.

A hit marks a cell; two scans that see past it clear it. Marks that no beam can check expire, as
odometry drifts. Distances are those of a 5 x 5 chamfer (Borgefors 1986). It takes a third of the
time of cv2.distanceTransform, from which it differs in the last bits.
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

RIM_CELLS = 2  # unreached cells round the window, so that steps need no limits
UNIT = 1 << 20  # length of a cell in integer distances
STRAIGHT, SLANT, KNIGHT = UNIT, round(1.4 * UNIT), round(2.1969 * UNIT)
UNREACHED = np.int32(1 << 29)
WORD, ALL_FREE = 8, np.uint64(0x0101010101010101)  # cells that are compared at once
FreeCells = NDArray[np.uint8]
Steps = NDArray[np.int32]
Singles = NDArray[np.float32]
Words = NDArray[np.uint64]

CELL_M = 0.025
BEARING_BINS = 720  # round the lidar
MARK_LEVEL = 2  # of a cell at a hit; each scan whose beams pass it lowers it by one
BEYOND_M = 0.1  # a beam has passed a cell if it goes this far beyond

DISC_MARGIN_M = 0.1  # hits within this distance of a moving disc belong to it
LATE_TICKS = 10  # tolerance of the time at which a disc began to cover a cell

STATIC_TICKS = 20  # a cell that stays marked for this long belongs to a static obstacle
MAX_STATIC_SHARE = 0.5  # of the cells of a moving disc
RECENTER_SHARE = 0.05  # of the window, distance of the robot from its middle before it is moved


class Chamfer:
    """Distances in windows of (side, side) cells of size `cell` [m], `limit` [m] at most."""

    def __init__(self, side: int, cell: float, limit: float) -> None:
        self._steps = np.full(
            (side + 2 * RIM_CELLS, side + 2 * RIM_CELLS), UNREACHED, dtype=np.int32
        )
        self._cell, self._limit = cell, limit

    def distance(self, free: FreeCells) -> Singles:
        """Return the distance of each cell's centre to that of the nearest 0 in `free` [m]."""
        distance = np.empty(free.shape, dtype=np.float32)
        _chamfer(free, self._steps, np.float32(self._cell), np.float32(self._limit), distance)
        return distance


@kernel
def _chamfer(
    free: FreeCells, steps: Steps, cell: np.float32, limit: np.float32, distance: Singles
) -> None:
    """Fill `distance`, by steps within rows first, then from row to row."""
    rows, columns = free.shape
    for row in range(rows):
        here, cells = steps[row + RIM_CELLS, RIM_CELLS : RIM_CELLS + columns], free[row]
        words = cells[: columns // WORD * WORD].view(np.uint64)
        _fill_within_row(cells, words, here)
        _lower_from_rows(steps[row + 1], steps[row], here)
    unit = np.float32(1.0 / UNIT)
    for row in range(rows - 1, -1, -1):
        here, out = steps[row + RIM_CELLS, RIM_CELLS : RIM_CELLS + columns], distance[row]
        _lower_from_rows(steps[row + RIM_CELLS + 1], steps[row + RIM_CELLS + 2], here)
        for column in range(columns):
            away = np.float32(here[column]) * unit * cell
            out[column] = away if away < limit else limit


@lean_kernel
def _fill_within_row(cells: FreeCells, words: Words, here: Steps) -> None:
    """Fill `here` with the distance within a row to the nearest 0; `words` is a view of `cells`."""
    n, last = len(cells), -1
    for word in range(len(words) + 1):
        if word < len(words) and words[word] == ALL_FREE:
            continue
        for j in range(word * WORD, min(n, (word + 1) * WORD)):
            if not cells[j]:
                middle = (last + j + 1) // 2 if last >= 0 else 0
                if last >= 0:
                    _count_up(here[last:middle])
                _count_down(here[middle : j + 1])
                last = j
    if last >= 0:
        _count_up(here[last:])
    else:
        here[:] = UNREACHED


@lean_kernel
def _count_up(here: Steps) -> None:
    for k in range(len(here)):
        here[k] = np.int32(np.int32(k) * STRAIGHT)


@lean_kernel
def _count_down(here: Steps) -> None:
    last = np.int32(len(here) - 1)
    for k in range(len(here)):
        here[k] = np.int32(np.int32(last - np.int32(k)) * STRAIGHT)


@lean_kernel
def _lower_from_rows(beside: Steps, beyond: Steps, here: Steps) -> None:
    """Lower `here` by steps from the two rows on one side. Slices of int32 are vectorised."""
    n = len(here)
    a, b, c, d, e = beside[:n], beside[1 : n + 1], beside[2 : n + 2], beside[3 : n + 3], beside[4:]
    f, g = beyond[1 : n + 1], beyond[3 : n + 3]
    for j in range(n):
        knight = np.int32(min(min(a[j], e[j]), min(f[j], g[j])) + KNIGHT)
        slant, straight = np.int32(min(b[j], d[j]) + SLANT), np.int32(c[j] + STRAIGHT)
        here[j] = min(min(here[j], straight), min(slant, knight))


class Pose2D(NamedTuple):
    """A pose in the planning frame."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]


class WindowCells(NamedTuple):
    """The window for kernels, in arrays (rows, columns)."""

    level: NDArray[np.uint8]  # 0 in free cells
    seen: NDArray[np.int64]  # tick of the last hit
    since: NDArray[np.int64]  # tick of the first hit since the cell was free
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
    """Mark the hits of a scan, clear the cells that its beams pass, and expire old cells.

    `ticks` are the tick of the scan, and the oldest tick of a hit that does not expire.
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
    (rows, columns), passed = level.shape, _least_ranges(reach)
    for n in _marked_cells(level):
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
def _marked_cells(level: NDArray[np.uint8]) -> NDArray[np.int64]:
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
def _least_ranges(reach: Floats) -> Floats:
    """Return the least range of each bin and its neighbours [m]; -1 without beams."""
    passed = np.full(BEARING_BINS, -1.0)
    for k in range(BEARING_BINS):
        for n in (k - 1, k, k + 1):
            r, nearest = reach[n % BEARING_BINS], passed[k]
            if r >= 0.0 and (nearest < 0.0 or r < nearest):
                passed[k] = r
    return passed


@kernel
def static_share(cells: WindowCells, disc: Floats, tick: int, static_since: int) -> float:
    """Return the share of a disc's cells hit at `tick` that were marked by `static_since`."""
    x, y, radius = disc[0], disc[1], disc[4] + DISC_MARGIN_M
    top, bottom, left, end = _cells_around(cells, x, y, radius)
    hit = old = 0
    for i in range(top, bottom):
        down = cells.y + (i + 0.5) * CELL_M - y
        for j in range(left, end):
            near = math.hypot(cells.x + (j + 0.5) * CELL_M - x, down) <= radius
            if near and cells.level[i, j] > 0 and cells.seen[i, j] == tick:
                hit += 1
                old += cells.since[i, j] <= static_since
    return old / hit if hit else 0.0


@kernel
def clear_track(cells: WindowCells, disc: Floats, tick: int) -> None:
    """Free the cells that were first hit after `disc` began to cover them."""
    x, y, vx, vy, radius = disc[0], disc[1], disc[2], disc[3], disc[4] + DISC_MARGIN_M
    top, bottom, left, end = _cells_around(cells, x, y, radius)
    square = max(vx * vx + vy * vy, 1e-6)
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
def _cells_around(
    cells: WindowCells, x: float, y: float, radius: float
) -> tuple[int, int, int, int]:
    """Return the first row and the row after the last that a disc may touch, then the columns."""
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
    """A square of side `size` [m] round the robot, aligned with the planning frame."""

    def __init__(self, size: float, memory_s: float) -> None:
        self.cells = 2 * round(size / CELL_M / 2)
        self._chamfer = Chamfer(self.cells, CELL_M, MAX_DISTANCE_M)
        self._memory = round(memory_s * 1e9 / TICK_NS)
        self._window, self._spare = _empty_window(self.cells), _empty_window(self.cells)
        self._row = self._column = 0  # of the window's first cell, counted from the frame's origin
        self._empty = True

    @property
    def x(self) -> float:
        """The lower x of the window [m]."""
        return self._column * CELL_M

    @property
    def y(self) -> float:
        """The lower y of the window [m]."""
        return self._row * CELL_M

    def add_scan(self, tick: int, place: Pose2D, lidar: tuple[float, float], hits: Floats) -> None:
        """Add a scan: `hits` (n, 2) [m] and position (x, y) of the `lidar` in the body's frame."""
        self._move_window(place)
        observe(self._window, place, lidar, hits, (tick, tick - self._memory))

    def moving(self, tick: int, discs: Floats) -> Floats:
        """Return the `discs` (n, 6) that really move: x, y [m] in columns 0, 1, radius in 4.

        A moving disc marks cells that were free a moment ago. Posts and corners that are mistaken
        for one another seem to move, but mark the same cells in each scan.
        """
        if not len(discs):
            return discs
        held, static_since = self._window, tick - STATIC_TICKS
        return discs[
            [static_share(held, disc, tick, static_since) <= MAX_STATIC_SHARE for disc in discs]
        ]

    def clear_tracks(self, tick: int, discs: Floats) -> None:
        """Free the cells that each of `discs` (n, 6) marked on its way."""
        for disc in discs:
            clear_track(self._window, disc, tick)

    def grid(
        self,
        tick: int,
        known: Floats,
        moving: Floats,
        keepouts: Sequence[Floats] = (),
        body: Floats | None = None,
        contours: Sequence[Floats] = (),
    ) -> DistanceGrid:
        """Return distances to the nearest mark or `known` point (n, 2) [m].

        Recent hits on discs `moving` do not count, as they move on. Polygons `keepouts` and
        `contours` (m, 2) [m] are obstacles. If points of the `body` (k, 2) [m] are inside one, only
        the cells that are deeper inside count. So the body can leave, and avoids obstacles inside.
        """
        free = (self._window.level == 0).view(np.uint8)
        if len(moving):
            near = np.zeros_like(free)
            for x, y, radius in moving[:, [0, 1, 4]].tolist():
                column, row = round((x - self.x) / CELL_M), round((y - self.y) / CELL_M)
                fill_disc(near, row, column, math.ceil((radius + DISC_MARGIN_M) / CELL_M))
            free |= near & (self._window.since > tick - STATIC_TICKS)
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
        """Return the cells (side, side) of zones and contours that the body must not enter."""
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

    def _move_window(self, place: Pose2D) -> None:
        """Move the window with the robot, and forget cells outside."""
        half = self.cells // 2
        row = math.floor(place.y / CELL_M) - half
        column = math.floor(place.x / CELL_M) - half
        down, right = row - self._row, column - self._column
        if max(abs(down), abs(right)) <= RECENTER_SHARE * self.cells and not self._empty:
            return
        _copy_moved(self._window, self._spare, down, right)
        self._row, self._column, self._empty = row, column, False
        self._window, self._spare = self._spare._replace(x=self.x, y=self.y), self._window


def fill_disc(cells: FreeCells, row: int, column: int, radius: int) -> None:
    """Set the cells within `radius` cells of (row, column) to 1."""
    top, left = max(row - radius, 0), max(column - radius, 0)
    part = cells[top : max(row + radius + 1, 0), left : max(column + radius + 1, 0)]
    y = np.arange(part.shape[0])[:, None] + top - row
    x = np.arange(part.shape[1]) + left - column
    part[x * x + y * y <= radius * radius] = 1


def _parts_at(mask: NDArray[np.bool_], indices: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return the connected parts of `mask` (h, w) that contain one of the cells `indices` (n,)."""
    cells, begins = connected_parts(mask)
    found = np.zeros(mask.size, np.bool_)
    for begin, end in itertools.pairwise(begins.tolist()):
        if np.isin(cells[begin:end], indices).any():
            found[cells[begin:end]] = True
    return found.reshape(mask.shape)


def _empty_window(side: int) -> WindowCells:
    ticks = np.zeros((2, side, side), dtype=np.int64)
    return WindowCells(np.zeros((side, side), dtype=np.uint8), ticks[0], ticks[1], 0.0, 0.0)


def _copy_moved(cells: WindowCells, to: WindowCells, down: int, right: int) -> None:
    """Fill `to` with `cells`, after the window has moved by `down` rows and `right` columns."""
    side = len(cells.level)
    at = np.array(divmod(_marked_cells(cells.level), side))
    then = at - np.array([[down], [right]])
    inside = ((then >= 0) & (then < side)).all(axis=0)
    (i, j), (row, column) = at[:, inside], then[:, inside]
    to.level.fill(0)
    to.level[row, column] = cells.level[i, j]
    to.seen[row, column], to.since[row, column] = cells.seen[i, j], cells.since[i, j]
