"""Rooms of straight walls, what a lidar sees in them, and robots that carry it about."""

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
PATIENCE_S = 60.0  # results come at their scans on a slow machine too
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
# 16 x 3 m: a corridor that looks the same from both ends, but for a niche far off the middle
CORRIDOR = [*box(0, 0, 16, 3), *box(2.0, 1.2, 2.6, 1.8), *box(13.4, 1.2, 14, 1.8)]
NICHE = box(7.0, 2.2, 7.6, 3.0)
# 16 x 6 m: a hall that is the same from both ends, whatever is seen of it
HALF = [(4, 0, 4, 2.4), *box(1, 4.6, 2.5, 6), *box(2, 1.2, 2.4, 1.6), *box(5.5, 4, 6.1, 4.6)]
HALL = [*box(0, 0, 16, 6), *HALF, *((16 - a, 6 - b, 16 - c, 6 - d) for a, b, c, d in HALF)]


class Rooms:
    """Walls, and a lidar with noise of its own."""

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
        across = dx * uy - dy * ux
        with np.errstate(divide="ignore", invalid="ignore"):
            far, along = (x * uy - y * ux) / across, (x * dy - y * dx) / across
        far[~((far > 0) & (along >= 0) & (along <= 1))] = np.inf
        nearest: Floats = far.min(axis=1) + self._random.normal(0, NOISE_M, BEAMS)
        nearest[nearest > RANGE_M] = np.inf
        return nearest

    def view(self, pose: Floats, extra: Sequence[Wall] = ()) -> View:
        """The same as points."""
        values = self.ranges(pose, extra)
        angles = np.radians(np.arange(0, 360, 360 / BEAMS))
        ways, hit = np.column_stack((np.cos(angles), np.sin(angles))), np.isfinite(values)
        scan = Scan.of(ways[hit] * values[hit, None], ways[~hit] * 3.4)
        return View(scan, np.zeros(2))


def at(x: float, y: float, degrees: float = 0.0) -> Floats:
    return np.array((x, y, math.radians(degrees)))


class Walker:
    """A robot that goes from place to place in steps of 0.1 m or 10 degrees."""

    def __init__(self, rooms: Rooms, chart: StaticMap | SlamMap, start: Floats) -> None:
        self.rooms, self.chart, self.pose = rooms, chart, start
        self._random = np.random.default_rng(2)

    def look(self, scans: int = 1, motion: Floats = IDENTITY) -> Place:
        """So many scans, each after this motion, which odometry knows to about 3 %."""
        for _ in range(scans):
            self.pose = compose(self.pose, motion)
            known = motion * (1 + self._random.normal(0, 0.03, 3))
            place = self.chart.step(self.rooms.view(self.pose), known, NOISE)
        return place

    def go(self, *places: tuple[float, float]) -> Place:
        """Along straight lines to each of these."""
        for x, y in places:
            dx, dy = x - self.pose[0], y - self.pose[1]
            turn = math.remainder(math.atan2(dy, dx) - float(self.pose[2]), math.tau)
            self._repeat(abs(turn) / math.radians(10), at(0, 0, math.degrees(turn)))
            place = self._repeat(math.hypot(dx, dy) / 0.1, at(math.hypot(dx, dy), 0))
        return place

    def _repeat(self, count: float, whole: Floats) -> Place:
        steps = max(math.ceil(count), 1)
        return self.look(steps, whole / steps)


def error(place: Place, pose: Floats) -> float:
    """Return the distance between an estimated place and the robot's pose [m]."""
    return math.hypot(*(place.pose - pose)[:2].tolist())


def grown(rooms: Rooms, *places: tuple[float, float]) -> tuple[SlamMap, Walker]:
    """A map that was made on this way; its origin is the first of the places."""
    chart = SlamMap(PATIENCE_S)
    walker = Walker(rooms, chart, at(*places[0]))
    walker.look()
    walker.go(*places[1:])
    return chart, walker


def drawn(rooms: Rooms, *places: Floats) -> SavedMap:
    """The map that is seen from these places, in the frame of the rooms."""
    grid = LogOddsGrid()
    for place in places:
        scan = rooms.view(place).scan
        for _ in range(3):
            grid.draw(place, scan.points, scan.free)
    return SavedMap(grid.percent(), CELL, grid.origin_x, grid.origin_y)
