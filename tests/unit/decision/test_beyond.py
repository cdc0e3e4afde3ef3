"""A goal beyond the edge of the map."""

import numpy as np
import pytest

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.decision.enlarging import enlarged


def small() -> OccupancyGrid:
    known = np.array([[0, 100, 0, 0], [0, 0, -1, 0]], np.int8)
    return OccupancyGrid(
        resolution=0.5, width=4, height=2, origin_x=-1.0, origin_y=-0.5, cells=known.tobytes()
    )


def test_a_map_that_contains_the_goal_is_unchanged() -> None:
    grid = small()
    assert enlarged(grid, Goal(x=0.9, y=0.4)) is grid


@pytest.mark.parametrize(
    ("goal", "size", "corner"),
    [
        ((3.0, 0.0), (12, 2), (-1.0, -0.5)),
        ((-2.0, 0.0), (10, 2), (-4.0, -0.5)),
        ((0.0, 3.0), (4, 11), (-1.0, -0.5)),
        ((-1.5, -1.0), (9, 8), (-3.5, -3.0)),
        ((1.0, 0.0), (8, 2), (-1.0, -0.5)),
    ],
)
def test_the_map_grows_to_two_metres_beyond_the_goal(
    goal: tuple[float, float], size: tuple[int, int], corner: tuple[float, float]
) -> None:
    wide = enlarged(small(), Goal(x=goal[0], y=goal[1]))
    assert (wide.width, wide.height) == size
    assert (wide.origin_x, wide.origin_y) == corner


def test_known_cells_keep_their_places_and_new_cells_are_unknown() -> None:
    wide = enlarged(small(), Goal(x=-1.5, y=-1.0))
    assert wide.array()[5:7, 5:].tolist() == small().array().tolist()
    assert (wide.array()[:5] == -1).all()
    assert (wide.array()[:, :5] == -1).all()


def test_the_map_does_not_grow_for_a_goal_too_far_away() -> None:
    grid = small()
    assert enlarged(grid, Goal(x=1e6, y=1e6)) is grid
    assert enlarged(grid, Goal(x=1e9, y=0.0)) is grid
