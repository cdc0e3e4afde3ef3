"""Growth of map and memory over hours, in the benchmarks' reports."""

import numpy as np
import pytest

from gigabrain_zenoh.qa.bench.slam_world import GrowthSampler
from tests.unit.navigation.grids import grid_of


def test_the_slope_excludes_the_first_quarter_and_walls_are_counted_hourly() -> None:
    sampler = GrowthSampler()
    for minute in range(480):
        grown = 2 * min(minute, 100) + (minute / 60 if minute >= 120 else 0)  # MB
        walls = np.where(np.arange(100).reshape(10, 10) < 20 + minute // 60, 100, 0)
        sampler.minute(200 + grown, grid_of(walls))
    growth = sampler.growth(grid_of(np.full((3, 3), 100)))
    assert sampler.minutes == len(growth.memory_mb) == 480
    assert growth.mb_an_hour == pytest.approx(1.0, abs=0.001)
    assert growth.most_mb == pytest.approx(408.0, abs=0.1)
    assert growth.walls == (20, 21, 22, 23, 24, 25, 26, 27, 9)


def test_without_samples_the_growth_is_zero() -> None:
    growth = GrowthSampler().growth(grid_of(np.zeros((3, 3))))
    assert (growth.most_mb, growth.mb_an_hour, growth.walls) == (0.0, 0.0, (0,))
