"""Would a scan have seen what the map shows, had it been taken there?

Where a beam has passed through something that the map has in its way, the place is wrong, however
well the rest fits; and where little of a scan overlaps with the map, only this tells a right place
from a wrong one.
"""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.kernels.kernel import kernel
from gigabrain_zenoh.mapping.points import Points

BINS = 360  # of bearing
MARGIN = 0.3  # [m], what lies nearer than a beam's end by less was hit by it
FEW = 20  # points in view: of fewer nothing is said


def seen_through(shown: Points, scan: Points, pose: Floats) -> float:
    """The share of the points `shown` (n, 2) that a scan at `pose` has looked through.

    Only points in its view count: not those behind what it has hit. `scan` (m, 2) is in the body's
    frame. NaN where hardly anything is in view.
    """
    nearest, farthest = _ends(scan)
    through, hit = _look(shown, nearest, farthest, pose)
    return through / (through + hit) if through + hit >= FEW else np.nan


def share_hit(shown: Points, scan: Points, pose: Floats) -> float:
    """Return the share of the points `shown` (n, 2) that a scan at `pose` has hit as well."""
    if not len(shown):
        return 1.0
    nearest, farthest = _ends(scan)
    _, hit = _look(shown, nearest, farthest, np.array(pose))
    return hit / len(shown)


@kernel
def _bin(x: float, y: float) -> int:
    return int((np.arctan2(y, x) / (2 * np.pi) + 1.0) * BINS) % BINS


@kernel
def _ends(scan: Points) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How far the beams about each bearing have reached, at least and at most."""
    low, high = np.full(BINS, np.inf), np.full(BINS, -np.inf)
    for x, y in scan:
        away, at = np.sqrt(x * x + y * y), _bin(x, y)
        for side in (-1, 0, 1):
            b = (at + side) % BINS
            low[b], high[b] = min(low[b], away), max(high[b], away)
    return low, high


@kernel
def _look(
    shown: Points, low: NDArray[np.float64], high: NDArray[np.float64], pose: Floats
) -> tuple[int, int]:
    """How many points beams have passed through, and how many they have hit."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    through = hit = 0
    for k in range(len(shown)):
        dx, dy = shown[k, 0] - pose[0], shown[k, 1] - pose[1]
        x, y = cos * dx + sin * dy, cos * dy - sin * dx
        at, away = _bin(x, y), np.sqrt(dx * dx + dy * dy)
        if low[at] == np.inf:
            continue
        if away < low[at] - MARGIN:
            through += 1
        elif away < high[at] + MARGIN:
            hit += 1
    return through, hit
