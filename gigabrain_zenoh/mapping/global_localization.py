"""Global localization: finds all poses in the map that explain one scan.

Every block of 8 x 8 cells at every heading gets an upper bound of how well the scan may fit there;
only the best blocks are looked at cell by cell (Olson 2009, Hess et al. 2016).
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import compose, inverse, wrap
from gigabrain_zenoh.kernels.images import dilated
from gigabrain_zenoh.kernels.jit import kernel
from gigabrain_zenoh.mapping.keyframes import Beams, Points
from gigabrain_zenoh.mapping.likelihood_field import (
    MIN_JUDGED,
    FieldFit,
    LikelihoodField,
    fit,
    is_self_similar,
)

POINTS = 90  # of a scan, evenly chosen
MIN_POINTS = 20
SIGMA = 0.15  # [m], wide enough for the steps between headings
BLOCK = 8  # cells
STEP_M, FINEST_RAD, COARSEST_RAD = 0.15, math.radians(1.0), math.radians(3.0)
MIN_SCORE = 0.5  # a worse fit does not count
UNKNOWN = 191  # of 255, what a hit on what the map does not show counts: neither for nor against
BAND = 0.2  # candidates that much worse than the best are not looked at
MIN_SCORE_HIDDEN = 0.9  # and that good where next to nothing is shown
SHOWN = 0.2  # of the hits, at least, to make out a place
CLEAR_SHOWN, CLEAR_SCORE, CLEAR_WRONG = 0.8, 0.8, 0.03  # a place beyond doubt, but for its likes
AGAINST = 0.1  # beams that the map rules out, more than elsewhere: it is not there
BEYOND_M = 3.0  # past the edge of what is known to be free
MAX_BLOCKS, MAX_TRIED, MAX_FOUND = 40_000, 192, 24
APART_M, APART_RAD = 0.3, math.radians(20)  # nearer ones are the same
SLID_M = 0.25  # a fit that went farther from where it began has become another place
WEAK = np.diag((1.0, 1.0, 1.0))  # information that holds a candidate where it was found

Bytes = NDArray[np.uint8]


class Candidate(NamedTuple):
    """A pose of the body that would explain the scan."""

    pose: Floats  # (3,)
    score: float  # as Fit's


def search(field: LikelihoodField, beams: Beams, last: Floats | None = None) -> list[Candidate]:
    """Return all poses in the map that explain a scan about equally well, the best first.

    The pose (3,) that was known `last` is among them if it explains the scan at all. Meant for a
    thread in the background.
    """
    hits = beams.hits
    if len(hits) < MIN_POINTS or not field.free.any():
        return []
    tried = _likely(field, hits)
    fits = [fit(field, beams, pose, WEAK) for pose in tried]
    stayed = [one for one, pose in zip(fits, tried, strict=True) if _near(one.pose, pose)]
    found = [Candidate(one.pose, one.score) for one in _distinct(field, stayed)]
    if last is None:
        return found
    here = fit(field, beams, last, WEAK)
    if here.score < MIN_SCORE or not apart(here.pose, (one.pose for one in found)):
        return found
    return [*found, Candidate(here.pose, here.score)]


def _likely(field: LikelihoodField, hits: Points) -> list[Floats]:
    """Return poses (3,) that put the hits near walls, the best first."""
    chosen = hits[np.linspace(0, len(hits) - 1, min(POINTS, len(hits))).astype(np.intp)]
    image = np.round(255 * np.exp(-0.5 * (field.distance / SIGMA) ** 2)).astype(np.uint8)
    image[image == UNKNOWN] += 1
    image[~field.shown] = UNKNOWN
    standing = _standing(field)
    bounds, headings = _bounds(image, standing, chosen, field.cell)
    places = _best_blocks(bounds)
    offsets = _turned(chosen, headings, field.cell)
    scores, cells = _inside(image, standing, offsets, places, bounds)
    tried: list[Floats] = []
    for k in np.argsort(-scores, kind="stable")[: 50 * MAX_TRIED]:
        if scores[k] < max(MIN_SCORE, scores.max() - BAND) or len(tried) == MAX_TRIED:
            break
        xy = field.origin + (cells[k] + 0.5) * field.cell
        pose = np.array((*xy, headings[places[k, 0]]))
        if apart(pose, tried):
            tried.append(pose)
    return tried


def _bounds(
    image: Bytes, standing: NDArray[np.bool_], points: Points, cell: float
) -> tuple[Bytes, Floats]:
    """Upper bounds (headings, rows, columns) of blocks, 0 to 255, and the headings [rad]."""
    reach = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 75))
    finest = min(max(STEP_M / max(reach, STEP_M), FINEST_RAD), COARSEST_RAD)
    headings = np.arange(0.0, math.tau, math.tau / math.ceil(math.tau / finest))
    best_within = dilated(image, 0, BLOCK - 1)
    some_free = dilated(standing.view(np.uint8), 0, BLOCK - 1)
    offsets = _turned(points, headings, cell)
    blocks = some_free[::BLOCK, ::BLOCK].copy()
    return _coarse(best_within, blocks, offsets), headings


def _turned(points: Points, headings: Floats, cell: float) -> NDArray[np.int64]:
    """Return the offset of each point from the body in cells (headings, points, 2)."""
    cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
    x, y = points[:, 0][None, :], points[:, 1][None, :]
    turned = np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)
    return np.floor(turned / cell + 0.5).astype(np.int64)


def _best_blocks(bounds: Bytes) -> NDArray[np.int64]:
    """Return the promising blocks (n, 3) as heading, row and column, the best first."""
    flat = bounds.ravel()
    worth = np.flatnonzero(flat >= round(255 * MIN_SCORE))
    order = np.argsort(-flat[worth].astype(np.int16), kind="stable")[:MAX_BLOCKS]
    return np.stack(np.unravel_index(worth[order], bounds.shape), axis=-1).astype(np.int64)


def apart(pose: Floats, others: Iterable[Floats]) -> bool:
    """Return whether `pose` is far from all `others`."""
    for other in others:
        off = pose - other
        near = math.hypot(off[0], off[1]) < APART_M
        if near and abs(float(wrap(off[2]))) < APART_RAD:
            return False
    return True


def _near(one: Floats, other: Floats) -> bool:
    return math.hypot(*(one - other)[:2]) <= SLID_M


def _distinct(field: LikelihoodField, fits: list[FieldFit]) -> list[FieldFit]:
    """Return the best fit of each place, the best first, without those the scan contradicts."""
    possible = [one for one in fits if one.shown >= SHOWN and one.likely >= _least(one.shown)]
    most = min((one.wrong for one in possible), default=0.0) + AGAINST
    found: list[FieldFit] = []
    for one in sorted(possible, key=lambda one: -one.score):
        new = one.wrong <= most and apart(one.pose, (other.pose for other in found))
        if new and len(found) < MAX_FOUND and not _outdone(field, one, found):
            found.append(one)
    return found


def _outdone(field: LikelihoodField, one: FieldFit, found: list[FieldFit]) -> bool:
    """Return whether another place is shown whole and fits, and is not the twin of this one.

    `one` is mostly not shown, and the map does not match itself when moved there.
    """
    if one.shown >= MIN_JUDGED or not found:
        return False
    best = found[0]
    clear = best.shown >= CLEAR_SHOWN and best.score >= CLEAR_SCORE and best.wrong <= CLEAR_WRONG
    return clear and not is_self_similar(field, compose(one.pose, inverse(best.pose)))


def _least(shown: float) -> float:
    """Return the least score of what is shown: the less is shown, the higher."""
    return MIN_SCORE + (MIN_SCORE_HIDDEN - MIN_SCORE) * max(0.0, 1.0 - shown / MIN_JUDGED)


def _standing(field: LikelihoodField) -> NDArray[np.bool_]:
    """Return the cells for the body: free ground, and unknown cells just past its edge."""
    standing = field.free.astype(np.uint8)
    open_ground = (field.free | ~field.shown).astype(np.uint8)
    for _ in range(round(BEYOND_M / field.cell)):  # step by step, as walls are in the way
        standing = np.minimum(dilated(standing, 1, 1), open_ground)
    return standing.astype(np.bool_)


@kernel
def _coarse(image: Bytes, some_free: Bytes, offsets: NDArray[np.int64]) -> Bytes:
    height, width = image.shape
    rows, columns = some_free.shape
    headings, count, _ = offsets.shape
    bounds = np.zeros((headings, rows, columns), np.uint8)
    for heading in range(headings):
        for row in range(rows):
            for column in range(columns):
                if not some_free[row, column]:
                    continue
                total = 0
                for k in range(count):
                    x = column * BLOCK + offsets[heading, k, 0]
                    y = row * BLOCK + offsets[heading, k, 1]
                    # a block that begins outside may end within
                    if -BLOCK < x < width and -BLOCK < y < height:
                        total += max(UNKNOWN, image[max(y, 0), max(x, 0)])
                    else:
                        total += UNKNOWN
                bounds[heading, row, column] = total // count
    return bounds


@kernel
def _inside(
    image: Bytes,
    free: NDArray[np.bool_],
    offsets: NDArray[np.int64],
    places: NDArray[np.int64],
    bounds: Bytes,
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the best score in each block and its cell (x, y); 0 for blocks that cannot win."""
    height, width = image.shape
    count, best = offsets.shape[1], 0.0
    scores, cells = np.zeros(len(places)), np.zeros((len(places), 2), np.int64)
    for place in range(len(places)):
        heading, row, column = places[place]
        enough = max(MIN_SCORE, best - BAND) * 255.0 * count
        if (bounds[heading, row, column] + 1) * count < enough:
            break  # those that follow are no better
        for y in range(row * BLOCK, min((row + 1) * BLOCK, height)):
            for x in range(column * BLOCK, min((column + 1) * BLOCK, width)):
                total = _total(image, offsets[heading], x, y, enough) if free[y, x] else 0
                score = total / (255.0 * count)
                if score > scores[place]:
                    scores[place] = score
                    cells[place, 0], cells[place, 1] = x, y
        best = max(best, scores[place])
    return scores, cells


@kernel
def _total(image: Bytes, offsets: NDArray[np.int64], x: int, y: int, enough: float) -> int:
    """Return the sum over all points; 0 if `enough` is out of reach or few are shown."""
    height, width = image.shape
    count, total, shown = len(offsets), 0, 0
    for k in range(count):
        at_x, at_y = x + offsets[k, 0], y + offsets[k, 1]
        likely = UNKNOWN
        if 0 <= at_x < width and 0 <= at_y < height:
            likely = int(image[at_y, at_x])
        total += likely
        shown += likely != UNKNOWN
        if total + 255 * (count - 1 - k) < enough:
            return 0
    return total if shown >= SHOWN * count else 0
