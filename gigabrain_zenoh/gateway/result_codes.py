"""Error codes of Nav2 for failed goals, from robot, map and goal.

The codes are those of ComputePathToPose, ComputePathThroughPoses and FollowPath in Jazzy, which
Nav2's navigators return unchanged, and those of the navigators in Kilted.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import OccupancyGrid

NONE = 0
FAILED_TO_MAKE_PROGRESS = 105  # of FollowPath
UNKNOWN, NO_BEHAVIOR_TREE, NO_TRANSFORM = 0, 1, 2  # from the navigator's first code
NO_TF, START_OUTSIDE, GOAL_OUTSIDE, START_OCCUPIED, GOAL_OCCUPIED = 2, 3, 4, 5, 6
NO_PATH = 8  # of the planners, from their first code
OCCUPIED = 65  # of 100, least value of an occupied cell


class Codes(NamedTuple):
    """The first codes of a navigator and of its planner."""

    navigator: int
    planner: int


TO_POSE, THROUGH_POSES = Codes(9000, 200), Codes(9100, 300)


def of_refusal(
    codes: Codes,
    here: Pose | None,
    goals: Sequence[Pose],
    grid: OccupancyGrid | None,
    radius: float,
) -> int:
    """Return the code for a goal without a path.

    `here` is the robot's pose in the map, None if it is not localized. `radius` [m] is that of the
    largest circle in the footprint.
    """
    if here is None or grid is None:
        return codes.planner + NO_TF
    cells = grid.array()
    if not _inside(grid, here):
        return codes.planner + START_OUTSIDE
    if any(not _inside(grid, goal) for goal in goals):
        return codes.planner + GOAL_OUTSIDE
    if _occupied(grid, cells, here, 0.0):
        return codes.planner + START_OCCUPIED
    if any(_occupied(grid, cells, goal, radius) for goal in goals):
        return codes.planner + GOAL_OCCUPIED
    return codes.planner + NO_PATH


def of_failure(codes: Codes, *, had_path: bool) -> int:
    """Return the code for a goal that failed on the way, or before a path was found."""
    return FAILED_TO_MAKE_PROGRESS if had_path else codes.planner + NO_PATH


def inner_radius(footprint: Sequence[tuple[float, float]]) -> float:
    """Return the radius of the largest circle about the body's origin within its footprint [m]."""
    nearest = math.inf
    for (x0, y0), (x1, y1) in zip(footprint, (*footprint[1:], footprint[0]), strict=True):
        dx, dy = x1 - x0, y1 - y0
        along = -(x0 * dx + y0 * dy) / max(dx * dx + dy * dy, 1e-12)
        along = min(1.0, max(0.0, along))
        nearest = min(nearest, math.hypot(x0 + along * dx, y0 + along * dy))
    return nearest


def _cell(grid: OccupancyGrid, at: Pose) -> tuple[int, int]:
    column = math.floor((at.x - grid.origin_x) / grid.resolution)
    return math.floor((at.y - grid.origin_y) / grid.resolution), column


def _inside(grid: OccupancyGrid, at: Pose) -> bool:
    row, column = _cell(grid, at)
    return 0 <= row < grid.height and 0 <= column < grid.width


def _occupied(grid: OccupancyGrid, cells: NDArray[np.int8], at: Pose, radius: float) -> bool:
    """Return whether a cell within `radius` [m] is occupied."""
    row, column = _cell(grid, at)
    reach = math.ceil(radius / grid.resolution)
    rows = slice(max(0, row - reach), row + reach + 1)
    columns = slice(max(0, column - reach), column + reach + 1)
    part = cells[rows, columns] >= OCCUPIED
    if not part.any():
        return False
    y, x = np.nonzero(part)
    away = np.hypot(y + rows.start - row, x + columns.start - column) * grid.resolution
    return bool((away <= radius).any())
