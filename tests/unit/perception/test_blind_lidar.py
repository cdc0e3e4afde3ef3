"""Perception rejects the scan of a blind or stuck lidar."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.body import Lidar
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.perception.node import step
from gigabrain_zenoh.testing.samples import LIDAR, WAFFLE, open_space, scan

NAN, INF = math.nan, math.inf
CONFIG = PerceptionConfig()


def blind(values: NDArray[np.floating], lidar: Lidar = LIDAR) -> str:
    world = step(CONFIG, replace(WAFFLE, lidar=lidar), scan(values))
    assert world.scan_ok is (world.scan_problem == "")
    if world.scan_ok:
        return ""
    assert world.obstacle_ahead
    assert (world.distance_ahead, world.sectors) == (None, ())
    return world.scan_problem


def some(bad: float, count: int) -> NDArray[np.float64]:
    """Return a plausible scan with `count` beams that are `bad`, from the rear on."""
    values = np.linspace(2.0, 3.0, 360)
    values[90 : 90 + count] = bad
    return values


@pytest.mark.parametrize("bad", [NAN, 0.0, -INF, -1.0, 0.05])
def test_a_lidar_that_measures_nothing_is_blind(bad: float) -> None:
    assert blind(np.full(360, bad)) == "the lidar sees nothing at all"


@pytest.mark.parametrize("bad", [NAN, 0.0, -INF])
def test_a_lidar_that_misses_half_of_its_beams_is_blind(bad: float) -> None:
    assert blind(some(bad, 180)) == "180 of 360 beams are missing"
    assert blind(some(bad, 179)) == ""


@pytest.mark.parametrize("constant", [0.5, 3.5, 12.0])
def test_a_lidar_that_reports_one_distance_all_round_is_stuck(constant: float) -> None:
    assert blind(np.full(360, constant)) == "all beams report the same distance"
    almost = np.full(360, constant)
    almost[7] += 0.001
    assert blind(almost) == ""


def test_a_range_finder_with_one_beam_is_not_stuck() -> None:
    assert blind(np.array([1.5]), replace(LIDAR, beams=1)) == ""


@pytest.mark.parametrize("count", [1, 180, 359, 361, 720])
def test_a_scan_of_another_length_is_rejected(count: int) -> None:
    assert blind(np.linspace(2, 3, count)) == f"the scan has {count} beams, the body's lidar 360"


def test_all_inf_is_free_space_unless_the_lidar_cannot_tell() -> None:
    assert blind(open_space()) == ""
    unsure = replace(LIDAR, no_return="unknown")
    assert blind(open_space(), unsure) == "the lidar sees nothing at all"
    assert blind(some(INF, 180), unsure) == "180 of 360 beams are missing"
    assert blind(some(INF, 179), unsure) == ""


def test_a_lidar_without_beams_ahead_is_blind() -> None:
    values = np.linspace(2.0, 3.0, 360)
    values[:8] = values[-7:] = NAN
    assert blind(values) == ""  # 16 of the 31 beams in the cone are still valid
    values[8] = NAN
    assert blind(values) == "16 of 31 beams ahead are missing"


def test_without_a_lidar_nothing_is_known() -> None:
    world = step(CONFIG, replace(WAFFLE, lidar=None), scan(open_space()))
    assert (world.scan_ok, world.scan_problem) == (False, "the body has no lidar")
