"""Does a map look like itself, moved?

Halls are built alike from both ends. Where a half of one is mapped, a robot in the other half sees
what it would see at the same place in the first, and nothing it sees ever speaks against that.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats, inverse, transform
from gigabrain_zenoh.mapping.field import BLUR_M, Field

NEAR_M = 0.15  # a wall that comes to lie so near another is alike
ENOUGH = 40  # cells of wall, or next to nothing of the map comes to lie on what is known
DEEP_M = 0.4  # how far they deviate from one line: a wall alone is like every other
DIFFERENT = 0.15  # of them, at most, may come to lie amid free ground
MOST = 4000  # cells of wall are enough


def alike(field: Field, move: Floats) -> bool:
    """Whether the map may well go on as itself moved by `move` (3,), in its own frame."""
    rows, columns = np.nonzero(field.distance < field.cell / 2)
    chosen = np.linspace(0, len(rows) - 1, min(MOST, len(rows))).astype(np.intp)
    walls = np.column_stack((columns[chosen], rows[chosen])) * field.cell + field.cell / 2
    same, other = np.empty((0, 2)), 0
    for way in (move, inverse(move)):
        on_walls, amid = _compared(field, transform(way, walls + field.origin))
        same, other = np.concatenate((same, on_walls)), other + amid
    if len(same) < ENOUGH or other > DIFFERENT * (len(same) + other):
        return False
    return bool(np.linalg.eigvalsh(np.cov(same.T))[0] > DEEP_M**2)


def _compared(field: Field, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], int]:
    """The points (n, 2) that lie on walls, and how many lie amid free ground."""
    columns, rows = np.floor((points - field.origin) / field.cell).astype(np.intp).T
    height, width = field.distance.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    rows, columns = rows[inside], columns[inside]
    away = field.distance[rows, columns]
    amid = field.free[rows, columns] & (away > BLUR_M)
    return points[inside][away <= NEAR_M], int(amid.sum())
