"""Where the lidar knows nothing: an obstacle at the last range that it saw there, coming nearer.

The room is divided into sectors that keep their direction while the body turns. One without a
single believable beam stands for an obstacle at its last range less the way that the body may have
gone since.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.body import BodyDescription, Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.perception import Floats
from gigabrain_zenoh.sweep import edges

SECTORS = 36
WIDTH = math.tau / SECTORS  # [rad]
TOUCHING = 0.001  # [m] outside the footprint
EDGE = 1e-9  # [rad]

Ranges = tuple[float, ...]  # (SECTORS,) [m], of sectors counter-clockwise from yaw 0


def remember(
    lidar: Lidar, scan: LaserScan, nearest: float, yaw: float, last: Ranges, gone: float
) -> tuple[Ranges, tuple[int, ...]]:
    """The nearest range of each sector [m], and which sectors are unknown.

    `yaw` is the body's, `last` what this function said of the scan before (empty at the start) and
    `gone` [m] how far the body may have moved since.
    """
    values = ranges(scan).astype(np.float64)
    sector = _sector_of_beam(len(values), scan.angle_min, scan.angle_increment, lidar.yaw + yaw)
    known = values >= nearest
    if lidar.no_return == "unknown":
        known &= values < np.inf
    near = np.full(SECTORS, np.inf)
    np.minimum.at(near, sector[known], values[known])
    seen = np.zeros(SECTORS, bool)
    seen[sector[known]] = True
    before = np.array(last) if last else _at_first(lidar, values, sector)
    now = np.where(seen, near, np.maximum(0.0, before - gone))
    return tuple(now.tolist()), tuple(np.flatnonzero(~seen).tolist())


def _at_first(lidar: Lidar, values: Floats, sector: NDArray[np.intp]) -> Floats:
    """Never seen: as far as the lidar reaches where nothing came back, since a person has looked.

    Where it cannot see at all, the obstacle touches the body.
    """
    far = np.zeros(SECTORS)
    far[sector[np.isinf(values)]] = lidar.range_max
    return far


def _sector_of_beam(count: int, angle_min: float, increment: float, yaw: float) -> NDArray[np.intp]:
    angles = angle_min + yaw + increment * np.arange(count)
    sectors: NDArray[np.intp] = np.floor((angles + EDGE) / WIDTH).astype(np.intp) % SECTORS
    return sectors


def obstacles(
    body: BodyDescription, yaw: float, nearest: Ranges, unknown: tuple[int, ...]
) -> Floats:
    """Points (n, 2) [m] in the body's frame that stand for the `unknown` sectors.

    Three for each: at its edges and in its middle.
    """
    lidar = body.lidar
    if lidar is None or not unknown:
        return np.empty((0, 2))
    where = np.array(unknown)
    bearing = (where[:, None] + np.array([0.0, 0.5, 1.0])) * WIDTH - yaw
    distance = np.repeat(np.array(nearest)[where], 3)
    heading = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1).reshape(-1, 2)
    hull, mount = edges(body.footprint), np.array([lidar.x, lidar.y])
    towards = heading @ hull.normals.T
    room = hull.offsets - hull.normals @ mount
    with np.errstate(divide="ignore"):
        leaves = np.where(towards > 0, room / towards, np.inf).min(axis=1)
    reach = np.maximum(distance, leaves + TOUCHING)
    found: Floats = (mount + reach[:, None] * heading)[np.isfinite(reach)]
    return found
