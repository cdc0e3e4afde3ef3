"""Small maps as text: `#` obstacle, `.` free, `?` unknown; the first line is the last row."""

import heapq
import math

import numpy as np

from gigabrain_schemas.brain import OccupancyGrid

CELLS = {"#": 100, ".": 0, "?": -1}
Cell = tuple[int, int]


def grid_of(cells: np.ndarray, resolution: float = 0.1) -> OccupancyGrid:
    height, width = cells.shape
    return OccupancyGrid(
        resolution=resolution,
        width=width,
        height=height,
        origin_x=0.0,
        origin_y=0.0,
        cells=cells.astype(np.int8).tobytes(),
    )


def drawn(picture: str, times: int = 1) -> np.ndarray:
    """Return the cells of a picture, each repeated `times` in both directions."""
    rows = [[CELLS[sign] for sign in line] for line in picture.split()]
    return np.array(rows[::-1], np.int8).repeat(times, 0).repeat(times, 1)


def empty(metres_x: float, metres_y: float, resolution: float = 0.1) -> np.ndarray:
    return np.zeros((round(metres_y / resolution), round(metres_x / resolution)), np.int8)


def cheapest(cost: np.ndarray, start: Cell) -> dict[Cell, float]:
    """Return the cost to each reachable cell, by a plain Dijkstra with the same rules."""
    lethal, found, heap = 100.0, {start: 0.0}, [(0.0, start)]
    height, width = cost.shape
    while heap:
        spent, (row, column) = heapq.heappop(heap)
        if spent > found[row, column]:
            continue
        here = float(cost[row, column])
        for down, right in [(d, r) for d in (-1, 0, 1) for r in (-1, 0, 1) if d or r]:
            to = (row + down, column + right)
            if not (0 <= to[0] < height and 0 <= to[1] < width):
                continue
            passed = {to, (row, to[1]), (to[0], column)} - {(row, column)}
            if any(lethal <= cost[cell] and cost[cell] > here for cell in passed):
                continue
            more = spent + math.hypot(down, right) * (here + float(cost[to])) / 2
            if more < found.get(to, math.inf):
                found[to] = more
                heapq.heappush(heap, (more, to))
    return found
