"""Outlines of groups of cells: they hold their cells, and not the room between them."""

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.polygon import contains
from gigabrain_zenoh.vision.outlines import connected, distinct, split, support_polygons

CELL_M = 0.025
CORNER = [(0.0, along) for along in np.arange(0.0, 2.0, CELL_M)]
CORNER += [(along, 2.0) for along in np.arange(0.0, 2.0, CELL_M)]


def outlines(places: Floats, viewer: Floats) -> list[Floats]:
    low, high = places - CELL_M / 2, places + CELL_M / 2
    labels = split(low, high, connected(places), viewer)
    order = np.argsort(labels, kind="stable")
    first = np.flatnonzero(np.diff(labels[order], prepend=-1))
    return [np.array(distinct(one)) for one in support_polygons(low[order], high[order], first)]


@pytest.mark.parametrize("viewer", [(1.5, 0.5), (0.3, 1.7), (0.6, 1.1), (0.95, 1.05), (1.1, 0.8)])
def test_the_corner_of_a_room_is_no_triangle_round_who_stands_in_it(
    viewer: tuple[float, float],
) -> None:
    places = np.array(CORNER)
    found = outlines(places, np.array(viewer))
    assert not any(contains(one, np.array([viewer]))[0] for one in found)
    near = np.array(viewer) + 0.15 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    assert not any(contains(one, near).any() for one in found)
    assert sum(contains(one, places).astype(int) for one in found).min() >= 1


def test_what_is_behind_a_corner_seen_from_outside_stays_in_one_outline() -> None:
    assert len(outlines(np.array(CORNER), np.array((-1.5, 3.5)))) == 1
