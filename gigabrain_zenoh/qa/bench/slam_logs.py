"""Recorded laser logs, and what a map of theirs is worth.

R. Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 2009: a map is
judged by how poses that are near one another lie to each other, not by where they are.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.geometry.se2 import Floats, between, compose, inverse
from gigabrain_zenoh.mapping import arrays_file
from gigabrain_zenoh.mapping.points import Scan, from_beams

RANGE_MIN, RANGE_MAX = 0.1, 25.0  # [m], beyond them a beam says nothing
NEAR = 3.0  # [m], poses of a relation
DENSE = 0.3  # [m], a median step below it makes a dense log
GAP, DENSE_GAP = 30, 300  # scans between the poses of a relation
RELATIONS = 2000
SEED = 0
FIELDS = ("ranges", "ref", "odom")


@dataclass(frozen=True, slots=True)
class Log:
    """Scans and odometry in the order of recording, and poses that somebody corrected."""

    name: str
    ranges: Floats  # [m], (n, beams)
    reference: Floats  # (n, 3)
    odometry: Floats  # (n, 3)

    def scan(self, at: int) -> Scan:
        """One scan; beam i points to -90° + i 180°/beams."""
        beams = self.ranges.shape[1]
        angles = np.radians(-90.0 + np.arange(beams) * 180.0 / beams)
        return from_beams(angles, self.ranges[at], RANGE_MIN, RANGE_MAX)


class Errors(Struct, frozen=True, kw_only=True):
    """How far relations are from the reference."""

    mean_m: float
    std_m: float
    mean_deg: float
    std_deg: float


def load(path: Path) -> Log:
    """The log in an .npz file: `ranges` [cm], `ref` and `odom`. Raises ConfigError."""
    arrays = arrays_file.read(path, "no laser log")
    if missing := set(FIELDS) - arrays.keys():
        raise ConfigError(f"{path}: no {', '.join(sorted(missing))}; expected {', '.join(FIELDS)}")
    ranges, reference, odometry = (arrays[name] for name in FIELDS)
    count = len(ranges) if ranges.ndim == 2 else 0
    if count < 2 or ranges.shape[1] < 2 or not np.issubdtype(ranges.dtype, np.integer):
        raise ConfigError(f"{path}: ranges: expected whole centimetres, (scans, beams)")
    for name, poses in (("ref", reference), ("odom", odometry)):
        if poses.shape != (count, 3) or not np.issubdtype(poses.dtype, np.floating):
            raise ConfigError(f"{path}: {name}: expected poses of shape ({count}, 3)")
    return Log(path.stem, ranges / 100.0, reference.astype(float), odometry.astype(float))


def relations(log: Log, seed: int = SEED) -> NDArray[np.intp]:
    """Pairs of scans (k, 2) at places that were passed twice. Raises ConfigError without any."""
    places = log.reference[:, :2]
    step = float(np.median(np.hypot(*np.diff(places, axis=0).T)))
    gap = DENSE_GAP if step < DENSE else GAP
    pairs = [
        np.column_stack((np.full_like(later, first), later))
        for first in range(len(places) - gap - 1)
        if len(later := _near(places, first, first + gap + 1))
    ]
    if not pairs:
        raise ConfigError(f"{log.name}: no place is passed twice, so there is nothing to compare")
    every = np.concatenate(pairs)
    if len(every) <= RELATIONS:
        return every
    return every[np.random.default_rng(seed).choice(len(every), RELATIONS, replace=False)]


def _near(places: Floats, first: int, start: int) -> NDArray[np.intp]:
    away = np.hypot(*(places[start:] - places[first]).T)
    return np.flatnonzero(away < NEAR) + start


def errors(log: Log, poses: Floats, pairs: NDArray[np.intp]) -> Errors:
    """How `poses` (n, 3) compare with the reference over `pairs`."""
    first, second = pairs.T
    wanted = between(log.reference[first], log.reference[second])
    off = between(wanted, between(poses[first], poses[second]))
    away, turn = np.hypot(off[:, 0], off[:, 1]), np.degrees(np.abs(off[:, 2]))
    return Errors(
        mean_m=float(away.mean()),
        std_m=float(away.std()),
        mean_deg=float(turn.mean()),
        std_deg=float(turn.std()),
    )


def laid_onto(poses: Floats, reference: Floats) -> Floats:
    """Return `poses` (n, 3) moved as one, so that their places fit `reference` best (Umeyama)."""
    one, other = poses[:, :2], reference[:, :2]
    spread = (one - one.mean(axis=0)).T @ (other - other.mean(axis=0))
    turn = float(np.arctan2(spread[0, 1] - spread[1, 0], spread[0, 0] + spread[1, 1]))
    about = np.array((*one.mean(axis=0), 0.0))
    return compose(np.array((*other.mean(axis=0), turn)), compose(inverse(about), poses))
