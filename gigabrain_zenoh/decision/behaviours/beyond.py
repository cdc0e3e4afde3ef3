"""A map with room for a goal beyond its edge: nobody has been there, so nothing is known of it."""

import math

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import cells
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal

ROOM_M = 2.0  # round the goal, to get at it from any side
MOST_CELLS = 4_000_000  # larger maps are not made for a goal


def widened(grid: OccupancyGrid, goal: Goal) -> OccupancyGrid:
    """`grid` with so much unknown space round it that `goal` lies in it, and its cells in place.

    The same grid where the goal is in it already, or so far off that the map would be too large.
    """
    columns = _added(goal.x, grid.origin_x, grid.width, grid.resolution)
    rows = _added(goal.y, grid.origin_y, grid.height, grid.resolution)
    width, height = grid.width + sum(columns), grid.height + sum(rows)
    if (width, height) == (grid.width, grid.height) or width * height > MOST_CELLS:
        return grid
    wide = np.full((height, width), -1, np.int8)
    wide[rows[0] : height - rows[1], columns[0] : width - columns[1]] = cells(grid)
    return replace(
        grid,
        width=width,
        height=height,
        origin_x=grid.origin_x - columns[0] * grid.resolution,
        origin_y=grid.origin_y - rows[0] * grid.resolution,
        cells=wide.tobytes(),
    )


def _added(value: float, origin: float, count: int, resolution: float) -> tuple[int, int]:
    """Cells to add before the first and after the last; none for a value between them."""
    end = origin + count * resolution
    if origin <= value < end:
        return 0, 0
    before = math.ceil((origin - value + ROOM_M) / resolution)
    after = math.ceil((value - end + ROOM_M) / resolution)
    return max(0, before), max(0, after)
