"""Edges of many polygons at once, and points on them."""

import numpy as np
import pytest

from gigabrain_zenoh.geometry.polygon import edges, points_on_edges

TRIANGLE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
SQUARE = np.array([[2.0, 0.0], [2.2, 0.0], [2.2, 0.2], [2.0, 0.2]])


def test_each_polygon_is_closed_by_itself() -> None:
    begin, end, first = edges([TRIANGLE, SQUARE])
    assert first.tolist() == [0, 3]
    assert end.tolist() == [*TRIANGLE[1:].tolist(), [0.0, 0.0], *SQUARE[1:].tolist(), [2.0, 0.0]]
    assert begin.tolist() == [*TRIANGLE.tolist(), *SQUARE.tolist()]


def test_points_on_all_edges_are_at_most_one_step_apart() -> None:
    points = points_on_edges([TRIANGLE, SQUARE], 0.07, 200)
    for corner in (*TRIANGLE, *SQUARE):
        assert np.hypot(*(points - corner).T).min() == 0.0
    gaps = np.hypot(*np.diff(points, axis=0).T)
    assert np.count_nonzero(gaps > 0.07) == 1  # from one polygon to the other
    assert len(points) == 15 + 21 + 15 + 4 * 3


@pytest.mark.parametrize("limit", [1, 7])
def test_a_long_edge_has_no_more_points_than_allowed(limit: int) -> None:
    assert len(points_on_edges([1000.0 * TRIANGLE], 0.05, limit)) == 3 * limit
