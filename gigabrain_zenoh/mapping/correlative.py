"""Correlative search: of all poses in a window, the one whose points fall on the likeliest cells.

Blocks of poses are bounded first, from the most of the cells that each point may fall on in them;
only those that may hold something better than what is known are looked at (E. Olson, Real-time
correlative scan matching, ICRA 2009).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.kernels.kernel import kernel, lean_kernel
from gigabrain_zenoh.mapping.local_map import BLOCK, Bytes, Image
from gigabrain_zenoh.mapping.points import Points, thinned

SEARCHED = 90  # points of a scan are enough to search with
ASIDE = 0.01  # of the score, at the window's rim: of equals, the one nearest to the guess


class Hits(NamedTuple):
    """Points of a scan at each heading of a window, at the window's first row and column."""

    inside: NDArray[np.uint32]  # (headings, n): cells, counted row by row, of points that
    inside_count: NDArray[np.int64]  # stay in the image all over the window; how many
    rim: NDArray[np.int64]  # (headings, n, 2): row and column of those that may be in it
    rim_count: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Window:
    """How far round the guess to search."""

    away: float  # [m], to each side
    turn: float  # [rad], to each side
    step: float = 0.025  # [rad]


@dataclass(frozen=True, slots=True)
class Found:
    """The likeliest pose of a search."""

    pose: Floats
    score: float  # 0 to 1, the mean likelihood of the hits


def search(
    image: Image,
    points: Points,
    guess: Floats,
    window: Window,
    least: float = -np.inf,
    most: int = SEARCHED,
) -> Found:
    """The pose within the window whose points fall on the likeliest cells.

    The guess, with a score of 0, where none scores `least`, which saves most of the search. At
    most `most` of the points are searched with.
    """
    if not len(points):
        return Found(guess, 0.0)
    steps = int(np.ceil(window.away / image.cell))
    turns = int(np.ceil(window.turn / window.step))
    few = thinned(points, most)
    sides = BLOCK * (2 * steps // BLOCK + 1)
    hits = _placed(
        few, guess, image.origin, image.cell, steps, turns, window.step, image.cells.shape, sides
    )
    bounds = _bounds(image.coarse, hits, len(few), steps)
    score, t, i, j = _best(image.cells, hits, bounds, len(few), steps, least)
    off = np.array(((j - steps) * image.cell, (i - steps) * image.cell, (t - turns) * window.step))
    return Found(guess + off, score)


@kernel
def _placed(
    points: Points,
    guess: Floats,
    origin: Floats,
    cell: float,
    steps: int,
    turns: int,
    turn: float,
    shape: tuple[int, int],
    sides: int,
) -> Hits:
    """The points at each heading, the body being in the first corner of a window of `sides`."""
    headings, count, (height, width) = 2 * turns + 1, len(points), shape
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
    return Hits(inside, inside_count, rim, rim_count)


@lean_kernel
def _worth(total: int, count: int, down: int, right: int, t: int, steps: int, turns: int) -> float:
    """What a pose so many cells and headings off the guess is worth, its points being so likely."""
    away = (down * down + right * right) / (steps * steps + 1)
    return total / (255 * count) - ASIDE * (away + t * t / (turns * turns + 1))


@lean_kernel
def _total(cells: Bytes, flat: NDArray[np.uint8], hits: Hits, t: int, row: int, column: int) -> int:
    """How likely all points of heading `t` are together, so many rows and columns on."""
    total = 0
    on = np.uint32(row * cells.shape[1] + column)
    for k in range(hits.inside_count[t]):
        total += flat[hits.inside[t, k] + on]
    for k in range(hits.rim_count[t]):
        i, j = hits.rim[t, k, 0] + row, hits.rim[t, k, 1] + column
        if 0 <= i < cells.shape[0] and 0 <= j < cells.shape[1]:
            total += cells[i, j]
    return total


@kernel
def _bounds(coarse: Bytes, hits: Hits, count: int, steps: int) -> Floats:
    """What the poses of each block are worth at most (headings, blocks, blocks)."""
    headings, flat = len(hits.inside), coarse.ravel()
    blocks, turns = 2 * steps // BLOCK + 1, headings // 2
    bounds = np.empty((headings, blocks, blocks))
    for t in range(headings):
        for i in range(blocks):
            for j in range(blocks):
                down = max(i * BLOCK - steps, steps - i * BLOCK - BLOCK + 1, 0)
                right = max(j * BLOCK - steps, steps - j * BLOCK - BLOCK + 1, 0)
                total = _total(coarse, flat, hits, t, i * BLOCK, j * BLOCK)
                bounds[t, i, j] = _worth(total, count, down, right, t - turns, steps, turns)
    return bounds


@kernel
def _best(
    cells: Bytes, hits: Hits, bounds: Floats, count: int, steps: int, least: float
) -> tuple[float, int, int, int]:
    """Score, heading, row and column of the pose that is worth most; of equals, the first."""
    (headings, blocks, _), best, flat = bounds.shape, least, cells.ravel()
    turns = headings // 2
    score, at_t, at_i, at_j = 0.0, turns, steps, steps
    likeliest = np.argmax(bounds)  # the sooner something good is found, the more can be left out
    for n in range(-1, bounds.size):
        block = likeliest if n < 0 else n
        t, top, left = block // (blocks * blocks), block // blocks % blocks, block % blocks
        if bounds[t, top, left] < best:
            continue
        for i in range(top * BLOCK, min(top * BLOCK + BLOCK, 2 * steps + 1)):
            for j in range(left * BLOCK, min(left * BLOCK + BLOCK, 2 * steps + 1)):
                total = _total(cells, flat, hits, t, i, j)
                worth = _worth(total, count, i - steps, j - steps, t - turns, steps, turns)
                if worth > best or (worth == best and (t, i, j) < (at_t, at_i, at_j)):
                    best, score, at_t, at_i, at_j = worth, total / (255 * count), t, i, j
    return score, at_t, at_i, at_j
