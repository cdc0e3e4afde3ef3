"""Enlarges a map by unknown space, for goals beyond its edge."""

import math

import numpy as np
from msgspec import structs

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal

GOAL_MARGIN_M = 2.0  # of unknown space around a goal outside the map
MAX_ENLARGED_CELLS = 4_000_000


def enlarged(grid: OccupancyGrid, goal: Goal) -> OccupancyGrid:
    """Return `grid` with unknown space around it, so that it contains `goal`.

    Return the same grid if it contains the goal, or if the map would become too large.
    """
    columns = _cells_to_add(goal.x, grid.origin_x, grid.width, grid.resolution)
    rows = _cells_to_add(goal.y, grid.origin_y, grid.height, grid.resolution)
    width, height = grid.width + sum(columns), grid.height + sum(rows)
    if (width, height) == (grid.width, grid.height) or width * height > MAX_ENLARGED_CELLS:
        return grid
    wide = np.full((height, width), -1, np.int8)
    wide[rows[0] : height - rows[1], columns[0] : width - columns[1]] = grid.array()
    return structs.replace(
        grid,
        width=width,
        height=height,
        origin_x=grid.origin_x - columns[0] * grid.resolution,
        origin_y=grid.origin_y - rows[0] * grid.resolution,
        cells=wide.tobytes(),
    )


def _cells_to_add(value: float, origin: float, count: int, resolution: float) -> tuple[int, int]:
    """Return how many cells to add before the first and after the last."""
    end = origin + count * resolution
    if origin <= value < end:
        return 0, 0
    before = math.ceil((origin - value + GOAL_MARGIN_M) / resolution)
    after = math.ceil((value - end + GOAL_MARGIN_M) / resolution)
    return max(0, before), max(0, after)
