"""The near surroundings: a grid that goes with the robot and remembers what its lidar saw of late.

A hit marks a cell. A beam that goes on past a marked cell takes it back in two scans, so that what
has moved leaves no ghost; what no beam can check is believed for a while, and not for ever, for
odometry drifts.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import TICK_NS
from gigabrain_zenoh.navigation.chamfer import Chamfer
from gigabrain_zenoh.navigation.footprint import FAR, Grid
from gigabrain_zenoh.navigation.window_cells import CELL_M, Cells, Floats, Place, observe
from gigabrain_zenoh.navigation.window_discs import ROUND_DISC, stays, take_back

STAYS_TICKS = 20  # a cell that was hit so long ago, and is now, belongs to what stands
MOST_STAY = 0.5  # share of its cells that may, of a thing that moves
MOVES_AT = 0.05  # share of the window that the robot may be off its middle


class Window:
    """A square of `size` [m] round the robot, its axes those of the frame that is planned in."""

    def __init__(self, size: float, memory_s: float) -> None:
        self.cells = 2 * round(size / CELL_M / 2)
        self._chamfer = Chamfer(self.cells, CELL_M, FAR)
        self._memory = round(memory_s * 1e9 / TICK_NS)
        self._held, self._spare = _nothing(self.cells), _nothing(self.cells)
        self._row = self._column = 0  # of cell (0, 0), counted from the frame's origin
        self._empty = True

    @property
    def x(self) -> float:
        """Where the window begins [m]."""
        return self._column * CELL_M

    @property
    def y(self) -> float:
        """Where the window begins [m]."""
        return self._row * CELL_M

    def see(self, tick: int, place: Place, lidar: tuple[float, float], hits: Floats) -> None:
        """Take in a scan: `hits` (n, 2) [m] in the body's frame, the `lidar` at (x, y) in it."""
        self._follow(place)
        observe(self._held, _marked(self._held), place, lidar, hits, tick, tick - self._memory)

    def moving(self, tick: int, discs: Floats) -> Floats:
        """Those of the `discs` (n, 6), x, y [m] first and the radius fifth, that really move.

        What moves hits cells that were free a moment ago. Posts and corners can be taken for one
        another, and then seem to move; but they keep hitting the same cells.
        """
        held, long_ago = self._held, tick - STAYS_TICKS
        return discs[[stays(held, disc, tick, long_ago) <= MOST_STAY for disc in discs]]

    def take_back(self, tick: int, discs: Floats) -> None:
        """Free what each of `discs` (n, 6) covered on its way here: nothing stands there."""
        for disc in discs:
            take_back(self._held, disc, tick)

    def grid(self, tick: int, known: Floats, moving: Floats) -> Grid:
        """The distance to the nearest obstacle, seen or among the `known` points (n, 2) [m].

        What was hit of late on one of the discs `moving` does not count: it will be elsewhere soon.
        """
        free = (self._held.level == 0).view(np.uint8)
        if len(moving):
            near = np.zeros_like(free)
            for x, y, radius in moving[:, [0, 1, 4]].tolist():
                at = round((x - self.x) / CELL_M), round((y - self.y) / CELL_M)
                cv2.circle(near, at, math.ceil((radius + ROUND_DISC) / CELL_M), 1, cv2.FILLED)
            free |= near & (self._held.since > tick - STAYS_TICKS)
        if len(known):
            cells = np.floor((known - (self.x, self.y)) / CELL_M).astype(np.int64)
            cells = cells[((cells >= 0) & (cells < self.cells)).all(axis=1)]
            free[cells[:, 1], cells[:, 0]] = 0
        return Grid(self._chamfer.distance(free), CELL_M, self.x, self.y)

    def _follow(self, place: Place) -> None:
        """Keep the robot in the middle; what leaves the window is forgotten."""
        half = self.cells // 2
        row = math.floor(place.y / CELL_M) - half
        column = math.floor(place.x / CELL_M) - half
        down, right = row - self._row, column - self._column
        if max(abs(down), abs(right)) <= MOVES_AT * self.cells and not self._empty:
            return
        _carry(self._held, self._spare, down, right)
        self._row, self._column, self._empty = row, column, False
        self._held, self._spare = self._spare._replace(x=self.x, y=self.y), self._held


def _nothing(side: int) -> Cells:
    ticks = np.zeros((2, side, side), dtype=np.int64)
    return Cells(np.zeros((side, side), dtype=np.uint8), ticks[0], ticks[1], 0.0, 0.0)


def _marked(cells: Cells) -> NDArray[np.int64]:
    """The marked cells (n,), counted along the rows: few of many."""
    return np.flatnonzero(cells.level > 0)


def _carry(cells: Cells, to: Cells, down: int, right: int) -> None:
    """Fill `to` with what a window over `cells` sees that has moved on by so many of them."""
    side = len(cells.level)
    at = np.array(divmod(_marked(cells), side))
    then = at - np.array([[down], [right]])
    stays = ((then >= 0) & (then < side)).all(axis=0)
    (i, j), (row, column) = at[:, stays], then[:, stays]
    to.level.fill(0)
    to.level[row, column] = cells.level[i, j]
    to.seen[row, column], to.since[row, column] = cells.seen[i, j], cells.since[i, j]
