"""Matches a scan to a local map: a correlative search, then point-to-line ICP.

E. Olson, Real-time correlative scan matching, ICRA 2009: blocks of poses are bounded first, and
only those that may beat the best known one are searched. A. Censi, An ICP variant using a point-
to-line metric, ICRA 2008.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.kernels.jit import kernel, lean_kernel
from gigabrain_zenoh.mapping.keyframes import Points, thinned
from gigabrain_zenoh.mapping.local_map import BLOCK, BUCKET_M, Buckets, Bytes, LikelihoodImage

MAX_SEARCH_POINTS = 90
OFFSET_PENALTY = 0.01  # of the score at the window's rim: of equals, the nearest to the guess wins

MAX_ITERATIONS = 25
CONVERGED_STEP = 1e-4  # [m] and [rad], a smaller step ends ICP
GATE_SHRINK = 0.6  # factor of the gate per iteration
MIN_GATE_M = 0.12
SIGMA_M = 0.06  # larger residuals lose their weight
DAMPING = 1e-9  # keeps the normal equations regular where points leave a direction open


class LatticeHits(NamedTuple):
    """Cells of a scan's points at each heading, with the body in the window's first cell."""

    inside: NDArray[np.uint32]  # (headings, n), flat indices of points always in the image
    inside_count: NDArray[np.int64]  # (headings,)
    rim: NDArray[np.int64]  # (headings, n, 2), row and column of points sometimes in the image
    rim_count: NDArray[np.int64]  # (headings,)


@dataclass(frozen=True, slots=True)
class Window:
    """Search range around the guess."""

    away: float  # [m], to each side
    turn: float  # [rad], to each side
    step: float = 0.025  # [rad]


class Lattice(NamedTuple):
    """Candidate poses: `steps` cells and `turns` headings to each side of the guess."""

    steps: int
    turns: int
    turn: float  # [rad], from heading to heading


@dataclass(frozen=True, slots=True)
class SearchResult:
    """The likeliest pose of a search."""

    pose: Floats
    score: float  # 0 to 1, the mean likelihood of the hits


def search(
    image: LikelihoodImage,
    points: Points,
    guess: Floats,
    window: Window,
    min_score: float = -np.inf,
    max_points: int = MAX_SEARCH_POINTS,
) -> SearchResult:
    """Search the window for the pose whose points fall on the likeliest cells.

    Returns the guess with score 0 if no pose reaches `min_score`; a high one saves much time.
    At most `max_points` of the points are used.
    """
    if not len(points):
        return SearchResult(guess, 0.0)
    steps = math.ceil(window.away / image.cell)
    turns = math.ceil(window.turn / window.step)
    lattice, used = Lattice(steps, turns, window.step), thinned(points, max_points)
    hits = _placed(used, guess, image, lattice)
    bounds = _bounds(image.coarse, hits, len(used), lattice)
    score, t, i, j = _best(image.cells, hits, bounds, len(used), lattice, min_score)
    off = np.array(((j - steps) * image.cell, (i - steps) * image.cell, (t - turns) * window.step))
    return SearchResult(guess + off, score)


@kernel
def _placed(points: Points, guess: Floats, image: LikelihoodImage, lattice: Lattice) -> LatticeHits:
    """Place the points at each heading, with the body in the first corner of the window."""
    (steps, turns, turn), (height, width) = lattice, image.cells.shape
    origin, cell, sides = image.origin, image.cell, BLOCK * (2 * steps // BLOCK + 1)
    headings, count = 2 * turns + 1, len(points)
    inside, inside_count = np.empty((headings, count), np.uint32), np.zeros(headings, np.int64)
    rim, rim_count = np.empty((headings, count, 2), np.int64), np.zeros(headings, np.int64)
    for t in range(headings):
        yaw = guess[2] + (t - turns) * turn
        cos, sin = np.cos(yaw), np.sin(yaw)
        for k in range(count):
            px = guess[0] + cos * points[k, 0] - sin * points[k, 1]
            py = guess[1] + sin * points[k, 0] + cos * points[k, 1]
            row = int(np.floor((py - origin[1]) / cell)) - steps
            column = int(np.floor((px - origin[0]) / cell)) - steps
            if 0 <= row <= height - sides and 0 <= column <= width - sides:
                inside[t, inside_count[t]] = row * width + column
                inside_count[t] += 1
            elif -sides < row < height and -sides < column < width:
                rim[t, rim_count[t], 0], rim[t, rim_count[t], 1] = row, column
                rim_count[t] += 1
    return LatticeHits(inside, inside_count, rim, rim_count)


@lean_kernel
def _score(likelihood: float, down: int, right: int, t: int, lattice: Lattice) -> float:
    """Return the likelihood of a candidate pose minus a penalty for its distance from the guess.

    The distance is in cells and headings.
    """
    away = (down * down + right * right) / (lattice.steps * lattice.steps + 1)
    turned = t * t / (lattice.turns * lattice.turns + 1)
    return likelihood - OFFSET_PENALTY * (away + turned)


@lean_kernel
def _total(
    cells: Bytes, flat: NDArray[np.uint8], hits: LatticeHits, t: int, row: int, column: int
) -> int:
    """Return the summed likelihood of all points of heading `t`, shifted by `row` and `column`."""
    total = 0
    shift = np.uint32(row * cells.shape[1] + column)
    for k in range(hits.inside_count[t]):
        total += flat[hits.inside[t, k] + shift]
    for k in range(hits.rim_count[t]):
        i, j = hits.rim[t, k, 0] + row, hits.rim[t, k, 1] + column
        if 0 <= i < cells.shape[0] and 0 <= j < cells.shape[1]:
            total += cells[i, j]
    return total


@kernel
def _bounds(coarse: Bytes, hits: LatticeHits, count: int, lattice: Lattice) -> Floats:
    """Return upper bounds of the scores in each block (headings, blocks, blocks)."""
    headings, flat, (steps, turns, _) = len(hits.inside), coarse.ravel(), lattice
    blocks = 2 * steps // BLOCK + 1
    bounds = np.empty((headings, blocks, blocks))
    for t in range(headings):
        for i in range(blocks):
            for j in range(blocks):
                down = max(i * BLOCK - steps, steps - i * BLOCK - BLOCK + 1, 0)
                right = max(j * BLOCK - steps, steps - j * BLOCK - BLOCK + 1, 0)
                total = _total(coarse, flat, hits, t, i * BLOCK, j * BLOCK)
                bounds[t, i, j] = _score(total / (255 * count), down, right, t - turns, lattice)
    return bounds


@kernel
def _best(
    cells: Bytes, hits: LatticeHits, bounds: Floats, count: int, lattice: Lattice, min_score: float
) -> tuple[float, int, int, int]:
    """Return likelihood, heading, row and column of the best pose (the first of equals)."""
    blocks, best, flat, (steps, turns, _) = bounds.shape[1], min_score, cells.ravel(), lattice
    likeliest, at_t, at_i, at_j = 0.0, turns, steps, steps
    first = np.argmax(bounds)  # a good first pose allows to skip more blocks
    for n in range(-1, bounds.size):
        block = first if n < 0 else n
        t, top, left = block // (blocks * blocks), block // blocks % blocks, block % blocks
        if bounds[t, top, left] < best:
            continue
        for i in range(top * BLOCK, min(top * BLOCK + BLOCK, 2 * steps + 1)):
            for j in range(left * BLOCK, min(left * BLOCK + BLOCK, 2 * steps + 1)):
                likelihood = _total(cells, flat, hits, t, i, j) / (255 * count)
                score = _score(likelihood, i - steps, j - steps, t - turns, lattice)
                if score > best or (score == best and (t, i, j) < (at_t, at_i, at_j)):
                    best, likeliest, at_t, at_i, at_j = score, likelihood, t, i, j
    return likeliest, at_t, at_i, at_j


class IcpResult(NamedTuple):
    """Result of ICP."""

    pose: Floats
    information: Floats  # (3, 3), of x, y and yaw about the body, in the map's axes
    inliers: float  # share of the points that are matched to a line
    rms: float  # [m], of the inliers' distances from their lines


@lean_kernel
def _nearest(local: Buckets, x: float, y: float, gate: float, known: int) -> int:
    """Return the index of the nearest point within `gate`, or -1; start from `known` if >= 0."""
    points, starts, width, origin = local.points, local.starts, local.width, local.origin
    best, found = gate * gate, -1
    if known >= 0:
        away = _squared_distance(points, known, x, y)
        if away < best:
            best, found, gate = away, known, np.sqrt(away)
    height = (len(starts) - 1) // width
    left = max(int(np.floor((x - gate - origin[0]) / BUCKET_M)), 0)
    right = min(int(np.floor((x + gate - origin[0]) / BUCKET_M)), width - 1)
    top = max(int(np.floor((y - gate - origin[1]) / BUCKET_M)), 0)
    bottom = min(int(np.floor((y + gate - origin[1]) / BUCKET_M)), height - 1)
    if left > right:
        return found
    for row in range(top, bottom + 1):
        for k in range(starts[row * width + left], starts[row * width + right + 1]):
            away = _squared_distance(points, k, x, y)
            if away < best:
                best, found = away, k
    return found


@lean_kernel
def _squared_distance(local: Points, k: int, x: float, y: float) -> float:
    dx, dy = local[k, 0] - x, local[k, 1] - y
    away: float = dx * dx + dy * dy
    return away


@kernel
def solve_symmetric(m: Floats, v: Floats) -> Floats:
    """Solve m x = v for a symmetric (3, 3) matrix by Cramer's rule; only its upper half is read."""
    a, b, c = m[0, 0], m[0, 1], m[0, 2]
    d, e, f = m[1, 1], m[1, 2], m[2, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * aa + b * bb + c * cc
    x = np.empty(3)
    x[0] = (aa * v[0] + bb * v[1] + cc * v[2]) / determinant
    x[1] = (bb * v[0] + dd * v[1] + ee * v[2]) / determinant
    x[2] = (cc * v[0] + ee * v[1] + ff * v[2]) / determinant
    return x


class NormalEquations(NamedTuple):
    """Sums over the residuals of one Gauss-Newton step."""

    hessian: Floats  # (3, 3)
    gradient: Floats  # (3,)


@kernel
def _linearize(
    local: Buckets, points: Points, pose: Floats, gate: float, nearest: NDArray[np.int32],
    sums: NormalEquations,
) -> tuple[int, float]:  # fmt: skip
    """Add the points at `pose` to `sums`; return the numbers of inliers and their squared errors.

    `nearest` are the indices of the points in `local` of the previous matches, or -1.
    """
    inliers, squares, near = 0, 0.0, -1
    (hessian, gradient), normals, known = sums, local.normals, local.points
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for k in range(len(points)):
        rx = cos * points[k, 0] - sin * points[k, 1]
        ry = sin * points[k, 0] + cos * points[k, 1]
        near = nearest[k] if nearest[k] >= 0 else near  # or the match of the previous beam
        j = _nearest(local, pose[0] + rx, pose[1] + ry, gate, near)
        nearest[k] = j
        if j < 0:
            continue
        near = j
        nx, ny = normals[j, 0], normals[j, 1]
        error = (pose[0] + rx - known[j, 0]) * nx + (pose[1] + ry - known[j, 1]) * ny
        weight = (SIGMA_M / (SIGMA_M * SIGMA_M + error * error)) ** 2  # divided by the variance
        lever = rx * ny - ry * nx  # how the error grows with yaw
        inliers += 1
        squares += error * error
        gradient[0] += weight * error * nx
        gradient[1] += weight * error * ny
        gradient[2] += weight * error * lever
        hessian[0, 0] += weight * nx * nx
        hessian[0, 1] += weight * nx * ny
        hessian[0, 2] += weight * nx * lever
        hessian[1, 1] += weight * ny * ny
        hessian[1, 2] += weight * ny * lever
        hessian[2, 2] += weight * lever * lever
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
    return inliers, squares


@kernel
def icp(
    local: Buckets, points: Points, start: Floats, gate: float, prior: Floats, guess: Floats
) -> IcpResult:
    """Slide `points` onto the lines of `local`, beginning at `start`.

    `prior` (3, 3) is the information about `guess`, the pose that odometry expects. It decides in
    directions that the lines leave open.
    """
    pose, hessian = start.copy(), np.zeros((3, 3))
    inliers, squares = 0, 0.0
    nearest = np.full(len(points), -1, np.int32)
    for _ in range(MAX_ITERATIONS):
        hessian, gradient = np.zeros((3, 3)), np.zeros(3)
        sums = NormalEquations(hessian, gradient)
        inliers, squares = _linearize(local, points, pose, gate, nearest, sums)
        off = pose - guess
        off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        for row in range(3):  # `@` would need a BLAS
            gradient[row] += (prior[row] * off).sum()
        step = solve_symmetric(hessian + prior + DAMPING * np.eye(3), gradient)
        pose -= step
        if np.abs(step).max() < CONVERGED_STEP and gate <= MIN_GATE_M:
            break
        gate = max(gate * GATE_SHRINK, MIN_GATE_M)
    rms = np.sqrt(squares / max(inliers, 1))
    return IcpResult(pose, hessian, inliers / max(len(points), 1), rms)
