"""Samples of a turning lidar, gathered into one scan per turn."""

import math
from collections.abc import Sequence

import numpy as np

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan

MOST_SAMPLES = 20_000  # per turn; the fastest lidar here measures 3200
SHORTEST, LONGEST = 0.25, 3.0  # of the nominal period; less is a backlog, more is two turns mixed


class Turn:
    """The turn that is being measured. Its size is bounded whatever comes in."""

    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._period_ns = 1e9 / lidar.rate_hz
        self.clear()

    def clear(self) -> None:
        """Forget what was gathered."""
        self._angles: list[float] = []
        self._ranges: list[float] = []
        self._began_ns = 0

    def add(self, angles: Sequence[float], ranges: Sequence[float], now_ns: int) -> None:
        """Samples (n,) at `angles` [rad] counter-clockwise from ahead, with `ranges` [m].

        inf is a sample without a return, nan one that cannot be trusted.
        """
        if len(self._angles) + len(angles) > MOST_SAMPLES:
            self.clear()
        if not self._angles:
            self._began_ns = now_ns
        self._angles += angles
        self._ranges += ranges

    def finish(self, now_ns: int) -> LaserScan | None:
        """The scan of the turn that ends here; a new one begins.

        None when there is nothing, and when its bytes came faster or slower than a lidar turns: a
        process that was held up gets what waited in the port all at once, and that is old.
        """
        angles, ranges, began_ns = self._angles, self._ranges, self._began_ns
        self.clear()
        took = (now_ns - began_ns) / self._period_ns
        if not angles or not SHORTEST <= took <= LONGEST:
            return None
        return scan_of(self._lidar, angles, ranges)


def scan_of(lidar: Lidar, angles: Sequence[float], ranges: Sequence[float]) -> LaserScan:
    """One scan of samples (n,) at `angles` [rad]: the nearest of those that share a bin.

    Beyond `range_max` counts as no return; nearer than `range_min`, as in the simulation, as being
    at `range_min`, which is never free space.
    """
    increment = math.tau / lidar.beams
    index = np.rint(np.asarray(angles) / increment).astype(np.intp) % lidar.beams
    values = np.maximum(np.asarray(ranges, np.float64), lidar.range_min)
    values[values > lidar.range_max] = np.inf
    bins = np.full(lidar.beams, np.nan)
    np.fmin.at(bins, index, values)  # fmin: a measured value wins over nan
    return LaserScan(
        angle_min=0.0,
        angle_increment=increment,
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=ranges_bytes(bins),
    )
