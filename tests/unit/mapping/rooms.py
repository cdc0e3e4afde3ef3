"""Rooms made of walls, and what a lidar sees in them."""

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import compose
from gigabrain_zenoh.mapping.keyframes import Scan, from_beams

Walls = Floats  # (n, 4): x and y of both ends [m]


def box(x: float, y: float, width: float, height: float) -> list[tuple[float, ...]]:
    """The four walls of a rectangle with this lower left corner."""
    right, top = x + width, y + height
    return [(x, y, right, y), (right, y, right, top), (right, top, x, top), (x, top, x, y)]


def ranges(walls: Walls, pose: Floats, angles: Floats) -> Floats:
    """The distance to the nearest wall along each beam; inf where there is none."""
    ways = np.column_stack((np.cos(angles + pose[2]), np.sin(angles + pose[2])))
    start, along = walls[:, :2] - pose[:2], walls[:, 2:] - walls[:, :2]
    facing = ways[:, :1] * along[:, 1] - ways[:, 1:] * along[:, 0]  # (beams, walls)
    with np.errstate(divide="ignore", invalid="ignore"):
        away = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / facing
        share = (start[:, 0] * ways[:, 1:] - start[:, 1] * ways[:, :1]) / facing
    hit = (away > 0) & (share >= 0) & (share <= 1)
    return np.where(hit, away, np.inf).min(axis=1)


class Lidar:
    """All-round beams with noise, the same for the same seed."""

    def __init__(self, beams: int, reach: float = 10.0, noise: float = 0.01, seed: int = 1) -> None:
        self.angles: Floats = np.arange(beams) * 2 * np.pi / beams
        self.reach = reach
        self.noise = noise
        self.random = np.random.default_rng(seed)

    def scan(self, walls: Walls, pose: Floats) -> Scan:
        seen = ranges(walls, pose, self.angles)
        noisy = seen + self.random.normal(0, self.noise, len(seen))
        return from_beams(self.angles, noisy, 0.1, self.reach, free_range=self.reach)


def drifting(poses: Floats, turn: float, scale: float) -> Floats:
    """The steps (n, 3) between `poses`, as odometry would tell them that turns and stretches."""
    from gigabrain_zenoh.geometry.se2 import between

    steps = between(poses[:-1], poses[1:])
    away = np.hypot(steps[:, 0], steps[:, 1])
    return steps * (scale, scale, 1.0) + np.outer(away, (0.0, 0.0, turn))


def line(start: Floats, end: Floats, step: float) -> Floats:
    """Poses from `start` to `end`, both with the yaw of the first, `step` [m] apart."""
    count = int(np.hypot(*(end - start)[:2]) / step) + 1
    share = np.linspace(0, 1, count)[:, None]
    return start * (1 - share) + np.array((end[0], end[1], start[2])) * share


def dead_reckoned(start: Floats, steps: NDArray[np.float64]) -> Floats:
    """Return the pose after all steps, by odometry alone."""
    for step in steps:
        start = compose(start, step)
    return start
