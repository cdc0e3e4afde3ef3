"""Where a disc of known size is of which only a part can be seen."""

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

GATES_M = (0.25, 0.2, 0.15, 0.12, 0.12)  # off its rim a hit may be, in each round
FEWEST = 4  # hits; fewer say nothing of where the middle is
ROUGHEST_M = 0.05  # root mean square off its rim; more is another thing
LEAST_NOISE_M = 0.015
NO_MIDDLE_M = 0.02  # so near to the middle a hit says nothing of where that is
RIM_M = 0.1  # off the rim the hits on it are
STIFF = 0.02  # of the hits' own weight: what they leave open stays where it was


def on_rim(points: Floats, x: float, y: float, radius: float) -> Bools:
    """Which of the `points` (n, 2) are hits on a disc at (x, y) [m], (n,)."""
    away = np.hypot(points[:, 0] - x, points[:, 1] - y)
    found: Bools = np.abs(away - radius) < RIM_M
    return found


def off_rims(points: Floats, discs: Floats) -> Floats:
    """Those of the `points` (n, 2) that are hits on none of `discs` (m, 3): x, y, radius [m]."""
    away = np.hypot(points[:, :1] - discs[:, 0], points[:, 1:] - discs[:, 1])
    found: Floats = points[(np.abs(away - discs[:, 2]) >= RIM_M).all(axis=1)]
    return found


def place_of(
    points: Floats, x: float, y: float, radius: float
) -> tuple[float, float, float] | None:
    """The middle (x, y) [m] of a disc whose rim the `points` (n, 2) near it lie on, and how sure.

    From where it should be, by Gauss and Newton's steps; the third number is the standard
    deviation [m] in the worse direction. None where it does not show.
    """
    for gate in GATES_M:
        dx, dy = points[:, 0] - x, points[:, 1] - y
        away = np.hypot(dx, dy)
        mine = (np.abs(away - radius) < gate) & (away > NO_MIDDLE_M)
        count = int(mine.sum())
        if count < FEWEST:
            return None
        ux, uy, off = dx[mine] / away[mine], dy[mine] / away[mine], away[mine] - radius
        xx, xy, yy = float(ux @ ux), float(ux @ uy), float(uy @ uy)
        fx, fy = float(ux @ off), float(uy @ off)
        a, b = xx + STIFF * count, yy + STIFF * count
        determinant = a * b - xy * xy
        x += (b * fx - xy * fy) / determinant
        y += (a * fy - xy * fx) / determinant
    rough = math.sqrt(float(off @ off) / count)
    if rough > ROUGHEST_M:
        return None
    worse = (a + b) / 2 - math.sqrt(((a - b) / 2) ** 2 + xy * xy)
    return x, y, max(rough, LEAST_NOISE_M) / math.sqrt(worse)
