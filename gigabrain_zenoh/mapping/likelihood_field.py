"""Likelihood field of a map (AMCL), the fit of a scan in it, and self-similarity of the map.

Many halls look the same from both ends. If one half is mapped, a robot in the other half sees what
it would see at the matching place in the first.
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
from gigabrain_zenoh.mapping.scan_matching import solve_symmetric

OCCUPIED, FREE = 65, 40  # percent: a wall from 65 on, free up to 40
MAX_DISTANCE_M = 2.0  # cap of the distances from walls
FIT_SIGMA_M = 0.1  # deviation of hits from walls, for the score
ROBUST_M = 0.1  # hits farther from a wall lose their weight (Geman and McClure)
HIT_SIGMA_M = 0.1  # of one hit; larger than a lidar's, as the errors of neighbours are correlated
MAX_ITERATIONS, CONVERGED_STEP = 20, 1e-4
NEAR_WALL_M = 0.3  # unknown cells this near to a wall can judge hits
MIN_JUDGED = 0.5  # share of the hits; a pose where the map can judge fewer scores lower
WALL_TOLERANCE_M = 0.25  # a beam that ends farther behind a wall has passed through it
CONTRADICTION_CAP_M = 2 * WALL_TOLERANCE_M  # a larger cap only makes the steps along a beam longer
Distances = NDArray[np.float32]

ON_WALL_M = 0.15  # a shifted wall cell this near to a wall matches it
MIN_WALL_CELLS = 40  # fewer matching cells prove nothing
MIN_SPREAD_M = 0.4  # deviation of matching cells from one line: any two single walls match
MAX_IN_FREE = 0.15  # share of shifted wall cells that lie in free space
MAX_WALL_CELLS = 4000  # cells that are compared


class LikelihoodField(NamedTuple):
    """A map for matching scans: distances to walls."""

    distance: Distances  # (height, width) [m], from a cell's centre to the nearest wall cell's
    free: NDArray[np.bool_]  # (height, width), where a robot may be
    shown: NDArray[np.bool_]  # (height, width), where hits can be judged; else they are neutral
    origin: Floats  # (2,) [m], the corner of cell (0, 0)
    cell: float  # [m]


class FieldFit(NamedTuple):
    """The best pose of a scan near a guess, and its scores."""

    pose: Floats  # (3,)
    information: Floats  # (3, 3), of the scan alone, in the map's axes
    score: float  # 0 to 1, nearness of judged hits to walls, minus the share of beams through walls
    shown: float  # 0 to 1, share of the hits that can be judged
    likely: float  # like `score`, but not lowered if few hits can be judged
    wrong: float  # 0 to 1, share of beams that the map rules out, see `contradiction`


def field_of(
    cells: NDArray[np.int8],
    cell: float,
    origin: tuple[float, float],
    max_distance: float = MAX_DISTANCE_M,
) -> LikelihoodField:
    """Make the field of an occupancy grid (height, width): 0 to 100 occupied, -1 unknown.

    Distances are capped at `max_distance` [m]; CONTRADICTION_CAP_M is enough for `contradiction`.
    """
    reach = math.ceil(max_distance / cell) + 1
    walls = (cells >= OCCUPIED) * np.int8(100)
    distance = np.sqrt(squared_distance(walls, reach)) * np.float32(cell)
    metres = np.minimum(distance, np.float32(max_distance))
    free = (cells >= 0) & (cells <= FREE)
    shown = (cells >= 0) | (metres <= NEAR_WALL_M)
    return LikelihoodField(metres, free, shown, np.array(origin, np.float64), cell)


def fit(field: LikelihoodField, beams: Beams, guess: Floats, prior: Floats) -> FieldFit:
    """Return the pose of the body near `guess` (3,) in which the scan fits best.

    `prior` (3, 3) is the information about the guess, in the map's axes.
    """
    pose, information, likely, judged = _fit(field, beams.hits, guess, prior)
    through_walls, in_free = _ruled_out(field, beams, pose)
    hits = len(beams.hits)
    return FieldFit(
        pose=pose,
        information=information,
        score=likely / max(judged, MIN_JUDGED * hits, 1) - through_walls,
        shown=judged / max(hits, 1),
        likely=likely / max(judged, 1) - through_walls,
        wrong=through_walls + in_free,
    )


def contradiction(field: LikelihoodField, beams: Beams, pose: Floats) -> float:
    """Return the share of beams that the map rules out at `pose` (3,); unknown cells do not."""
    through_walls, in_free = _ruled_out(field, beams, pose)
    return through_walls + in_free


def clearance(field: LikelihoodField, pose: Floats) -> float:
    """Return the distance from `pose` (3,) to the nearest wall [m], accurate to a cell."""
    column, row = np.floor((pose[:2] - field.origin) / field.cell).astype(int)
    height, width = field.distance.shape
    if not (0 <= row < height and 0 <= column < width):
        return MAX_DISTANCE_M
    return float(field.distance[row, column])


def _ruled_out(field: LikelihoodField, beams: Beams, pose: Floats) -> tuple[float, float]:
    """Return the shares of beams that pass through a wall, and that end in free space."""
    in_free = _count_in_free(field, beams.hits, pose)
    return _through_walls(field, beams, pose), in_free / max(len(beams.hits) + len(beams.free), 1)


@kernel
def _count_in_free(field: LikelihoodField, hits: Points, pose: Floats) -> int:
    """Return the number of hits in free space, far from any wall."""
    distance, free, origin, cell = field.distance, field.free, field.origin, field.cell
    height, width = distance.shape
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    count = 0
    for x, y in hits:
        column = int(np.floor((pose[0] + cos * x - sin * y - origin[0]) / cell))
        row = int(np.floor((pose[1] + sin * x + cos * y - origin[1]) / cell))
        if 0 <= row < height and 0 <= column < width and free[row, column]:
            count += distance[row, column] > WALL_TOLERANCE_M
    return count


@kernel
def _distance_and_slope(distance: Distances, x: float, y: float) -> tuple[float, float, float]:
    """Return the distance and its slope at (x, y) in cells, interpolated between four cells."""
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
    """Minimise the distances by Gauss-Newton; large ones weigh little."""
    distance, shown, origin, cell = field.distance, field.shown, field.origin, field.cell
    pose, information, score, judged = guess.copy(), np.zeros((3, 3)), 0.0, 0
    slope, step = np.zeros(3), np.zeros(3)
    for _ in range(MAX_ITERATIONS):
        pose += step
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        information[:] = 0.0
        gradient, score, judged = np.zeros(3), 0.0, 0
        for x, y in hits:
            ahead, aside = cos * x - sin * y, sin * x + cos * y
            at_x, at_y = (pose[0] + ahead - origin[0]) / cell, (pose[1] + aside - origin[1]) / cell
            to_wall, dx, dy = _distance_and_slope(distance, at_x, at_y)
            if _is_shown(shown, at_x, at_y):
                judged += 1
                score += np.exp(-0.5 * (to_wall / FIT_SIGMA_M) ** 2)
            weight = (ROBUST_M**2 / (ROBUST_M**2 + to_wall * to_wall)) ** 2 / HIT_SIGMA_M**2
            slope[0], slope[1] = dx / cell, dy / cell
            slope[2] = slope[1] * ahead - slope[0] * aside
            for i in range(3):
                gradient[i] += weight * slope[i] * to_wall
                for j in range(3):
                    information[i, j] += weight * slope[i] * slope[j]
        drift = pose - guess
        drift[2] = (drift[2] + np.pi) % (2 * np.pi) - np.pi
        for i in range(3):  # `@` would need a BLAS
            gradient[i] += (prior[i] * drift).sum()
        step = -solve_symmetric(information + prior, gradient)
        if np.abs(step).max() < CONVERGED_STEP:
            break
    return pose, information, score, judged


@kernel
def _through_walls(field: LikelihoodField, beams: Beams, pose: Floats) -> float:
    """Return the share of beams that pass through a wall."""
    distance, origin, cell, (hits, free, sensor) = field.distance, field.origin, field.cell, beams
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    x0 = pose[0] + cos * sensor[0] - sin * sensor[1]
    y0 = pose[1] + sin * sensor[0] + cos * sensor[1]
    count = 0
    for ends in (hits, free):
        for x, y in ends:
            dx = pose[0] + cos * x - sin * y - x0
            dy = pose[1] + sin * x + cos * y - y0
            length = np.sqrt(dx * dx + dy * dy)
            travelled = 0.0
            while travelled < length - WALL_TOLERANCE_M:
                at = travelled / length
                to_wall, _, _ = _distance_and_slope(
                    distance, (x0 + at * dx - origin[0]) / cell, (y0 + at * dy - origin[1]) / cell
                )
                if to_wall < cell / 2:
                    count += 1
                    break
                travelled += max(to_wall, cell / 2)
    return count / max(len(hits) + len(free), 1)


def is_self_similar(field: LikelihoodField, move: Floats) -> bool:
    """Return whether the map matches itself when moved by `move` (3,), in its own frame."""
    rows, columns = np.nonzero(field.distance < field.cell / 2)
    sampled = np.linspace(0, len(rows) - 1, min(MAX_WALL_CELLS, len(rows))).astype(np.intp)
    walls = np.column_stack((columns[sampled], rows[sampled])) * field.cell + field.cell / 2
    matching, in_free = np.empty((0, 2)), 0
    for shift in (move, inverse(move)):
        on_walls, off_walls = _compare(field, transform(shift, walls + field.origin))
        matching, in_free = np.concatenate((matching, on_walls)), in_free + off_walls
    if len(matching) < MIN_WALL_CELLS or in_free > MAX_IN_FREE * (len(matching) + in_free):
        return False
    return bool(np.linalg.eigvalsh(np.cov(matching.T))[0] > MIN_SPREAD_M**2)


def _compare(field: LikelihoodField, points: Floats) -> tuple[Floats, int]:
    """Return the points (n, 2) on walls, and the number of points in free space."""
    columns, rows = np.floor((points - field.origin) / field.cell).astype(np.intp).T
    height, width = field.distance.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    rows, columns = rows[inside], columns[inside]
    to_wall = field.distance[rows, columns]
    in_free = field.free[rows, columns] & (to_wall > WALL_TOLERANCE_M)
    return points[inside][to_wall <= ON_WALL_M], int(in_free.sum())
