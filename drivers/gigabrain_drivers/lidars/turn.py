"""Samples of a turning lidar, gathered into one scan per turn."""

import abc
import itertools
import math
from collections.abc import Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gigabrain_schemas.arrays import ranges_bytes
from gigabrain_schemas.body import Lidar
from gigabrain_schemas.sensors import LaserScan

Samples = NDArray[np.float64]
Piece = TypeVar("Piece")

MOST_SAMPLES = 20_000  # per turn; the fastest lidar here measures 3200
CLOCKWISE = -math.pi / 180  # from degrees clockwise to radians counter-clockwise
SHORTEST, LONGEST = 0.25, 3.0  # of the nominal period; less is a backlog, more is two turns mixed


class Gathered(abc.ABC, Generic[Piece]):
    """The turn that is being measured, in the pieces that came. Its size is bounded."""

    def __init__(self, lidar: Lidar) -> None:
        self._lidar = lidar
        self._period_ns = 1e9 / lidar.rate_hz
        self.clear()

    @abc.abstractmethod
    def unpack(self, pieces: list[Piece]) -> tuple[Samples, Samples]:
        """Angles (n,) [deg] clockwise, and distances (n,) [mm], of all samples in the pieces.

        0 mm where there was no return, nan where it cannot be trusted.
        """

    def clear(self) -> None:
        """Forget what was gathered."""
        self._pieces: list[Piece] = []
        self._count = self._began_ns = self._last_ns = 0
        self._whole = False  # whether it was seen from its start

    def add(self, piece: Piece, count: int, now_ns: int) -> None:
        """So many samples more.

        After a whole turn of silence what was gathered before it is forgotten.
        """
        silent = self._count and now_ns - self._last_ns > self._period_ns
        if silent or self._count + count > MOST_SAMPLES:
            self.clear()
        if not self._count:
            self._began_ns = now_ns
        self._last_ns = now_ns
        self._pieces.append(piece)
        self._count += count

    def finish(self, now_ns: int) -> LaserScan | None:
        """The scan of the turn that ends here; a new one begins.

        None when its start was not seen, and when its bytes came faster or slower than a lidar
        turns: a process that was held up gets what waited in the port at once, and that is old.
        """
        pieces, count, whole = self._pieces, self._count, self._whole
        took = (now_ns - self._began_ns) / self._period_ns
        self.clear()
        self._whole = True
        if not count or not whole or not SHORTEST <= took <= LONGEST:
            return None
        angles, distances = self.unpack(pieces)
        ranges = np.where(distances == 0.0, np.inf, distances / 1000)
        return scan_of(self._lidar, angles * CLOCKWISE, ranges)


class Turn(Gathered[tuple[Sequence[float], Sequence[float]]]):
    """Of a lidar whose samples come as numbers: angles [deg] clockwise, and distances [mm]."""

    def unpack(
        self, pieces: list[tuple[Sequence[float], Sequence[float]]]
    ) -> tuple[Samples, Samples]:
        """One after the other."""
        angles, distances = map(itertools.chain.from_iterable, zip(*pieces, strict=True))
        return np.fromiter(angles, np.float64), np.fromiter(distances, np.float64)

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
        if turn_at is None:
            self.add((angles_deg, distances_mm), len(angles_deg), now_ns)
            return None
        if turn_at:
            self.add((angles_deg[:turn_at], distances_mm[:turn_at]), turn_at, now_ns)
        scan = self.finish(now_ns)
        rest = angles_deg[turn_at:], distances_mm[turn_at:]
        self.add(rest, len(rest[0]), now_ns)
        return scan


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
