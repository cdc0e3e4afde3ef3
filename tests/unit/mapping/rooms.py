"""Rooms made of walls, and a lidar in them."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import compose
from gigabrain_zenoh.mapping.keyframes import Scan, from_beams

Walls = Floats  # (n, 4): x and y of both ends [m]


def box(x: float, y: float, width: float, height: float) -> list[tuple[float, ...]]:
    """Return the four walls of a rectangle with lower left corner (x, y)."""
    right, top = x + width, y + height
    return [(x, y, right, y), (right, y, right, top), (right, top, x, top), (x, top, x, y)]


def ranges(walls: Walls, pose: Floats, angles: Floats) -> Floats:
    """Return the distance to the nearest wall along each beam (n,) [m]; inf where there is none."""
    rays = np.column_stack((np.cos(angles + pose[2]), np.sin(angles + pose[2])))
    start, edges = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    determinant = rays[:, :1] * edges[:, 1] - rays[:, 1:] * edges[:, 0]  # (beams, walls)
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = (start[:, 0] * edges[:, 1] - start[:, 1] * edges[:, 0]) / determinant
        share = (start[:, 0] * rays[:, 1:] - start[:, 1] * rays[:, :1]) / determinant
    hit = (distances > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, distances, np.inf).min(axis=1)


class Lidar:
    """A lidar of 360 degrees with noise, reproducible by its seed."""

    def __init__(self, beams: int, reach: float = 10.0, noise: float = 0.01, seed: int = 1) -> None:
        self.angles: Floats = np.arange(beams) * 2 * np.pi / beams
        self.reach = reach
        self.noise = noise
        self.random = np.random.default_rng(seed)

    def scan(self, walls: Walls, pose: Floats) -> Scan:
        true_ranges = ranges(walls, pose, self.angles)
        noisy = true_ranges + self.random.normal(0, self.noise, len(true_ranges))
        return from_beams(self.angles, noisy, 0.1, self.reach, free_range=self.reach)


def drifting(poses: Floats, turn: float, scale: float) -> Floats:
    """Return the steps (n, 3) between `poses` by odometry with errors `turn` and `scale`."""
    from gigabrain_zenoh.geometry.se2 import between

    steps = between(poses[:-1], poses[1:])
    distances = np.hypot(steps[:, 0], steps[:, 1])
    return steps * (scale, scale, 1.0) + np.outer(distances, (0.0, 0.0, turn))


def line(start: Floats, end: Floats, step: float) -> Floats:
    """Return poses from `start` to `end`, `step` [m] apart, with the yaw of `start`."""
    count = int(np.hypot(*(end - start)[:2]) / step) + 1
    share = np.linspace(0, 1, count)[:, None]
    return start * (1 - share) + np.array((end[0], end[1], start[2])) * share


def dead_reckoned(start: Floats, steps: NDArray[np.float64]) -> Floats:
    """Return the pose after all steps, by odometry alone."""
    for step in steps:
        start = compose(start, step)
    return start
