"""The cells of the near surroundings, and what a scan makes of them: marks, and takes back."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.kernels.kernel import kernel

CELL_M = 0.025
BINS = 720  # of the bearings round the lidar
MARKED = 2  # of a cell that was just hit; each beam that passes takes one
BEYOND_M = 0.1  # [m], how far past a cell a beam must go to have passed it

Floats = NDArray[np.float64]


class Place(NamedTuple):
    """A pose in the frame that is planned in."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad]


class Cells(NamedTuple):
    """The window as compiled functions take it, (rows, columns) each."""

    level: NDArray[np.uint8]  # 0 where nothing is
    seen: NDArray[np.int64]  # tick of the last hit
    since: NDArray[np.int64]  # tick of the first hit since it was last free
    x: float  # [m], of the corner of cell (0, 0)
    y: float


@kernel
def observe(
    cells: Cells,
    marked: NDArray[np.int64],
    place: Place,
    lidar: tuple[float, float],
    hits: Floats,
    tick: int,
    oldest: int,
) -> None:
    """Forget what is older than `oldest`, take back what beams have passed, mark what they hit."""
    level, seen = cells.level, cells.seen
    cosine, sine = math.cos(place.yaw), math.sin(place.yaw)
    eye_x = place.x + cosine * lidar[0] - sine * lidar[1]
    eye_y = place.y + sine * lidar[0] + cosine * lidar[1]
    reach = np.full(BINS, -1.0)
    count = hits.shape[0]
    points = np.empty((count, 2))
    for i in range(count):
        x = place.x + cosine * hits[i, 0] - sine * hits[i, 1]
        y = place.y + sine * hits[i, 0] + cosine * hits[i, 1]
        points[i, 0], points[i, 1] = x, y
        k = _bin(x - eye_x, y - eye_y)
        r = math.hypot(x - eye_x, y - eye_y)
        if reach[k] < 0.0 or r < reach[k]:
            reach[k] = r
    (rows, columns), passed = level.shape, _passed(reach)
    for n in marked:
        i, j = n // columns, n % columns
        x = cells.x + (j + 0.5) * CELL_M
        y = cells.y + (i + 0.5) * CELL_M
        if seen[i, j] < oldest:
            level[i, j] = 0
        elif math.hypot(x - eye_x, y - eye_y) + BEYOND_M < passed[_bin(x - eye_x, y - eye_y)]:
            level[i, j] -= 1
    for i in range(count):
        x, y = points[i, 0], points[i, 1]
        row = math.floor((y - cells.y) / CELL_M)
        column = math.floor((x - cells.x) / CELL_M)
        if 0 <= row < rows and 0 <= column < columns:
            if level[row, column] == 0:
                cells.since[row, column] = tick
            level[row, column] = MARKED
            seen[row, column] = tick


@kernel
def _bin(x: float, y: float) -> int:
    """Into which of the BINS the direction of (x, y) falls: a series is quicker than atan2.

    Abramowitz and Stegun, 4.4.47: to 1e-5 rad, a thousandth of a bin.
    """
    far, near = max(abs(x), abs(y), 1e-12), min(abs(x), abs(y))
    r = near / far
    s = r * r
    series = -0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))
    turn = r * (0.9998660 + s * series)
    turn = 0.5 * math.pi - turn if abs(y) > abs(x) else turn
    turn = math.pi - turn if x < 0.0 else turn
    turn = -turn if y < 0.0 else turn
    return math.floor((turn / math.tau + 0.5) * BINS) % BINS


@kernel
def _passed(reach: Floats) -> Floats:
    """How far all beams round each bin went at least [m]; -1 where none is known to have."""
    passed = np.full(BINS, -1.0)
    for k in range(BINS):
        for n in (k - 1, k, k + 1):
            r, nearest = reach[n % BINS], passed[k]
            if r >= 0.0 and (nearest < 0.0 or r < nearest):
                passed[k] = r
    return passed
