"""Samples of a turning lidar, gathered into one scan per turn."""

import math
from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan

MOST_SAMPLES = 20_000  # per turn; the fastest lidar here measures 3200
CLOCKWISE = -math.pi / 180  # from degrees clockwise to radians counter-clockwise
SHORTEST, LONGEST = 0.25, 3.0  # of the nominal period; less is a backlog, more is two turns mixed


class Turn:
    """The turn that is being measured. Its size is bounded whatever comes in."""

    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._period_ns = 1e9 / lidar.rate_hz
        self.clear()

    def clear(self) -> None:
        """Forget what was gathered."""
        self._angles, self._distances = array("d"), array("d")
        self._began_ns = self._last_ns = 0
        self._whole = False  # whether it was seen from its start

    def clockwise(
        self,
        angles_deg: Sequence[float],
        distances_mm: Sequence[float],
        turn_at: int | None,
        now_ns: int,
    ) -> LaserScan | None:
        """Samples (n,) of a lidar that turns clockwise and says 0 mm where there was no return.

        nan is one that cannot be trusted. `turn_at` is the index of the first that belongs to a new
        turn; the scan of the turn that ends there is returned. After a whole turn of silence what
        was gathered before it is forgotten.
        """
        if turn_at is None:
            self._add(angles_deg, distances_mm, now_ns)
            return None
        if turn_at:
            self._add(angles_deg[:turn_at], distances_mm[:turn_at], now_ns)
        scan = self._finish(now_ns)
        self._add(angles_deg[turn_at:], distances_mm[turn_at:], now_ns)
        return scan

    def _add(self, angles: Sequence[float], distances: Sequence[float], now_ns: int) -> None:
        silent = self._angles and now_ns - self._last_ns > self._period_ns
        if silent or len(self._angles) + len(angles) > MOST_SAMPLES:
            self.clear()
        if not self._angles:
            self._began_ns = now_ns
        self._last_ns = now_ns
        self._angles.extend(angles)
        self._distances.extend(distances)

    def _finish(self, now_ns: int) -> LaserScan | None:
        """The scan of the turn that ends here; a new one begins.

        None when its start was not seen, and when its bytes came faster or slower than a lidar
        turns: a process that was held up gets what waited in the port at once, and that is old.
        """
        angles, distances, whole = self._angles, self._distances, self._whole
        took = (now_ns - self._began_ns) / self._period_ns
        self.clear()
        self._whole = True
        if not angles or not whole or not SHORTEST <= took <= LONGEST:
            return None
        ranges = np.frombuffer(distances) / 1000
        ranges[ranges == 0.0] = np.inf
        return scan_of(self._lidar, np.frombuffer(angles) * CLOCKWISE, ranges)


def scan_of(lidar: Lidar, angles: ArrayLike, ranges: ArrayLike) -> LaserScan:
    """One scan of samples (n,) at `angles` [rad] with `ranges` [m], inf where there was no return.

    Of samples that share a bin the nearest counts.

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
