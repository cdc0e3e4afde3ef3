"""Encodes numpy arrays as messages carry them: little-endian bytes.

The way back is a method of the message: `LaserScan.ranges_m`, `OccupancyGrid.array()` and others.
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def ranges_bytes(values: NDArray[np.floating]) -> bytes:
    """Encode `values` [m], (n,), for a LaserScan."""
    return values.astype("<f4").tobytes()


def hits_bytes(x: NDArray[np.floating], y: NDArray[np.floating]) -> bytes:
    """Encode the points (`x`, `y`) [m], (n,) each, for a WorldModel."""
    return np.column_stack((x, y)).astype("<f4").tobytes()
