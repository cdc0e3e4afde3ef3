"""Arrays in messages: little-endian bytes on the wire, numpy views without a copy here."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.brain import OccupancyGrid, WorldModel
from gigabrain_schemas.sensors import Image, LaserScan

Floats = NDArray[np.float64]

FARTHEST_HIT = 1000.0  # [m]
DTYPES = {"mono8": "u1", "rgb8": "u1", "bgr8": "u1", "depth16": "<u2", "depth32f": "<f4"}


def ranges(scan: LaserScan) -> NDArray[np.float32]:
    """The ranges of `scan` [m], (n,), as a read-only view."""
    return np.frombuffer(scan.ranges, "<f4")


def ranges_bytes(values: NDArray[np.floating]) -> bytes:
    """`values` [m], (n,), as LaserScan carries them."""
    return values.astype("<f4").tobytes()


def hits(world: WorldModel) -> NDArray[np.float32]:
    """Where beams hit something [m], (n, 2) in the body's frame.

    What is no place, such as NaN, is left out: whoever computes with places may rely on them.
    """
    points = np.frombuffer(world.hits, "<f4").reshape(-1, 2)
    near = (np.abs(points) <= FARTHEST_HIT).all(axis=1)
    return points if near.all() else points[near]


def hits_bytes(x: NDArray[np.floating], y: NDArray[np.floating]) -> bytes:
    """The points (`x`, `y`) [m], (n,) each, as WorldModel carries them."""
    return np.column_stack((x, y)).astype("<f4").tobytes()


def cells(grid: OccupancyGrid) -> NDArray[np.int8]:
    """The cells of `grid`, (height, width), as a read-only view."""
    return np.frombuffer(grid.cells, "i1").reshape(grid.height, grid.width)


def pixels(image: Image) -> NDArray[np.generic]:
    """The pixels of a raw `image`, (height, width) or (height, width, 3), as a read-only view."""
    if image.encoding == "jpeg":
        raise ValueError("a JPEG has to be decoded first")
    channels = (3,) if image.encoding in ("rgb8", "bgr8") else ()
    view = np.frombuffer(image.data, DTYPES[image.encoding])
    return view.reshape(image.height, image.width, *channels)
