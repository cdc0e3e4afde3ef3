"""A way from cell to cell, pulled tight: straight lines wherever they cost no more than the cells.

So a corner is cut in the open, and not where the way kept off a wall. Coordinates are in cells.
"""

import math

import numpy as np

from gigabrain_zenoh.kernels.kernel import NONE, kernel
from gigabrain_zenoh.navigation.costmap import LETHAL, Costs
from gigabrain_zenoh.navigation.search import Floats

SAME = 1 + 1e-9  # of two ways that cost the same the straight one


@kernel
def line(cost: Costs, x: float, y: float, to_x: float, to_y: float) -> tuple[float, float]:
    """What a straight line costs, and the highest cost on it; infinite outside the map."""
    height, width = cost.shape
    length = math.hypot(to_x - x, to_y - y)
    column, row = math.floor(x), math.floor(y)
    right, down = (1 if to_x > x else -1), (1 if to_y > y else -1)
    every_x = abs(length / (to_x - x)) if to_x != x else np.inf
    every_y = abs(length / (to_y - y)) if to_y != y else np.inf
    next_x = every_x * (column + 1 - x if right > 0 else x - column) if to_x != x else np.inf
    next_y = every_y * (row + 1 - y if down > 0 else y - row) if to_y != y else np.inf
    spent, worst, gone = 0.0, 0.0, 0.0
    while True:
        if not (0 <= row < height and 0 <= column < width):
            return np.inf, np.inf
        here, until = cost[row, column], min(next_x, next_y, length)
        spent += (until - gone) * here
        worst = max(worst, here)
        if until >= length:
            return spent, worst
        gone = until
        if abs(next_x - next_y) < 1e-9:  # through a corner: both cells beside it must be free
            if 0 <= column + right < width and 0 <= row + down < height:
                worst = max(worst, cost[row, column + right], cost[row + down, column])
            column, row = column + right, row + down
            next_x, next_y = next_x + every_x, next_y + every_y
        elif next_x < next_y:
            column, next_x = column + right, next_x + every_x
        else:
            row, next_y = row + down, next_y + every_y


@kernel
def pull(cost: Costs, points: Floats) -> Floats:
    """Those of `points` (n, 2) between which the way may go straight."""
    count = len(points)
    spent = np.zeros(count)
    for i in range(1, count):
        x, y, to_x, to_y = points[i - 1, 0], points[i - 1, 1], points[i, 0], points[i, 1]
        mean = 0.5 * (cost[int(y), int(x)] + cost[int(to_y), int(to_x)])
        spent[i] = spent[i - 1] + mean * math.hypot(to_x - x, to_y - y)
    kept, size, at = np.zeros(count, np.int64), 1, int(NONE)
    while at < count - 1:
        at = _farthest(cost, points, spent, at)
        kept[size] = at
        size += 1
    return points[kept[:size]]


@kernel
def _farthest(cost: Costs, points: Floats, spent: Floats, at: int) -> int:
    """A point far on to which a straight line leads: looked for in doubled steps, then halved."""
    last = len(points) - 1
    good, bad, hop = at + 1, last + 1, 2
    while good < last:
        tried = min(at + hop, last)
        if not _straight(cost, points, spent, at, tried):
            bad = tried
            break
        good, hop = tried, 2 * hop
    while bad - good > 1:
        middle = (good + bad) // 2
        if _straight(cost, points, spent, at, middle):
            good = middle
        else:
            bad = middle
    return good


@kernel
def _straight(cost: Costs, points: Floats, spent: Floats, at: int, to: int) -> bool:
    value, worst = line(cost, points[at, 0], points[at, 1], points[to, 0], points[to, 1])
    return worst < LETHAL and value <= (spent[to] - spent[at]) * SAME


@kernel
def costs_to_go(cost: Costs, points: Floats) -> Floats:
    """What is left to the end of a line from each of its `points` (n, 2), (n,)."""
    left = np.zeros(len(points))
    for i in range(len(points) - 2, -1, -1):
        x, y, to_x, to_y = points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1]
        left[i] = left[i + 1] + line(cost, x, y, to_x, to_y)[0]
    return left


@kernel
def is_free(cost: Costs, points: Floats) -> bool:
    """Whether a body may go along `points` (n, 2): at first it may be leaving a tight spot."""
    if line(cost, points[0, 0], points[0, 1], points[0, 0], points[0, 1])[1] == np.inf:
        return False
    limit = cost[int(points[0, 1]), int(points[0, 0])]
    for i in range(len(points) - 1):
        x, y, to_x, to_y = points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1]
        worst = line(cost, x, y, to_x, to_y)[1]
        if worst == np.inf or (worst >= LETHAL and worst > limit):
            return False
        limit = cost[int(to_y), int(to_x)]
    return True
