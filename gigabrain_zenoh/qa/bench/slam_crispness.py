"""How crisp a map is: the fewer cells all scans fill together, the better they lie on one another.

The relations of slam_logs.py are only as good as the reference, which some logs have wrong. Cells
judge a map by its own scans: a wall that is drawn twice fills twice as many.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats, compose
from gigabrain_zenoh.qa.bench.slam_logs import Log, laid_onto

CELL = 0.1  # [m]
NEAREST, FARTHEST = 0.3, 15.0  # [m], of the hits that count
GRID_TURNS = 8  # spread over a right angle: one turn alone may be off by 3 %
KEY = 1 << 20  # cells along a row, 100 km


def crispness(log: Log, poses: Floats) -> float:
    """Return the cells filled at `poses` (n, 3) per cell filled at the log's reference poses.

    `poses` are laid onto the reference by one rigid fit first. Below 1 is crisper than the
    reference. The ratio is the mean over turns of the grid.
    """
    bodies = [hits(log, at) for at in range(len(log.ranges))]
    turns: Floats = np.linspace(0, np.pi / 2, GRID_TURNS, endpoint=False)
    ours = cells_filled(bodies, laid_onto(poses, log.reference), turns)
    reference = cells_filled(bodies, log.reference, turns)
    return float(np.mean(ours / reference))


def hits(log: Log, at: int) -> NDArray[np.float64]:
    """Return the hits of one scan (n, 2) in the body's frame [m], of the ranges that count."""
    points = log.scan(at).points.astype(np.float64)
    away = np.hypot(*points.T)
    return np.asarray(points[(away > NEAREST) & (away < FARTHEST)])


def cells_filled(
    bodies: list[NDArray[np.float64]], poses: Floats, turns: Floats
) -> NDArray[np.float64]:
    """Return how many cells the scans fill at `poses` (n, 3), for each turn [rad] of the grid."""
    return np.array([_filled(bodies, compose(np.array((0, 0, turn)), poses)) for turn in turns])


def _filled(bodies: list[NDArray[np.float64]], poses: Floats) -> float:
    each = np.array([len(body) for body in bodies])
    points = np.concatenate(bodies)
    x, y, yaw = np.repeat(poses, each, axis=0).T
    cos, sin = np.cos(yaw), np.sin(yaw)
    columns = np.floor((x + cos * points[:, 0] - sin * points[:, 1]) / CELL).astype(np.int64)
    rows = np.floor((y + sin * points[:, 0] + cos * points[:, 1]) / CELL).astype(np.int64)
    return float(len(np.unique(rows * KEY + columns)))
