"""Costmap of a body over a map: 1 in the open, LETHAL and more where it does not fit.

Obstacles are inflated by the body's half width; beyond, cost falls with distance.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import BodyDescription
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.geometry import sweep
from gigabrain_zenoh.kernels.images import Cells, Singles, squared_distance
from gigabrain_zenoh.kernels.jit import kernel

LETHAL = 100.0  # the body does not fit at this cost or more; 200 if its centre touches an obstacle
NEAR_COST = 12.0  # added where the body just fits
UNKNOWN_COST = 4.0  # added in unknown space that is avoided: a free detour is up to 5 times as long
MIN_DECAY_M = 0.1
NEGLIGIBLE_COST = 0.05  # where the cost of obstacles is cut off
DECAYS = math.log(NEAR_COST / NEGLIGIBLE_COST)  # decay lengths within the reach
MAX_REACH_CELLS = 1000  # limit of the reach, and so of the time
REDO_SHARE = 0.5  # if more of a map has changed, all of it is computed
UNKNOWN_COSTS = {"allow": 0.0, "avoid": UNKNOWN_COST, "forbid": LETHAL}
Unknown = Literal["avoid", "allow", "forbid"]
Costs = NDArray[np.float32]
WayBits = NDArray[np.uint8]  # bit n of a cell is way n of `grid_search`
NO_LANES: WayBits = np.zeros((0, 0), np.uint8)
Box = tuple[int, int, int, int]  # first row, row after the last, the same of columns


def no_problem(_x: float, _y: float) -> str:
    """Return an empty text: no zone forbids a place."""
    return ""


@dataclass(frozen=True, kw_only=True)
class Inflation:
    """Cost of obstacles and unknown space for one body."""

    fits: float  # [m], distance of its centre to an obstacle at which it can drive past
    turns: float  # [m], distance at which it can turn on the spot
    unknown: Unknown = "avoid"
    beyond: float | None = None  # [m] past `fits`, at which obstacles cost nothing; None: by shape

    @property
    def decay(self) -> float:
        """The decay length of the cost [m]."""
        if self.beyond is not None:
            return self.beyond / DECAYS
        return max(MIN_DECAY_M, self.turns - self.fits)

    @property
    def reach(self) -> float:
        """The distance within which an obstacle costs something [m]."""
        return self.fits + self.decay * DECAYS


@dataclass(frozen=True, kw_only=True, eq=False)
class ZoneOverlay:
    """The zones of a map on the cells of a costmap; see `zones.ZoneMap`."""

    cost: Costs | None  # (height, width), least cost of each cell; None without keep-out zones
    keepouts: Cells | None  # (height, width), 100 in keep-out zones; None without any
    against: WayBits  # (height, width), ways that lanes forbid in each cell; (0, 0) without lanes
    problem: Callable[[float, float], str]  # why the body must not be at (x, y) [m], or ""


@dataclass(frozen=True, kw_only=True, eq=False)
class Costmap:
    """A map as a planner sees it. Rows go with y, columns with x."""

    resolution: float  # [m] per cell
    origin_x: float  # [m], of the corner of cell (0, 0)
    origin_y: float  # [m]
    inflation: Inflation
    cells: Cells  # (height, width), the map with additional obstacles
    cost: Costs  # (height, width)
    against: WayBits = field(default_factory=lambda: NO_LANES)  # see ZoneOverlay
    zone_problem: Callable[[float, float], str] = no_problem  # see ZoneOverlay.problem
    keepouts: Cells | None = None  # see ZoneOverlay

    def cell(self, x: float, y: float) -> tuple[int, int] | None:
        """Return row and column at (x, y) [m]; None outside the map, and for nan."""
        column, row = (x - self.origin_x) / self.resolution, (y - self.origin_y) / self.resolution
        height, width = self.cost.shape
        if not (0 <= row < height and 0 <= column < width):
            return None
        return int(row), int(column)

    def points(self, rows: NDArray[np.integer], columns: NDArray[np.integer]) -> Floats:
        """Return the centres of cells (n,) in metres, (n, 2)."""
        x = self.origin_x + (columns + 0.5) * self.resolution
        y = self.origin_y + (rows + 0.5) * self.resolution
        return np.column_stack((x, y))


def inflation(
    body: BodyDescription, unknown: Unknown = "avoid", beyond: float | None = None
) -> Inflation:
    """Return the inflation for `body`, including the side margin that safety keeps.

    Obstacles have a cost up to `beyond` [m] farther than the body needs; None: by its shape.
    """
    edges, margin = sweep.box(body.footprint), body.thresholds.side_margin
    aside, ahead = max(edges.left, -edges.right), max(edges.front, -edges.rear)
    sideways = body.max_lateral_speed > 0 and body.drive_type != "ackermann"
    fits = (min(aside, ahead) if sideways else aside) + margin
    turns = sweep.radius(body.footprint) + margin
    return Inflation(fits=fits, turns=turns, unknown=unknown, beyond=beyond)


def costmap(
    grid: OccupancyGrid,
    rules: Inflation,
    points: NDArray[np.floating] | None = None,
    before: Costmap | None = None,
    *,
    reuse: bool = False,
) -> Costmap:
    """Return the costs of `grid`; `points` [m], (n, 2) in the map's frame, are obstacles too.

    With the costmap `before`, only changed parts are computed, with the same result. With `reuse`,
    they are written into the costs of `before`, which must not be used afterwards.
    """
    cells = _with_points(grid, points)
    box = _box_to_update(before, grid, rules, cells)
    if box is None or before is None:
        cost = np.empty(cells.shape, np.float32)
        _fill(cost, cells, rules, grid.resolution, (0, cells.shape[0], 0, cells.shape[1]))
    else:
        cost = before.cost
        if box[0] < box[1]:
            cost = cost if reuse else cost.copy()
            _fill(cost, cells, rules, grid.resolution, box)
    return Costmap(
        resolution=grid.resolution,
        origin_x=grid.origin_x,
        origin_y=grid.origin_y,
        inflation=rules,
        cells=cells,
        cost=cost,
    )


def with_zones(costs: Costmap, overlay: ZoneOverlay | None) -> Costmap:
    """Return `costs` with the zones of `overlay`."""
    if overlay is None:
        return costs
    cost = costs.cost if overlay.cost is None else np.maximum(costs.cost, overlay.cost)
    return replace(
        costs, cost=cost, against=overlay.against, zone_problem=overlay.problem,
        keepouts=overlay.keepouts,
    )  # fmt: skip


def clearance_costs(occupied: Cells, rules: Inflation, resolution: float) -> Costs:
    """Return costs (height, width) by distance to `occupied` cells, LETHAL at most."""
    reach = _reach_cells(rules, resolution)
    table = np.minimum(_cost_table(rules, resolution, reach), np.float32(LETHAL))
    costs: Costs = table[squared_distance(occupied, reach).astype(np.int32)]
    return costs


def _with_points(grid: OccupancyGrid, points: NDArray[np.floating] | None) -> Cells:
    cells = grid.array().copy()
    if points is not None and len(points):
        at = (points - (grid.origin_x, grid.origin_y)) / grid.resolution
        inside = (at >= 0).all(axis=1) & (at < (grid.width, grid.height)).all(axis=1)
        columns, rows = at[inside].astype(np.intp).T
        cells[rows, columns] = 100
    return cells


def _box_to_update(
    before: Costmap | None, grid: OccupancyGrid, rules: Inflation, cells: Cells
) -> Box | None:
    """Return the part of the map whose cost may differ from `before`; None for all of it."""
    if before is None or before.inflation != rules or before.cells.shape != cells.shape:
        return None
    if (grid.resolution, grid.origin_x, grid.origin_y) != (
        before.resolution,
        before.origin_x,
        before.origin_y,
    ):
        return None
    top, bottom, left, right = _changed_box(before.cells, cells)
    if top == bottom:
        return top, bottom, left, right
    box = _widened((top, bottom, left, right), _reach_cells(rules, grid.resolution), cells.shape)
    large = (box[1] - box[0]) * (box[3] - box[2]) > REDO_SHARE * cells.size
    return None if large else box


def _reach_cells(rules: Inflation, resolution: float) -> int:
    return min(math.ceil(rules.reach / resolution + 0.5), MAX_REACH_CELLS)


def _widened(box: Box, by: int, shape: tuple[int, ...]) -> Box:
    top, bottom, left, right = box
    return (
        max(top - by, 0),
        min(bottom + by, shape[0]),
        max(left - by, 0),
        min(right + by, shape[1]),
    )


def _fill(cost: Costs, cells: Cells, rules: Inflation, resolution: float, box: Box) -> None:
    """Compute the cost of `box`, with the obstacles around it that reach into it."""
    reach = _reach_cells(rules, resolution)
    wide = _widened(box, reach, cells.shape)
    part = np.ascontiguousarray(cells[wide[0] : wide[1], wide[2] : wide[3]])
    squares, table = squared_distance(part, reach), _cost_table(rules, resolution, reach)
    unknown = np.float32(UNKNOWN_COSTS[rules.unknown])
    _fill_box(cells, (squares, wide), (table, unknown), box, cost)


def _cost_table(rules: Inflation, resolution: float, reach: int) -> Costs:
    """Return the cost by the squared distance in cells to the nearest obstacle.

    Distances are between centres. Half a cell is subtracted, as an obstacle may fill its cell.
    """
    away = (np.sqrt(np.arange(reach * reach + 1)) - 0.5).clip(0) * resolution
    near = 1 + NEAR_COST * np.exp(-(away - rules.fits) / rules.decay)
    lethal = LETHAL * (2 - away / rules.fits)
    table = np.where(away < rules.fits, lethal, near)
    table[-1] = 1.0
    return table.astype(np.float32)


@kernel
def _fill_box(
    cells: Cells,
    squares_in_box: tuple[Singles, Box],
    prices: tuple[Costs, np.float32],
    box: Box,
    out: Costs,
) -> None:
    """Fill `box` of `out`; `prices` are the costs by squared distance, and of unknown space."""
    (squares, wide), (table, unknown) = squares_in_box, prices
    lethal = np.float32(LETHAL)
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            cost = table[int(squares[row - wide[0], column - wide[2]])]
            if cells[row, column] < 0 and cost < lethal:
                cost = min(cost + unknown, lethal)
            out[row, column] = cost


@kernel
def _changed_box(before: Cells, now: Cells) -> Box:
    """Return the smallest box that contains all cells that differ; empty if none does."""
    height, width = now.shape
    top, bottom, left, right = height, 0, width, 0
    for row in range(height):
        old, new, differs = before[row], now[row], np.uint8(0)
        for column in range(width):  # vectorised, as it has no branch
            differs = np.uint8(differs | np.uint8(old[column] ^ new[column]))
        if not differs:
            continue
        top, bottom = min(top, row), row + 1
        for column in range(width):
            if old[column] != new[column]:
                left, right = min(left, column), max(right, column + 1)
    return (top, bottom, left, right) if bottom else (0, 0, 0, 0)
