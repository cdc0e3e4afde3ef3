"""Likelihood field of a map (AMCL), the fit of a scan in it, and self-similarity of the map.

Halls are built alike from both ends. Where half of one is mapped, a robot in the other half sees
what it would see at the same place in the first.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import inverse, transform
from gigabrain_zenoh.kernels.images import squared_distance
from gigabrain_zenoh.kernels.jit import kernel
from gigabrain_zenoh.mapping.keyframes import Beams, Points
from gigabrain_zenoh.mapping.scan_matching import solved

OCCUPIED, FREE = 65, 40  # percent: from here on a wall, and up to here free
MAX_DISTANCE_M = 2.0  # [m], distances from walls are capped
FIT_SIGMA = 0.1  # [m], how near a hit should be to a wall
ROBUST_M = 0.1  # [m], hits farther off than that count little (Geman and McClure)
HIT_SIGMA = 0.1  # [m] of one hit, larger than a lidar's: neighbours err alike
ITERATIONS, CONVERGED = 20, 1e-4
BESIDE_M = 0.3  # [m] round a wall a hit is judged by it, even where nothing else is known
JUDGED = 0.5  # of the hits, at least; a place that the map shows less of scores lower
BLUR_M = 0.25  # [m], a beam that ends so much behind a wall has passed through it
CONTRADICTED_M = 2 * BLUR_M  # longer distances only make its steps along a beam longer
Distances = NDArray[np.float32]

ON_WALL_M = 0.15  # a wall that comes to lie this near another matches it
MIN_WALL_CELLS = 40  # cells of wall, or next to nothing of the map comes to lie on what is known
MIN_SPREAD_M = 0.4  # how far they deviate from one line: a wall alone is like every other
MAX_AMID_SHARE = 0.15  # of them, at most, may come to lie amid free ground
MAX_WALL_CELLS = 4000  # cells of wall are enough


class LikelihoodField(NamedTuple):
    """A map as scans are matched to it."""

    distance: Distances  # (height, width) [m], from each cell's centre to the nearest wall's
    free: NDArray[np.bool_]  # (height, width), where a robot may be
    shown: NDArray[np.bool_]  # (height, width), where a hit can be judged; elsewhere it is neutral
    origin: Floats  # (2,) [m], the corner of cell (0, 0)
    cell: float  # [m]


class FieldFit(NamedTuple):
    """A scan in its best place nearby."""

    pose: Floats  # (3,)
    information: Floats  # (3, 3), what the scan alone says of it, in the map's axes
    score: float  # 0 to 1: how near hits on what is shown are to walls, less pierced walls' share
    shown: float  # 0 to 1, the hits that can be judged
    likely: float  # as the score, but of what can be judged alone, however little that is
    wrong: float  # 0 to 1, the share of beams that the map rules out, see `contradiction`


def field_of(
    cells: NDArray[np.int8],
    cell: float,
    origin: tuple[float, float],
    farthest: float = MAX_DISTANCE_M,
) -> LikelihoodField:
    """Make the field of an occupancy grid (height, width): 0 to 100 occupied, -1 unknown.

    Distances are capped at `farthest` [m]; for a `contradiction` alone, CONTRADICTED_M is enough.
    """
    reach = math.ceil(farthest / cell) + 1
    walls = (cells >= OCCUPIED) * np.int8(100)
    distance = np.sqrt(squared_distance(walls, reach)) * np.float32(cell)
    metres = np.minimum(distance, np.float32(farthest))
    free = (cells >= 0) & (cells <= FREE)
    shown = (cells >= 0) | (metres <= BESIDE_M)
    return LikelihoodField(metres, free, shown, np.array(origin, np.float64), cell)


def fit(field: LikelihoodField, beams: Beams, guess: Floats, prior: Floats) -> FieldFit:
    """Return the pose of the body near `guess` (3,) in which the scan fits best.

    `prior` (3, 3) is the information that holds the pose at its guess.
    """
    pose, information, likely, judged = _fit(field, beams.hits, guess, prior)
    pierced, amid = _contradicted(field, beams, pose)
    hits = len(beams.hits)
    return FieldFit(
        pose=pose,
        information=information,
        score=likely / max(judged, JUDGED * hits, 1) - pierced,
        shown=judged / max(hits, 1),
        likely=likely / max(judged, 1) - pierced,
        wrong=pierced + amid,
    )


def contradiction(field: LikelihoodField, beams: Beams, pose: Floats) -> float:
    """Return the share of beams that the map rules out at `pose` (3,); unknown ground rules out
    none.
    """
    pierced, amid = _contradicted(field, beams, pose)
    return pierced + amid


def clearance(field: LikelihoodField, pose: Floats) -> float:
    """Return the distance of the body at `pose` (3,) to the nearest wall, to a cell [m]."""
    column, row = np.floor((pose[:2] - field.origin) / field.cell).astype(int)
    height, width = field.distance.shape
    if not (0 <= row < height and 0 <= column < width):
        return MAX_DISTANCE_M
    return float(field.distance[row, column])


def _contradicted(field: LikelihoodField, beams: Beams, pose: Floats) -> tuple[float, float]:
    """Return the shares of beams that pass through a wall, and that end amid free ground."""
    amid = _amid(field, beams.hits, pose)
    return _pierced(field, beams, pose), amid / max(len(beams.hits) + len(beams.free), 1)


@kernel
def _amid(field: LikelihoodField, hits: Points, pose: Floats) -> int:
    """Return how many hits lie amid free ground, far from any wall."""
    distance, free, origin, cell = field.distance, field.free, field.origin, field.cell
    height, width = distance.shape
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    count = 0
    for x, y in hits:
        column = int(np.floor((pose[0] + cos * x - sin * y - origin[0]) / cell))
        row = int(np.floor((pose[1] + sin * x + cos * y - origin[1]) / cell))
        if 0 <= row < height and 0 <= column < width and free[row, column]:
            count += distance[row, column] > BLUR_M
    return count


@kernel
def _distance_and_slope(distance: Distances, x: float, y: float) -> tuple[float, float, float]:
    """Distance and its slope at (x, y) in cells, from the centres of four cells round it."""
    height, width = distance.shape
    left, low = int(np.floor(x - 0.5)), int(np.floor(y - 0.5))
    if left < 0 or low < 0 or left + 1 >= width or low + 1 >= height:
        return MAX_DISTANCE_M, 0.0, 0.0
    u, v = x - 0.5 - left, y - 0.5 - low
    a, b = distance[low, left], distance[low, left + 1]
    c, d = distance[low + 1, left], distance[low + 1, left + 1]
    value = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
    return value, (1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)


@kernel
def _is_shown(shown: NDArray[np.bool_], x: float, y: float) -> bool:
    height, width = shown.shape
    column, row = int(np.floor(x)), int(np.floor(y))
    return 0 <= row < height and 0 <= column < width and bool(shown[row, column])


@kernel
def _fit(
    field: LikelihoodField, hits: Points, guess: Floats, prior: Floats
) -> tuple[Floats, Floats, float, int]:
    """Gauss and Newton on the distances, each weighted by how small it is."""
    distance, shown, origin, cell = field.distance, field.shown, field.origin, field.cell
    pose, information, score, judged = guess.copy(), np.zeros((3, 3)), 0.0, 0
    slope, step = np.zeros(3), np.zeros(3)
    for _ in range(ITERATIONS):
        pose += step
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        information[:] = 0.0
        off, score, judged = np.zeros(3), 0.0, 0
        for x, y in hits:
            ahead, aside = cos * x - sin * y, sin * x + cos * y
            at_x, at_y = (pose[0] + ahead - origin[0]) / cell, (pose[1] + aside - origin[1]) / cell
            away, dx, dy = _distance_and_slope(distance, at_x, at_y)
            if _is_shown(shown, at_x, at_y):
                judged += 1
                score += np.exp(-0.5 * (away / FIT_SIGMA) ** 2)
            weight = (ROBUST_M**2 / (ROBUST_M**2 + away * away)) ** 2 / HIT_SIGMA**2
            slope[0], slope[1] = dx / cell, dy / cell
            slope[2] = slope[1] * ahead - slope[0] * aside
            for i in range(3):
                off[i] += weight * slope[i] * away
                for j in range(3):
                    information[i, j] += weight * slope[i] * slope[j]
        drift = pose - guess
        drift[2] = (drift[2] + np.pi) % (2 * np.pi) - np.pi
        for i in range(3):  # `@` would call for a BLAS
            off[i] += (prior[i] * drift).sum()
        step = -solved(information + prior, off)
        if np.abs(step).max() < CONVERGED:
            break
    return pose, information, score, judged


@kernel
def _pierced(field: LikelihoodField, beams: Beams, pose: Floats) -> float:
    """Return the share of beams that would have passed through a wall."""
    distance, origin, cell, (hits, free, sensor) = field.distance, field.origin, field.cell, beams
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x0 = pose[0] + cos * sensor[0] - sin * sensor[1]
    y0 = pose[1] + sin * sensor[0] + cos * sensor[1]
    through = 0
    for ends in (hits, free):
        for x, y in ends:
            dx = pose[0] + cos * x - sin * y - x0
            dy = pose[1] + sin * x + cos * y - y0
            length = np.sqrt(dx * dx + dy * dy)
            way = 0.0
            while way < length - BLUR_M:
                at = way / length
                away, _, _ = _distance_and_slope(
                    distance, (x0 + at * dx - origin[0]) / cell, (y0 + at * dy - origin[1]) / cell
                )
                if away < cell / 2:
                    through += 1
                    break
                way += max(away, cell / 2)
    return through / max(len(hits) + len(free), 1)


def is_self_similar(field: LikelihoodField, move: Floats) -> bool:
    """Return whether the map matches itself when shifted by `move` (3,), in its own frame."""
    rows, columns = np.nonzero(field.distance < field.cell / 2)
    chosen = np.linspace(0, len(rows) - 1, min(MAX_WALL_CELLS, len(rows))).astype(np.intp)
    walls = np.column_stack((columns[chosen], rows[chosen])) * field.cell + field.cell / 2
    same, other = np.empty((0, 2)), 0
    for way in (move, inverse(move)):
        on_walls, amid = _compared(field, transform(way, walls + field.origin))
        same, other = np.concatenate((same, on_walls)), other + amid
    if len(same) < MIN_WALL_CELLS or other > MAX_AMID_SHARE * (len(same) + other):
        return False
    return bool(np.linalg.eigvalsh(np.cov(same.T))[0] > MIN_SPREAD_M**2)


def _compared(field: LikelihoodField, points: Floats) -> tuple[Floats, int]:
    """Return the points (n, 2) on walls, and the number of those amid free ground."""
    columns, rows = np.floor((points - field.origin) / field.cell).astype(np.intp).T
    height, width = field.distance.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    rows, columns = rows[inside], columns[inside]
    away = field.distance[rows, columns]
    amid = field.free[rows, columns] & (away > BLUR_M)
    return points[inside][away <= ON_WALL_M], int(amid.sum())
