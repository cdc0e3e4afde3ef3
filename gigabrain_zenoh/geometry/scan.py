"""Checks whether a scan of a planar lidar is plausible, and locates its hits."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan

EDGE = 1e-9  # [rad], [m], tolerance at edges for rounding
STUCK_BEAMS = 8  # lidars with fewer beams are not checked for equal ranges


def scan_problem(lidar: Lidar, values: NDArray[np.float32], nearest: float) -> str:
    """Return why a scan is not plausible, or an empty text. A blind lidar shows no free space.

    The ranges `values` (n,) are in [m]; those below `nearest` [m] are the lidar's own housing.
    """
    count = len(values)
    if count != lidar.beams:
        return f"the scan has {count} beams, the body's lidar {lidar.beams}"
    seen = values >= nearest  # False for nan, and for -inf (REP-117: too close to measure)
    if lidar.no_return == "unknown":
        seen &= values < np.inf
    found = int(np.count_nonzero(seen))
    if found == 0:
        return "the lidar sees nothing at all"
    if 2 * found <= count:
        return f"{count - found} of {count} beams are missing"
    suspicious = count >= STUCK_BEAMS and values[0] == values[1] < np.inf
    if suspicious and (values == values[0]).all():
        return "all beams report the same distance"
    return ""


def blind_ahead(lidar: Lidar, scan: LaserScan, nearest: float, cone_deg: float) -> str:
    """Return a problem if half the beams or more ahead are missing, else an empty text.

    The cone's whole angle is `cone_deg` [deg].
    """
    values = scan.ranges_m
    cone = _beams_ahead(len(values), scan.angle_min, scan.angle_increment, lidar.yaw, cone_deg)
    seen = int(np.count_nonzero(values[cone] >= nearest))
    if 2 * seen <= len(cone):
        return f"{len(cone) - seen} of {len(cone)} beams ahead are missing"
    return ""


def hits(lidar: Lidar, scan: LaserScan, nearest: float) -> tuple[Floats, Floats]:
    """Return x and y of the hits of `scan` in the body's frame [m], (n,) each."""
    values = scan.ranges_m
    farthest = min(scan.range_max, lidar.range_max)
    hit = (values >= nearest) & (values <= farthest)  # False for nan and inf
    cosines, sines = beams(len(values), scan.angle_min, scan.angle_increment, lidar.yaw)
    reached = values[hit]
    return lidar.x + reached * cosines[hit], lidar.y + reached * sines[hit]


def median(values: NDArray[np.floating]) -> float:
    """Return the median of finite `values` (n,). numpy's median takes five times as long."""
    ordered, count = np.sort(values), len(values)
    return float((ordered[(count - 1) // 2] + ordered[count // 2]) / 2)


@lru_cache(maxsize=8)
def beams(
    count: int, angle_min: float, angle_increment: float, yaw: float
) -> tuple[Floats, Floats]:
    """Return cosines and sines of the beam angles in the body's frame, (count,) each."""
    angles = yaw + angle_min + angle_increment * np.arange(count)
    return np.cos(angles), np.sin(angles)


@lru_cache(maxsize=8)
def _beams_ahead(
    count: int, angle_min: float, angle_increment: float, yaw: float, cone_deg: float
) -> NDArray[np.intp]:
    """Return the indices of the beams that point into the cone ahead, seen from the lidar."""
    cosines, _ = beams(count, angle_min, angle_increment, yaw)
    return np.flatnonzero(cosines >= math.cos(math.radians(cone_deg) / 2) - EDGE)
