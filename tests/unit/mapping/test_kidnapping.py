"""The kidnap detector caches a field of the map, but judges by the present map."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.mapping.keyframes import Scan, View
from gigabrain_zenoh.mapping.localizer import KidnapDetector
from gigabrain_zenoh.mapping.occupancy_grid import LogOddsGrid

HERE, THERE = np.zeros(3), np.array((20.0, 0.0, 0.0))
NO_POINTS = np.empty((0, 2), np.float32)


def wall(x: float) -> NDArray[np.float32]:
    return np.array([(x, y / 40) for y in range(-40, 41)], np.float32)


def view(x: float) -> View:
    """Return the scan of a robot `x` [m] in front of a wall."""
    return View(Scan.of(wall(x)), np.zeros(2))


def mapped(*walls: tuple[NDArray[np.float64], float]) -> LogOddsGrid:
    grid = LogOddsGrid()
    for pose, x in walls:
        draw(grid, pose, x)
    return grid


def draw(grid: LogOddsGrid, pose: NDArray[np.float64], x: float) -> None:
    for _ in range(8):
        grid.draw(pose, wall(x), NO_POINTS)


def test_a_wall_that_was_drawn_since_the_last_look_counts() -> None:
    grid, detector = mapped((HERE, 4.0)), KidnapDetector()
    assert not detector.look(grid, view(4.0), HERE)
    draw(grid, HERE, 2.0)
    assert detector.look(grid, view(4.0), HERE)


def test_after_a_drive_the_map_round_the_new_pose_counts() -> None:
    grid, detector = mapped((HERE, 4.0), (THERE, 2.0)), KidnapDetector()
    assert not detector.look(grid, view(4.0), HERE)
    assert detector.look(grid, view(4.0), THERE)


def test_a_redrawn_map_counts() -> None:
    detector = KidnapDetector()
    assert not detector.look(mapped((HERE, 4.0)), view(4.0), HERE)
    assert detector.look(mapped((HERE, 2.0)), view(4.0), HERE)
