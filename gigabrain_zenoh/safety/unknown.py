"""Where the lidar knows nothing: an obstacle at the last range that it saw there, coming nearer.

The room is divided into sectors that keep their direction while the body turns. One without a
single believable beam stands for an obstacle at its last range less the way that the body may have
gone since; one where the lidar has no beam at all, for one where nothing tells that it is free.
"""

import math

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import ranges
from gigabrain_schemas.body import BodyDescription, Lidar
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.geometry.scan import Floats
from gigabrain_zenoh.geometry.sweep import edges
from gigabrain_zenoh.safety.looks import EDGE, Looks, free

SECTORS = 36
WIDTH = math.tau / SECTORS  # [rad]
TOUCHING = 0.001  # [m] outside the footprint
STEP_M, FARTHEST_M = 0.05, 0.35  # how finely, and how far from the body, past looks are asked

Ranges = tuple[float, ...]  # (SECTORS,) [m], of sectors counter-clockwise from yaw 0


def remember(
    lidar: Lidar, scan: LaserScan, nearest: float, yaw: float, last: Ranges, gone: float
) -> tuple[Ranges, tuple[int, ...]]:
    """The nearest range of each sector [m], and which sectors are unknown.

    `yaw` is the body's, `last` what this function said of the scan before (empty at the start) and
    `gone` [m] how far the body may have moved since.
    """
    values = ranges(scan).astype(np.float64)
    sector = _covered(lidar, scan, yaw)
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


def _covered(lidar: Lidar, scan: LaserScan, yaw: float) -> NDArray[np.intp]:
    """The sector of each beam (beams,), for a body that is turned by `yaw`."""
    beams = np.arange(len(ranges(scan)))
    angles = scan.angle_min + (lidar.yaw + yaw) + scan.angle_increment * beams
    sectors: NDArray[np.intp] = np.floor((angles + EDGE) / WIDTH).astype(np.intp) % SECTORS
    return sectors


def obstacles(
    body: BodyDescription,
    yaw: float,
    nearest: Ranges,
    unknown: tuple[int, ...],
    housing: float,
    past: Looks,
) -> Floats:
    """Points (n, 2) [m] in the body's frame that stand for the `unknown` sectors.

    Three for each: at its edges and in its middle. What is nearer than `housing` [m] in the `past`
    looks is the lidar's own.
    """
    lidar = body.lidar
    if lidar is None or not unknown:
        return np.empty((0, 2))
    where = np.repeat(np.array(unknown), 3)
    bearing = (where + np.tile([0.0, 0.5, 1.0], len(unknown))) * WIDTH - yaw
    heading = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    hull, mount = edges(body.footprint), np.array([lidar.x, lidar.y])
    towards = heading @ hull.normals.T
    room = hull.offsets - hull.normals @ mount
    with np.errstate(divide="ignore"):
        leaves = np.where(towards > 0, room / towards, np.inf).min(axis=1)
    reach = np.maximum(np.array(nearest)[where], leaves + TOUCHING)
    if past:
        blind = ~np.isin(where, _covered(lidar, past[-1].scan, yaw))
        ways = leaves[blind, None] + np.arange(TOUCHING, FARTHEST_M + STEP_M / 2, STEP_M)
        points = (mount + ways[..., None] * heading[blind, None]).reshape(-1, 2)
        known = free(body, lidar, housing, past, points).reshape(ways.shape)
        first = np.where(known.all(axis=1), ways.shape[1] - 1, known.argmin(axis=1))
        reach[blind] = np.maximum(reach[blind], ways[np.arange(len(ways)), first])
    found: Floats = (mount + reach[:, None] * heading)[np.isfinite(reach)]
    return found
