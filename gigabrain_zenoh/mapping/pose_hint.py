"""Poses near a hint that explain a scan: a tag or a person says roughly where the robot is.

The hint's ellipsoid is sampled, and the likeliest samples are fitted to the scan. Fits far from the
hint are dropped. A hint never moves the robot to where the scan does not fit.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import inverse_of
from gigabrain_zenoh.mapping.global_localization import MIN_POINTS, Candidate, apart
from gigabrain_zenoh.mapping.keyframes import Beams, Points
from gigabrain_zenoh.mapping.likelihood_field import LikelihoodField, fit

MAX_SIGMAS = 2.0  # of the hint, that are sampled
STEP_M = 0.12  # between samples
LEVER_M = 1.5  # metres of a step per rad of a turn
MAX_SAMPLES, SAMPLES_AT_ONCE = 20_000, 1000
POINTS = 90  # of a scan, evenly sampled
SIGMA_M = 0.15  # deviation of hits from walls
NEUTRAL = 0.75  # likelihood of a hit that the map cannot judge, as in the global search
MAX_TRIED, MAX_FOUND = 12, 4
MIN_SCORE, MIN_SHOWN = 0.5, 0.2
PRIOR = np.diag((1.0, 1.0, 1.0))  # information that holds a fit at its sample
FAR_SIGMAS = 4.0  # off the hint: the robot's pose is wrong, or the tag was moved
MIN_LEAVE_SCORE, MIN_LEAVE_GAIN = 0.65, 0.15  # of a place to which a localized robot is moved
OFF_COST = 0.02  # of the score, for one standard deviation off the hint


class PoseHint(NamedTuple):
    """A rough pose of the robot in its map."""

    pose: Floats  # (3,)
    covariance: Floats  # (3, 3), in the map's axes


def explained(field: LikelihoodField, beams: Beams, hint: PoseHint) -> list[Candidate]:
    """Return the poses within the hint that explain a scan, the best first."""
    if len(beams.hits) < MIN_POINTS:
        return []
    samples = _samples(hint)
    likelihoods = _likelihoods(field, beams.hits, samples)
    tried: list[Floats] = []
    for k in np.argsort(-likelihoods, kind="stable")[: 20 * MAX_TRIED]:
        if len(tried) < MAX_TRIED and apart(samples[k], tried):
            tried.append(samples[k])
    fits = [fit(field, beams, pose, PRIOR) for pose in tried]
    good = [
        (Candidate(one.pose, one.score), _squared_deviation(hint, one.pose))
        for one in fits
        if one.score >= MIN_SCORE and one.shown >= MIN_SHOWN
    ]
    good = [one for one in good if one[1] <= (MAX_SIGMAS + 1.0) ** 2]
    found: list[Candidate] = []
    for one, _ in sorted(good, key=lambda pair: OFF_COST * pair[1] - pair[0].score):
        if len(found) < MAX_FOUND and apart(one.pose, (other.pose for other in found)):
            found.append(one)
    return found


def far_from(hint: PoseHint, pose: Floats) -> bool:
    """Return whether `pose` contradicts the hint."""
    return _squared_deviation(hint, pose) > FAR_SIGMAS**2


def better(field: LikelihoodField, beams: Beams, hint: PoseHint, pose: Floats) -> list[Candidate]:
    """Return the poses within the hint that explain a scan, if they are better than `pose`.

    So a tag that was moved does not mislead a robot whose scan fits at its own pose.
    """
    found = explained(field, beams, hint)
    if not found or found[0].score < MIN_LEAVE_SCORE:
        return []
    return found if found[0].score > fit(field, beams, pose, PRIOR).score + MIN_LEAVE_GAIN else []


def _samples(hint: PoseHint) -> Floats:
    """Return poses (n, 3) in a lattice along the axes of the hint's ellipsoid."""
    scale = np.array((1.0, 1.0, LEVER_M))
    values, axes = np.linalg.eigh(hint.covariance * np.outer(scale, scale))
    reaches = MAX_SIGMAS * np.sqrt(np.maximum(values, 1e-12))
    reaches = np.minimum(reaches, math.pi * LEVER_M)
    step = STEP_M
    while np.prod(2 * np.ceil(reaches / step) + 1) > MAX_SAMPLES:
        step *= 1.2
    counts = np.ceil(reaches / step).astype(int)
    lines = [np.linspace(-end, end, 2 * n + 1) for end, n in zip(reaches, counts, strict=True)]
    lattice = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = (np.square(lattice / np.maximum(reaches, 1e-9)).sum(axis=1) <= 1.01) | (
        np.abs(lattice).max(axis=1) < 1e-9
    )
    return np.asarray(hint.pose + (lattice[inside] @ axes.T) / scale, np.float64)


def _likelihoods(field: LikelihoodField, hits: Points, samples: Floats) -> Floats:
    """Return how near the hits of a scan are to walls at each sample (n,), 0 to 1."""
    sampled = hits[np.linspace(0, len(hits) - 1, min(POINTS, len(hits))).astype(np.intp)]
    image = np.exp(-0.5 * (field.distance / SIGMA_M) ** 2)
    image[~field.shown] = NEUTRAL
    found = [
        _mean_likelihood(image, field, sampled, samples[k : k + SAMPLES_AT_ONCE])
        for k in range(0, len(samples), SAMPLES_AT_ONCE)
    ]
    return np.concatenate(found)


def _mean_likelihood(
    image: NDArray[np.floating], field: LikelihoodField, hits: Points, samples: Floats
) -> Floats:
    cos, sin = np.cos(samples[:, 2])[:, None], np.sin(samples[:, 2])[:, None]
    x = samples[:, :1] + cos * hits[:, 0] - sin * hits[:, 1]
    y = samples[:, 1:2] + sin * hits[:, 0] + cos * hits[:, 1]
    columns = np.floor((x - field.origin[0]) / field.cell).astype(np.intp)
    rows = np.floor((y - field.origin[1]) / field.cell).astype(np.intp)
    height, width = image.shape
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    values = image[np.where(inside, rows, 0), np.where(inside, columns, 0)]
    return np.asarray(np.where(inside, values, NEUTRAL).mean(axis=1), np.float64)


def _squared_deviation(hint: PoseHint, pose: Floats) -> float:
    """Return the squared Mahalanobis distance of `pose` from the hint."""
    offset = pose - hint.pose
    offset[2] = math.remainder(offset[2], math.tau)
    slack = np.diag((STEP_M, STEP_M, STEP_M / LEVER_M)) ** 2  # of the map and the lattice
    spread = inverse_of(hint.covariance + slack)
    return float(offset @ spread @ offset)
