"""Free motion of a footprint: straight, turning and along arcs."""

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gigabrain_zenoh.geometry.sweep import arc, depth, edges, radius, straight, turning

WAFFLE = ((0.075, 0.155), (-0.200, 0.155), (-0.200, -0.155), (0.075, -0.155))
ROUND = tuple(
    (0.2 * math.cos(i * math.tau / 32), 0.2 * math.sin(i * math.tau / 32)) for i in range(32)
)


def at(*points: tuple[float, float]) -> np.ndarray:
    return np.array(points).reshape(-1, 2)


def ways(x: float, y: float) -> tuple[float | None, ...]:
    return straight(WAFFLE, at((x, y)), 0.03)


def test_free_distances_are_measured_from_the_edges_of_the_footprint() -> None:
    assert ways(0.575, 0.0) == pytest.approx((0.5, None, None, None))
    assert ways(-0.5, 0.0) == pytest.approx((None, 0.3, None, None))
    assert ways(0.0, 0.555) == pytest.approx((None, None, 0.4, None))
    assert ways(0.0, -0.555) == pytest.approx((None, None, None, 0.4))
    assert straight(WAFFLE, at(), 0.03) == (None, None, None, None)


@pytest.mark.parametrize(("y", "counts"), [(0.18, True), (-0.18, True), (0.19, False)])
def test_a_point_beyond_the_side_margin_is_no_obstacle(y: float, counts: bool) -> None:
    assert (ways(0.5, y)[0] is not None) is counts


def test_a_point_beside_the_body_does_not_stop_it() -> None:
    assert ways(0.0, 0.17)[:2] == (None, None)
    assert ways(0.0, 0.17)[2:] == pytest.approx((0.015, None))


def test_a_point_in_the_footprint_leaves_no_free_distance_on_its_side() -> None:
    assert ways(0.05, 0.10)[:2] == (0.0, None)
    assert ways(-0.15, 0.05)[:2] == (None, 0.0)


def test_depth_is_negative_inside_the_hull_of_a_footprint() -> None:
    hull = edges(((1.0, 1.0), (-1.0, 1.0), (0.0, 0.0), (-1.0, -1.0), (1.0, -1.0)))  # a notch
    assert len(hull.offsets) == 4
    assert depth(hull, at((0.0, 0.0), (2.0, 0.0), (0.0, -1.5))) == pytest.approx([-1.0, 1.0, 0.5])
    assert radius(WAFFLE) == pytest.approx(0.253, abs=0.001)


def test_the_rear_corner_swings_into_a_point_beside_it() -> None:
    """A left turn moves the right rear corner there. A right turn moves no corner so far out."""
    beside = at((-0.14, -0.20))  # at 0.244 m, 4.5 cm from the right side
    left, right = turning(WAFFLE, beside, 0.02, 2.0)
    corner, point = math.atan2(-0.155, -0.200), math.atan2(-0.20, -0.14)
    assert left is not None
    assert 0.0 <= left < point - corner  # 0.30 rad, less the thickness of the corner and the margin
    assert right is None


def test_points_beyond_the_turning_circle_do_not_block_a_turn() -> None:
    assert turning(WAFFLE, at((0.28, 0.0), (0.0, -0.28)), 0.02, 2.0) == (None, None)
    assert turning(ROUND, at((0.23, 0.0)), 0.02, 2.0) == (
        None,
        None,
    )  # a round body sweeps no extra area


def test_the_body_may_turn_away_from_a_wall_that_is_too_near() -> None:
    """The point is 1 cm in front of the right front corner, which a left turn moves into it."""
    left, right = turning(WAFFLE, at((0.085, -0.14)), 0.02, 0.5)
    assert left is not None
    assert left < 0.1
    assert right is None


def test_a_point_in_the_footprint_does_not_block_a_turn() -> None:
    assert turning(WAFFLE, at((0.0, 0.0)), 0.02, 2.0) == (None, None)


def test_an_arc_reaches_points_beside_the_straight_path() -> None:
    """The arc has a radius of 0.5 m to the left. After a quarter, the body is at (0.5, 0.5)."""
    quarter = 0.5 * math.pi / 2
    ahead = at((0.5, 0.75))  # on the left; after a quarter turn, 0.25 m in front of the middle
    way = arc(WAFFLE, ahead, 0.03, 2.0, (0.25, 0.0, 0.5))
    assert way == pytest.approx(quarter + 0.25 - 0.075 - 0.03, abs=0.05)
    assert straight(WAFFLE, ahead, 0.03)[0] is None
    assert arc(WAFFLE, ahead, 0.03, 2.0, (0.25, 0.0, -0.5)) is None


def test_a_reversed_arc_sweeps_the_area_behind() -> None:
    assert arc(WAFFLE, at((-0.5, -0.25)), 0.03, 1.0, (-0.2, 0.0, 0.5)) is not None
    assert arc(WAFFLE, at((-0.5, 0.45)), 0.03, 1.0, (-0.2, 0.0, 0.5)) is None


def test_an_arc_without_a_turn_is_straight() -> None:
    way = arc(WAFFLE, at((0.575, 0.0)), 0.03, 1.0, (0.2, 0.0, 0.0))
    assert way == pytest.approx(0.47, abs=0.021)
    across = arc(WAFFLE, at((0.0, 0.555)), 0.03, 1.0, (0.0, 0.2, 0.0))
    assert across == pytest.approx(0.37, abs=0.021)


@given(
    st.floats(-0.6, 0.6),
    st.floats(-0.6, 0.6),
    st.floats(0.05, 0.3),
    st.floats(-1.8, 1.8),
)
def test_no_point_enters_the_body_on_the_free_way(x: float, y: float, v: float, w: float) -> None:
    """The way is followed in steps of a millimetre, by another formula."""
    hull = edges(WAFFLE)
    if depth(hull, at((x, y)))[0] <= 0.005:
        return
    way = arc(WAFFLE, at((x, y)), 0.03, 0.5, (v, 0.0, w))
    px, py, yaw = 0.0, 0.0, 0.0
    for _ in range(round((0.5 if way is None else way) / 0.001)):
        dt = 0.001 / v
        px += v * math.cos(yaw) * dt
        py += v * math.sin(yaw) * dt
        yaw += w * dt
        c, s = math.cos(yaw), math.sin(yaw)
        seen = at((c * (x - px) + s * (y - py), c * (y - py) - s * (x - px)))
        assert depth(hull, seen)[0] > 0.0


def test_a_huge_footprint_and_a_long_way_need_bounded_memory() -> None:
    huge = ((10.0, 10.0), (-10.0, 10.0), (-10.0, -10.0), (10.0, -10.0))
    angles = np.linspace(0.0, math.tau, 2000)
    around = np.stack([14.1 * np.cos(angles), 14.1 * np.sin(angles)], axis=1)
    tracemalloc.start()
    try:
        assert turning(huge, around, 0.1, 1e6) != (None, None)
        assert arc(huge, around, 0.1, 1e6, (0.02, 0.0, 100.0)) is not None
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 200_000_000


@pytest.mark.long
def test_a_check_in_several_batches_gives_the_same_result() -> None:
    points = at((0.5, 0.3), (0.7, 0.1))
    found = arc(WAFFLE, points, 0.03, 0.8, (0.2, 0.0, 0.3))
    assert found == pytest.approx(0.51, abs=0.02)
    assert arc(WAFFLE, np.tile(points, (20_000, 1)), 0.03, 0.8, (0.2, 0.0, 0.3)) == found
