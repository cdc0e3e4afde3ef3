"""What a robot's map costs in memory, and how crisp it stays, over hours of the robot's time."""

from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from gigabrain_schemas.arrays import cells
from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_zenoh.mapping.likelihood_field import OCCUPIED

WARM_UP = 0.25  # share of the time that the slope leaves out: six hours of eight are judged
MINUTES_PER_HOUR = 60  # minutes


class MapGrowth(Struct, frozen=True, kw_only=True):
    """One process that makes a map."""

    memory_mb: tuple[float, ...]  # each minute of the robot's time
    mb_an_hour: float  # slope of the memory after the first quarter
    walls: tuple[int, ...]  # occupied cells of the map after each hour, and at the end

    @property
    def most_mb(self) -> float:
        """The most memory of any minute."""
        return max(self.memory_mb, default=0.0)


class GrowthSampler:
    """Takes the samples."""

    def __init__(self) -> None:
        self._memory: list[float] = []
        self._walls: list[int] = []

    @property
    def minutes(self) -> int:
        """How many minutes were sampled."""
        return len(self._memory)

    def minute(self, rss_mb: float, grid: OccupancyGrid) -> None:
        """Add a minute of the robot's time."""
        self._memory.append(rss_mb)
        if self.minutes % MINUTES_PER_HOUR == 0:
            self._walls.append(occupied(grid))

    def growth(self, grid: OccupancyGrid) -> MapGrowth:
        """Return what the samples come to, the map being `grid` in the end."""
        return MapGrowth(
            memory_mb=tuple(round(one, 1) for one in self._memory),
            mb_an_hour=slope(self._memory[int(len(self._memory) * WARM_UP) :]) * MINUTES_PER_HOUR,
            walls=(*self._walls, occupied(grid)),
        )


def slope(values: Sequence[float]) -> float:
    """Return how much the values grow from one to the next, by linear regression."""
    return float(np.polyfit(np.arange(len(values)), values, 1)[0]) if len(values) > 1 else 0.0


def occupied(grid: OccupancyGrid) -> int:
    """Return how many cells are occupied: a wall that is drawn twice has more of them."""
    return int((cells(grid) >= OCCUPIED).sum())
