"""Rooms of straight walls, a lidar in them, and a robot that carries it."""

import math
from collections.abc import Sequence

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.config.map_image import SavedMap
from gigabrain_zenoh.geometry.se2 import IDENTITY, compose
from gigabrain_zenoh.mapping.keyframes import Scan, View
from gigabrain_zenoh.mapping.localizer import Place
from gigabrain_zenoh.mapping.occupancy_grid import CELL, LogOddsGrid
from gigabrain_zenoh.mapping.slam_map import SlamMap
from gigabrain_zenoh.mapping.static_map import StaticMap

Wall = tuple[float, float, float, float]  # from x, y to x, y [m]

BEAMS, RANGE_M, NOISE_M = 360, 3.5, 0.01
PATIENCE_S = 60.0  # on a slow machine results come at the same scans
NOISE = np.diag((0.005, 0.005, 0.005)) ** 2


def box(left: float, low: float, right: float, high: float) -> list[Wall]:
    return [
        (left, low, right, low),
        (right, low, right, high),
        (right, high, left, high),
        (left, high, left, low),
    ]


# 8 x 6 m: two rooms with a door between them, a cupboard in each, and a pillar
HOUSE = [
    *box(0, 0, 8, 6),
    (4, 0, 4, 2.4),
    (4, 3.6, 4, 6),
    *box(0, 4.6, 1.5, 6),
    *box(6.2, 0, 8, 0.7),
    *box(2.0, 1.2, 2.4, 1.6),
]
# 16 x 3 m: a corridor that looks the same from both ends, except for the niche
CORRIDOR = [*box(0, 0, 16, 3), *box(2.0, 1.2, 2.6, 1.8), *box(13.4, 1.2, 14, 1.8)]
NICHE = box(7.0, 2.2, 7.6, 3.0)
# 16 x 6 m: a hall that looks the same from both ends
HALF_HALL = [(4, 0, 4, 2.4), *box(1, 4.6, 2.5, 6), *box(2, 1.2, 2.4, 1.6), *box(5.5, 4, 6.1, 4.6)]
HALL = [
    *box(0, 0, 16, 6),
    *HALF_HALL,
    *((16 - a, 6 - b, 16 - c, 6 - d) for a, b, c, d in HALF_HALL),
]


class Rooms:
    """Walls, and a lidar with noise."""

    def __init__(self, walls: Sequence[Wall], seed: int = 1) -> None:
        self._walls = np.array(walls, np.float64)
        self._random = np.random.default_rng(seed)

    def ranges(self, pose: Floats, extra: Sequence[Wall] = ()) -> Floats:
        """Return the ranges of 360 beams from `pose` (3,) [m]; inf where nothing is in range."""
        walls = np.vstack((self._walls, np.array(extra, np.float64).reshape(-1, 4)))
        angles = pose[2] + np.radians(np.arange(0, 360, 360 / BEAMS))
        dx, dy = np.cos(angles)[:, None], np.sin(angles)[:, None]
        x, y = walls[:, 0] - pose[0], walls[:, 1] - pose[1]
        ux, uy = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
        determinant = dx * uy - dy * ux
        with np.errstate(divide="ignore", invalid="ignore"):
            range_, along = (x * uy - y * ux) / determinant, (x * dy - y * dx) / determinant
        range_[~((range_ > 0) & (along >= 0) & (along <= 1))] = np.inf
        nearest: Floats = range_.min(axis=1) + self._random.normal(0, NOISE_M, BEAMS)
        nearest[nearest > RANGE_M] = np.inf
        return nearest

    def view(self, pose: Floats, extra: Sequence[Wall] = ()) -> View:
        """Return the scan from `pose` (3,) as points."""
        values = self.ranges(pose, extra)
        angles = np.radians(np.arange(0, 360, 360 / BEAMS))
        rays, hit = np.column_stack((np.cos(angles), np.sin(angles))), np.isfinite(values)
        scan = Scan.of(rays[hit] * values[hit, None], rays[~hit] * 3.4)
        return View(scan, np.zeros(2))


def at(x: float, y: float, degrees: float = 0.0) -> Floats:
    return np.array((x, y, math.radians(degrees)))


class Walker:
    """A robot that drives from place to place in steps of 0.1 m or 10 degrees."""

    def __init__(self, rooms: Rooms, chart: StaticMap | SlamMap, start: Floats) -> None:
        self.rooms, self.chart, self.pose = rooms, chart, start
        self._random = np.random.default_rng(2)

    def look(self, scans: int = 1, motion: Floats = IDENTITY) -> Place:
        """Process scans, each after `motion` (3,), which odometry measures to about 3 %."""
        for _ in range(scans):
            self.pose = compose(self.pose, motion)
            measured = motion * (1 + self._random.normal(0, 0.03, 3))
            place = self.chart.step(self.rooms.view(self.pose), measured, NOISE)
        return place

    def go(self, *places: tuple[float, float]) -> Place:
        """Drive along straight lines to each place."""
        for x, y in places:
            dx, dy = x - self.pose[0], y - self.pose[1]
            turn = math.remainder(math.atan2(dy, dx) - float(self.pose[2]), math.tau)
            self._repeat(abs(turn) / math.radians(10), at(0, 0, math.degrees(turn)))
            place = self._repeat(math.hypot(dx, dy) / 0.1, at(math.hypot(dx, dy), 0))
        return place

    def _repeat(self, count: float, motion: Floats) -> Place:
        steps = max(math.ceil(count), 1)
        return self.look(steps, motion / steps)


def error(place: Place, pose: Floats) -> float:
    """Return the distance between an estimated place and the robot's pose [m]."""
    return math.hypot(*(place.pose - pose)[:2].tolist())


def grown(rooms: Rooms, *places: tuple[float, float]) -> tuple[SlamMap, Walker]:
    """Return a map from a drive along the places; its origin is the first."""
    chart = SlamMap(PATIENCE_S)
    walker = Walker(rooms, chart, at(*places[0]))
    walker.look()
    walker.go(*places[1:])
    return chart, walker


def drawn(rooms: Rooms, *places: Floats) -> SavedMap:
    """Return the map seen from these poses, in the frame of the rooms."""
    grid = LogOddsGrid()
    for place in places:
        scan = rooms.view(place).scan
        for _ in range(3):
            grid.draw(place, scan.points, scan.free)
    return SavedMap(grid.percent(), CELL, grid.origin_x, grid.origin_y)
