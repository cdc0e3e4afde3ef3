"""Stopping distances, against the table that was worked out by hand, and the room there is."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription, Thresholds
from gigabrain_zenoh.stop_zone import cap, free_distances, in_zone, speed_within, stopping_distance
from tests.brain_rig import LIDAR, WAFFLE, open_space, scan


def body(reaction_time: float = 0.32) -> BodyDescription:
    """1 m/s², and 0.08 m of margin."""
    thresholds = Thresholds(reaction_time=reaction_time, stop_margin=0.08)
    return replace(WAFFLE, thresholds=thresholds)


@pytest.mark.parametrize(
    ("reaction_time", "distances"),
    [
        (0.20, [0.091, 0.105, 0.121, 0.140, 0.166, 0.305, 0.780]),
        (0.32, [0.097, 0.117, 0.139, 0.164, 0.197, 0.365, 0.900]),
        (1.32, [0.147, 0.217, 0.289, 0.364, 0.457, 0.865, 1.900]),
    ],
)
def test_the_stopping_distance_matches_the_table(
    reaction_time: float, distances: list[float]
) -> None:
    speeds = [0.05, 0.10, 0.15, 0.20, 0.26, 0.50, 1.00]
    found = [stopping_distance(body(reaction_time), speed) for speed in speeds]
    assert found == pytest.approx(distances, abs=0.0006)


def test_the_speed_cap_matches_the_table() -> None:
    free = [0.0, 0.08, 0.10, 0.15, 0.20, 0.30, 0.50, 1.0]
    found = [speed_within(body(), distance) for distance in free]
    assert found == pytest.approx([0, 0, 0.057, 0.172, 0.265, 0.416, 0.651, 1.07], abs=0.004)


@settings(deadline=None)
@given(st.floats(0.081, 10.0), st.floats(0.01, 2.0), st.floats(0.1, 5.0))
def test_the_speed_cap_is_the_speed_that_needs_all_of_the_room(
    free: float, reaction_time: float, deceleration: float
) -> None:
    some = replace(body(reaction_time), max_linear_deceleration=deceleration)
    assert stopping_distance(some, speed_within(some, free)) == pytest.approx(free)


def hit(x: float, y: float) -> tuple[float | None, float | None]:
    """The room ahead and behind, with one thing in the world."""
    values = np.full(3600, math.inf)
    values[round(math.degrees(math.atan2(y, x)) * 10) % 3600] = math.hypot(x, y)
    some = replace(WAFFLE, lidar=replace(LIDAR, beams=3600))
    return free_distances(some, scan(values))


def test_the_room_is_measured_from_the_edges_of_the_footprint() -> None:
    assert hit(0.575, 0.0) == pytest.approx((0.5, None))
    assert hit(-0.5, 0.0) == pytest.approx((None, 0.3))
    assert free_distances(WAFFLE, scan(open_space())) == (None, None)


@pytest.mark.parametrize(("y", "counts"), [(0.18, True), (-0.18, True), (0.19, False)])
def test_what_the_body_would_pass_with_three_centimetres_to_spare_does_not_count(
    y: float, counts: bool
) -> None:
    ahead, behind = hit(0.5, y)
    assert (ahead is not None) is counts
    assert behind is None


def test_what_is_within_the_footprint_leaves_no_room() -> None:
    assert hit(0.12, 0.0) == pytest.approx((0.045, None))
    ahead, behind = hit(0.05, 0.10)
    assert (ahead, behind) == (0.0, None)
    assert hit(-0.15, 0.05) == (None, 0.0)


def test_hits_on_the_housing_and_beyond_the_range_do_not_count() -> None:
    assert free_distances(WAFFLE, scan(open_space(deg_0=0.09, deg_180=3.6))) == (None, None)


def test_a_body_without_a_lidar_knows_of_no_obstacle() -> None:
    blind = replace(WAFFLE, lidar=None)
    assert free_distances(blind, scan(open_space(deg_0=0.5))) == (None, None)


@pytest.mark.parametrize(
    ("free", "speed", "stopped", "stays"),
    [
        (0.163, 0.2, False, True),  # L(0.2) = 0.164 m
        (0.165, 0.2, False, False),
        (0.165, 0.2, True, True),
        (0.179, 0.0, True, True),  # L(0) = 0.08 m and 0.10 m more
        (0.181, 0.0, True, False),
        (0.081, 0.0, False, False),
        (0.079, 0.0, False, True),
        (0.081, -0.2, False, False),  # moving away
        (None, 0.26, True, False),
    ],
)
def test_the_stop_zone_has_the_stopping_distance_and_a_margin_to_leave_it(
    free: float | None, speed: float, stopped: bool, stays: bool
) -> None:
    assert in_zone(body(), free, speed, stopped) is stays


def test_a_cap_is_stated_only_where_it_limits_the_body() -> None:
    assert cap(body(), None, stopped=False) is None
    assert cap(body(), 0.5, stopped=False) is None  # 0.651 m/s would do, the body has 0.26
    assert cap(body(), 0.15, stopped=False) == pytest.approx(0.172, abs=0.001)
    assert cap(body(), 0.5, stopped=True) == 0.0
