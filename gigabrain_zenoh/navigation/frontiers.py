"""Where known space ends and unknown begins: the next place to explore."""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.navigation.costmap import LETHAL, Costmap
from gigabrain_zenoh.navigation.planner import Point
from gigabrain_zenoh.navigation.search import Floats, Search

TAKEN = 0.5  # [m]: what is nearer to a place of the blacklist does not count
GAIN = 1.0  # a metre of frontier is worth a metre of way
MOST = 4.0  # [m] of frontier count


@dataclass(frozen=True, kw_only=True)
class Frontier:
    """A piece of the edge of the known, as wide as the body, and reachable through the known."""

    x: float  # [m], of its cell nearest to its middle
    y: float  # [m]
    size: float  # [m]
    cost: float  # [m in the open] to get there

    @property
    def score(self) -> float:
        """The lower the better."""
        return self.cost - GAIN * min(self.size, MOST)


def next_frontier(
    costmap: Costmap, robot: Point, blacklist: Iterable[Point], search: Search
) -> Frontier | None:
    """The best frontier; None when all is mapped that can be reached.

    In the blacklist is where the robot could not get to, and where it has been: what is unknown
    there will stay so.
    """
    return min(
        frontiers(costmap, robot, blacklist, search), key=lambda one: one.score, default=None
    )


def frontiers(
    costmap: Costmap, robot: Point, blacklist: Iterable[Point], search: Search
) -> list[Frontier]:
    """All frontiers that count, from `robot` [m]."""
    start = costmap.cell(*robot)
    if start is None:
        return []
    known = np.where(costmap.cells < 0, np.float32(LETHAL), costmap.cost)
    way = search.field(known, start, "from") * costmap.resolution
    edge = _edge(costmap.cells) & (known < LETHAL) & np.isfinite(way)
    for x, y in blacklist:
        _rub_out(edge, costmap, x, y)
    count, labels, stats, middles = cv2.connectedComponentsWithStats(edge.view(np.uint8))
    found = []
    for label in range(1, count):
        size = float(stats[label, cv2.CC_STAT_AREA]) * costmap.resolution
        if size >= 2 * costmap.inflation.fits:
            left, top, width, height = stats[label, : cv2.CC_STAT_AREA]
            part = slice(top, top + height), slice(left, left + width)
            rows, columns = np.nonzero(labels[part] == label)
            found.append(_frontier(costmap, way, rows + top, columns + left, middles[label], size))
    return found


def _frontier(
    costmap: Costmap,
    way: Floats,
    rows: NDArray[np.intp],
    columns: NDArray[np.intp],
    middle: Floats,
    size: float,
) -> Frontier:
    best = int(np.hypot(columns - middle[0], rows - middle[1]).argmin())
    x, y = costmap.points(rows[best : best + 1], columns[best : best + 1])[0]
    return Frontier(x=float(x), y=float(y), size=size, cost=float(way[rows[best], columns[best]]))


def _edge(cells: NDArray[np.int8]) -> NDArray[np.bool_]:
    """Known cells beside an unknown one; beyond the map all is unknown."""
    unknown = np.pad(cells < 0, 1, constant_values=True)
    beside = unknown[:-2, 1:-1] | unknown[2:, 1:-1] | unknown[1:-1, :-2] | unknown[1:-1, 2:]
    edge: NDArray[np.bool_] = beside & (cells >= 0)
    return edge


def _rub_out(edge: NDArray[np.bool_], costmap: Costmap, x: float, y: float) -> None:
    """Take away what is near a place."""
    radius = TAKEN / costmap.resolution
    column = (x - costmap.origin_x) / costmap.resolution - 0.5
    row = (y - costmap.origin_y) / costmap.resolution - 0.5
    top, left = max(int(row - radius), 0), max(int(column - radius), 0)
    part = edge[top : max(int(row + radius) + 2, 0), left : max(int(column + radius) + 2, 0)]
    rows, columns = np.ogrid[top : top + part.shape[0], left : left + part.shape[1]]
    part &= np.hypot(rows - row, columns - column) > radius
