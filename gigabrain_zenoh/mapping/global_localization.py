"""Global localization: finds all poses in the map that explain one scan.

Every block of 8 x 8 cells at every heading gets an upper bound of the scan's score; only the best
blocks are searched cell by cell (Olson 2009, Hess et al. 2016).
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

POINTS = 90  # of a scan, evenly sampled
MIN_POINTS = 20
SIGMA_M = 0.15  # wide enough for the steps between headings
BLOCK = 8  # cells
STEP_M, FINEST_RAD, COARSEST_RAD = 0.15, math.radians(1.0), math.radians(3.0)
MIN_SCORE = 0.5
NEUTRAL = 191  # of 255, likelihood of a hit that the map cannot judge
SCORE_BAND = 0.2  # below the best score, within which candidates are searched
MIN_SCORE_HIDDEN = 0.9  # replaces MIN_SCORE where the map can judge hardly any hit
MIN_SHOWN = 0.2  # share of the hits that the map must judge
CLEAR_SHOWN, CLEAR_SCORE, CLEAR_WRONG = 0.8, 0.8, 0.03  # of a place that only a twin can rival
MAX_MORE_WRONG = 0.1  # share of ruled-out beams above that of the best candidate
MAX_BEYOND_EDGE_M = 3.0  # from free cells into unknown ones
MAX_BLOCKS, MAX_TRIED, MAX_FOUND = 40_000, 192, 24
SAME_PLACE_M, SAME_PLACE_RAD = 0.3, math.radians(20)
MAX_SLIDE_M = 0.25  # a fit that moves farther is another place
WEAK_PRIOR = np.diag((1.0, 1.0, 1.0))  # information that holds a candidate where it was found

Bytes = NDArray[np.uint8]


class Candidate(NamedTuple):
    """A pose of the body that would explain the scan."""

    pose: Floats  # (3,)
    score: float  # see FieldFit


def search(field: LikelihoodField, beams: Beams, last: Floats | None = None) -> list[Candidate]:
    """Return all poses in the map that explain a scan about equally well, the best first.

    The `last` known pose (3,) is among them if it explains the scan at all. This is slow: call it
    in a background thread.
    """
    hits = beams.hits
    if len(hits) < MIN_POINTS or not field.free.any():
        return []
    tried = _promising_poses(field, hits)
    fits = [fit(field, beams, pose, WEAK_PRIOR) for pose in tried]
    kept = [one for one, pose in zip(fits, tried, strict=True) if _stayed(one.pose, pose)]
    found = [Candidate(one.pose, one.score) for one in _distinct(field, kept)]
    if last is None:
        return found
    at_last = fit(field, beams, last, WEAK_PRIOR)
    if at_last.score < MIN_SCORE or not apart(at_last.pose, (one.pose for one in found)):
        return found
    return [*found, Candidate(at_last.pose, at_last.score)]


def _promising_poses(field: LikelihoodField, hits: Points) -> list[Floats]:
    """Return poses (3,) that put the hits near walls, the best first."""
    sampled = hits[np.linspace(0, len(hits) - 1, min(POINTS, len(hits))).astype(np.intp)]
    image = np.round(255 * np.exp(-0.5 * (field.distance / SIGMA_M) ** 2)).astype(np.uint8)
    image[image == NEUTRAL] += 1
    image[~field.shown] = NEUTRAL
    body_cells = _where_body_may_be(field)
    bounds, headings = _bounds(image, body_cells, sampled, field.cell)
    places = _best_blocks(bounds)
    offsets = _point_offsets(sampled, headings, field.cell)
    scores, cells = _search_blocks(image, body_cells, offsets, places, bounds)
    tried: list[Floats] = []
    for k in np.argsort(-scores, kind="stable")[: 50 * MAX_TRIED]:
        if scores[k] < max(MIN_SCORE, scores.max() - SCORE_BAND) or len(tried) == MAX_TRIED:
            break
        xy = field.origin + (cells[k] + 0.5) * field.cell
        pose = np.array((*xy, headings[places[k, 0]]))
        if apart(pose, tried):
            tried.append(pose)
    return tried


def _bounds(
    image: Bytes, body_cells: NDArray[np.bool_], points: Points, cell: float
) -> tuple[Bytes, Floats]:
    """Return upper bounds of blocks (headings, rows, columns), 0 to 255, and the headings [rad]."""
    reach = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 75))
    step = min(max(STEP_M / max(reach, STEP_M), FINEST_RAD), COARSEST_RAD)
    headings = np.arange(0.0, math.tau, math.tau / math.ceil(math.tau / step))
    best_within = dilated(image, 0, BLOCK - 1)
    some_free = dilated(body_cells.view(np.uint8), 0, BLOCK - 1)
    offsets = _point_offsets(points, headings, cell)
    blocks = some_free[::BLOCK, ::BLOCK].copy()
    return _block_bounds(best_within, blocks, offsets), headings


def _point_offsets(points: Points, headings: Floats, cell: float) -> NDArray[np.int64]:
    """Return the offset of each point from the body in cells (headings, points, 2)."""
    cos, sin = np.cos(headings)[:, None], np.sin(headings)[:, None]
    x, y = points[:, 0][None, :], points[:, 1][None, :]
    turned = np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)
    return np.floor(turned / cell + 0.5).astype(np.int64)


def _best_blocks(bounds: Bytes) -> NDArray[np.int64]:
    """Return the promising blocks (n, 3) as heading, row and column, the best first."""
    flat = bounds.ravel()
    promising = np.flatnonzero(flat >= round(255 * MIN_SCORE))
    order = np.argsort(-flat[promising].astype(np.int16), kind="stable")[:MAX_BLOCKS]
    return np.stack(np.unravel_index(promising[order], bounds.shape), axis=-1).astype(np.int64)


def apart(pose: Floats, others: Iterable[Floats]) -> bool:
    """Return whether `pose` is far from all `others`."""
    for other in others:
        offset = pose - other
        near = math.hypot(offset[0], offset[1]) < SAME_PLACE_M
        if near and abs(float(wrap(offset[2]))) < SAME_PLACE_RAD:
            return False
    return True


def _stayed(fitted: Floats, start: Floats) -> bool:
    return math.hypot(*(fitted - start)[:2]) <= MAX_SLIDE_M


def _distinct(field: LikelihoodField, fits: list[FieldFit]) -> list[FieldFit]:
    """Return the best fit of each place, the best first, without those the scan contradicts."""
    possible = [
        one for one in fits if one.shown >= MIN_SHOWN and one.likely >= _min_score(one.shown)
    ]
    max_wrong = min((one.wrong for one in possible), default=0.0) + MAX_MORE_WRONG
    found: list[FieldFit] = []
    for one in sorted(possible, key=lambda one: -one.score):
        new = one.wrong <= max_wrong and apart(one.pose, (other.pose for other in found))
        if new and len(found) < MAX_FOUND and not _is_ruled_out_by_best(field, one, found):
            found.append(one)
    return found


def _is_ruled_out_by_best(field: LikelihoodField, one: FieldFit, found: list[FieldFit]) -> bool:
    """Return whether a clearly better place rules out `one`, which the map mostly does not show.

    It does not if the map matches itself when moved from one place to the other.
    """
    if one.shown >= MIN_JUDGED or not found:
        return False
    best = found[0]
    clear = best.shown >= CLEAR_SHOWN and best.score >= CLEAR_SCORE and best.wrong <= CLEAR_WRONG
    return clear and not is_self_similar(field, compose(one.pose, inverse(best.pose)))


def _min_score(shown: float) -> float:
    """Return the minimal score, which is higher if less is shown."""
    return MIN_SCORE + (MIN_SCORE_HIDDEN - MIN_SCORE) * max(0.0, 1.0 - shown / MIN_JUDGED)


def _where_body_may_be(field: LikelihoodField) -> NDArray[np.bool_]:
    """Return the cells where the body may be: free, or unknown and just past the edge of free."""
    body_cells = field.free.astype(np.uint8)
    open_cells = (field.free | ~field.shown).astype(np.uint8)
    for _ in range(round(MAX_BEYOND_EDGE_M / field.cell)):  # cell by cell, as walls block
        body_cells = np.minimum(dilated(body_cells, 1, 1), open_cells)
    return body_cells.astype(np.bool_)


@kernel
def _block_bounds(image: Bytes, some_free: Bytes, offsets: NDArray[np.int64]) -> Bytes:
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
                        total += max(NEUTRAL, image[max(y, 0), max(x, 0)])
                    else:
                        total += NEUTRAL
                bounds[heading, row, column] = total // count
    return bounds


@kernel
def _search_blocks(
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
        bar = max(MIN_SCORE, best - SCORE_BAND) * 255.0 * count
        if (bounds[heading, row, column] + 1) * count < bar:
            break  # the following ones are no better
        for y in range(row * BLOCK, min((row + 1) * BLOCK, height)):
            for x in range(column * BLOCK, min((column + 1) * BLOCK, width)):
                total = _total(image, offsets[heading], x, y, bar) if free[y, x] else 0
                score = total / (255.0 * count)
                if score > scores[place]:
                    scores[place] = score
                    cells[place, 0], cells[place, 1] = x, y
        best = max(best, scores[place])
    return scores, cells


@kernel
def _total(image: Bytes, offsets: NDArray[np.int64], x: int, y: int, bar: float) -> int:
    """Return the sum over all points; 0 if it cannot reach `bar`, or few points are shown."""
    height, width = image.shape
    count, total, shown = len(offsets), 0, 0
    for k in range(count):
        at_x, at_y = x + offsets[k, 0], y + offsets[k, 1]
        likelihood = NEUTRAL
        if 0 <= at_x < width and 0 <= at_y < height:
            likelihood = int(image[at_y, at_x])
        total += likelihood
        shown += likelihood != NEUTRAL
        if total + 255 * (count - 1 - k) < bar:
            return 0
    return total if shown >= MIN_SHOWN * count else 0
