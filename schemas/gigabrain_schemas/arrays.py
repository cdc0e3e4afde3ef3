"""Arrays in messages: little-endian bytes on the wire, numpy views without a copy here."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.brain import OccupancyGrid, WorldModel
from gigabrain_schemas.sensors import Image, LaserScan

Floats = NDArray[np.float64]

FARTHEST_HIT = 1000.0  # [m]
DTYPES = {"mono8": "u1", "rgb8": "u1", "bgr8": "u1", "depth16": "<u2", "depth32f": "<f4"}


def ranges(scan: LaserScan) -> NDArray[np.float32]:
    """Return the ranges of `scan` [m], (n,), as a read-only view."""
    return np.frombuffer(scan.ranges, "<f4")


def ranges_bytes(values: NDArray[np.floating]) -> bytes:
    """Encode `values` [m], (n,), for a LaserScan."""
    return values.astype("<f4").tobytes()


def hits(world: WorldModel) -> NDArray[np.float32]:
    """Return the points that beams hit [m], (n, 2) in the body's frame.

    Points with NaN or infinity are left out, so that all can be used in computations.
    """
    points = np.frombuffer(world.hits, "<f4").reshape(-1, 2)
    near = (np.abs(points) <= FARTHEST_HIT).all(axis=1)
    return points if near.all() else points[near]


def hits_bytes(x: NDArray[np.floating], y: NDArray[np.floating]) -> bytes:
    """Encode the points (`x`, `y`) [m], (n,) each, for a WorldModel."""
    return np.column_stack((x, y)).astype("<f4").tobytes()


def cells(grid: OccupancyGrid) -> NDArray[np.int8]:
    """Return the cells of `grid`, (height, width), as a read-only view."""
    return np.frombuffer(grid.cells, "i1").reshape(grid.height, grid.width)


def pixels(image: Image) -> NDArray[np.generic]:
    """Return the pixels of a raw `image`, (height, width[, 3]), as a read-only view."""
    if image.encoding == "jpeg":
        raise ValueError("a JPEG has to be decoded first")
    channels = (3,) if image.encoding in ("rgb8", "bgr8") else ()
    view = np.frombuffer(image.data, DTYPES[image.encoding])
    return view.reshape(image.height, image.width, *channels)
