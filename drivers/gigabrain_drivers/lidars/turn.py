"""Samples of a turning lidar, gathered into one scan per turn."""

import math
from collections.abc import Sequence

import numpy as np

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
        self._angles: list[float] = []
        self._ranges: list[float] = []
        self._began_ns = self._last_ns = 0
        self._whole = False  # whether it was seen from its start

    def add(self, angles: Sequence[float], ranges: Sequence[float], now_ns: int) -> None:
        """Samples (n,) at `angles` [rad] counter-clockwise from ahead, with `ranges` [m].

        inf is a sample without a return, nan one that cannot be trusted. After a whole turn of
        silence what was gathered before it is forgotten.
        """
        silent = self._angles and now_ns - self._last_ns > self._period_ns
        if silent or len(self._angles) + len(angles) > MOST_SAMPLES:
            self.clear()
        if not self._angles:
            self._began_ns = now_ns
        self._last_ns = now_ns
        self._angles += angles
        self._ranges += ranges

    def clockwise(
        self,
        angles_deg: Sequence[float],
        distances_mm: Sequence[float],
        turn_at: int | None,
        now_ns: int,
    ) -> LaserScan | None:
        """Samples (n,) of a lidar that turns clockwise and says 0 mm where there was no return.

        `turn_at` is the index of the first that belongs to a new turn; the scan of the turn that
        ends there is returned.
        """
        angles = [a * CLOCKWISE for a in angles_deg]
        ranges = [d / 1000 if d else math.inf for d in distances_mm]
        if turn_at is None:
            self.add(angles, ranges, now_ns)
            return None
        if turn_at:
            self.add(angles[:turn_at], ranges[:turn_at], now_ns)
        scan = self.finish(now_ns)
        self.add(angles[turn_at:], ranges[turn_at:], now_ns)
        return scan

    def finish(self, now_ns: int) -> LaserScan | None:
        """The scan of the turn that ends here; a new one begins.

        None when its start was not seen, and when its bytes came faster or slower than a lidar
        turns: a process that was held up gets what waited in the port at once, and that is old.
        """
        angles, ranges, whole = self._angles, self._ranges, self._whole
        took = (now_ns - self._began_ns) / self._period_ns
        self.clear()
        self._whole = True
        if not angles or not whole or not SHORTEST <= took <= LONGEST:
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
