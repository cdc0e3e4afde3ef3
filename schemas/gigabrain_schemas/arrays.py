"""Encodes numpy arrays as little-endian bytes for messages.

Methods of the messages decode them: `LaserScan.ranges_m`, `OccupancyGrid.array()` and others.
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
