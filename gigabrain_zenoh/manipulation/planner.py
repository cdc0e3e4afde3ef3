"""Plans collision-free paths of postures: RRT-Connect, then shortcuts.

Kuffner and LaValle, RRT-Connect: an efficient approach to single-query path planning, ICRA 2000.
"""

import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.manipulation.collision import CollisionChecker

BRANCH_LENGTH = 0.5  # [rad] or [m], of the joint that moves most
SHORTCUTS = 40  # tries
MAX_OVERLAP_M = 0.01  # of a start in collision; from a deeper one no path is planned
ESCAPE_LENGTHS = (0.02, 0.05, 0.1)  # [rad] or [m], of the joint that moves most
ESCAPE_TRIES = 40  # random directions for each length
ESCAPE_PARTS = 4  # of the way, between which the clearance is checked
TIME_LIMIT_S = 2.0

NoPathCause = Literal["limits", "start", "goal", "time"]


@dataclass(frozen=True, kw_only=True, eq=False)
class JointPath:
    """Postures from the start to the goal; straight lines between them touch nothing."""

    postures: Floats  # (k, n) [rad] or [m]


@dataclass(frozen=True, kw_only=True)
class NoPath:
    """The reason for a missing path."""

    cause: NoPathCause
    reason: str  # for people


class Tree:
    """Postures reachable from a root, each by a straight line from an earlier one."""

    def __init__(self, root: Floats) -> None:
        self._postures = np.empty((256, len(root)))
        self._parents = [-1]
        self._postures[0] = root

    def nearest(self, posture: Floats) -> int:
        """Return the number of the nearest posture."""
        off = self._postures[: len(self._parents)] - posture
        return int(np.argmin(np.einsum("ij,ij->i", off, off)))

    def posture(self, number: int) -> Floats:
        """Return a posture (n,) by its number."""
        return np.asarray(self._postures[number])

    def add(self, posture: Floats, parent: int) -> int:
        """Add a posture with the number of its parent, and return its own number."""
        number = len(self._parents)
        if number == len(self._postures):
            self._postures = np.concatenate((self._postures, np.empty_like(self._postures)))
        self._postures[number] = posture
        self._parents.append(parent)
        return number

    def path_to(self, number: int) -> list[Floats]:
        """Return the postures from the root to the one with this number."""
        found = []
        while number >= 0:
            found.append(self._postures[number].copy())
            number = self._parents[number]
        return found[::-1]


def plan(
    checker: CollisionChecker,
    start: Floats,
    goal: Floats,
    *,
    seed: int = 0,
    time_limit: float = TIME_LIMIT_S,
) -> JointPath | NoPath:
    """Return a path of postures from `start` to `goal` (n,), or the reason for its absence.

    The same `seed` gives the same path, unless the search ends at `time_limit` [s]. A start in
    collision is left first, if the overlap is small: servos do not stop exactly at their goals.
    """
    for name, posture in (("start", start), ("goal", goal)):
        if not checker.arm.inside(posture):
            return NoPath(cause="limits", reason=f"the {name} is outside the limits of the joints")
    if touches := checker.touches(goal):
        return NoPath(cause="goal", reason=f"the goal collides: {touches}")
    random, until, begin = np.random.default_rng(seed), time.monotonic() + time_limit, start
    if touches := checker.touches(start):
        free_start = _escape(checker, start, random)
        if free_start is None:
            return NoPath(cause="start", reason=f"the start collides: {touches}")
        begin = free_start
    way = [begin, goal]
    if not checker.is_line_free(begin, goal):
        found = _connect_trees(checker, begin, goal, random, until)
        if found is None:
            return NoPath(cause="time", reason=f"no path was found within {time_limit:g} s")
        way = _shorten(checker, found, random)
    return JointPath(postures=np.array(way if begin is start else [start, *way]))


def _escape(checker: CollisionChecker, start: Floats, random: np.random.Generator) -> Floats | None:
    """Return a free posture near a start in collision; on the way, clearance does not shrink."""
    nearest = checker.clearance(start).distance
    if nearest < -MAX_OVERLAP_M:
        return None
    for length in ESCAPE_LENGTHS:
        for _ in range(ESCAPE_TRIES):
            way = random.uniform(-1.0, 1.0, len(start))
            way *= length / np.abs(way).max()
            if not (checker.arm.inside(start + way) and checker.is_free(start + way)):
                continue
            parts = (start + way * k / ESCAPE_PARTS for k in range(1, ESCAPE_PARTS))
            if all(checker.clearance(part).distance >= nearest for part in parts):
                return np.asarray(start + way)
    return None


def _connect_trees(
    checker: CollisionChecker,
    start: Floats,
    goal: Floats,
    random: np.random.Generator,
    until: float,
) -> list[Floats] | None:
    """Grow a tree from each end towards random postures and each other, until they meet."""
    arm = checker.arm
    growing, other = Tree(start), Tree(goal)
    forwards = True
    while time.monotonic() < until:
        aim = random.uniform(arm.lower, arm.upper)
        new, _ = _extend(checker, growing, growing.nearest(aim), aim)
        if new >= 0:
            aim = growing.posture(new).copy()
            number, arrived = other.nearest(aim), False
            while number >= 0 and not arrived:
                number, arrived = _extend(checker, other, number, aim)
            if arrived:
                ways = growing.path_to(new), other.path_to(number)
                first, second = ways if forwards else ways[::-1]
                return [*first, *second[-2::-1]]
        growing, other, forwards = other, growing, not forwards
    return None


def _extend(checker: CollisionChecker, tree: Tree, number: int, aim: Floats) -> tuple[int, bool]:
    """Add a branch towards `aim`; return its number (-1: none), and whether it reaches `aim`."""
    here = tree.posture(number).copy()
    length = float(np.abs(aim - here).max())
    arrives = length <= BRANCH_LENGTH
    new = aim if arrives else here + (aim - here) * (BRANCH_LENGTH / length)
    if checker.is_free(new) and checker.is_line_free(here, new):
        return tree.add(new, number), arrives
    return -1, False


def _shorten(
    checker: CollisionChecker, way: list[Floats], random: np.random.Generator
) -> list[Floats]:
    """Replace parts of a way by straight lines."""
    way = _without_detours(checker, way)
    for _ in range(SHORTCUTS):
        if len(way) < 3:
            break
        lengths = np.array([float(np.linalg.norm(b - a)) for a, b in pairwise(way)])
        ends = np.sort(random.uniform(0.0, lengths.sum(), 2))
        (i, first), (k, second) = (_point_along(way, lengths, end) for end in ends)
        if i != k and checker.is_line_free(first, second):
            way = [*way[: i + 1], first, second, *way[k + 1 :]]
    return _without_detours(checker, way)


def _without_detours(checker: CollisionChecker, way: list[Floats]) -> list[Floats]:
    """Go from each posture to the last one that a free straight line reaches."""
    kept, here = [way[0]], 0
    while here < len(way) - 1:
        ahead = range(len(way) - 1, here + 1, -1)
        here = next((k for k in ahead if checker.is_line_free(way[here], way[k])), here + 1)
        kept.append(way[here])
    return kept


def _point_along(way: list[Floats], lengths: Floats, length: float) -> tuple[int, Floats]:
    """Return the part of a way at `length` from its start, and the posture there."""
    ends = np.cumsum(lengths)
    part = min(int(np.searchsorted(ends, length)), len(lengths) - 1)
    share = 1.0 - (ends[part] - length) / max(float(lengths[part]), 1e-12)
    return part, way[part] + (way[part + 1] - way[part]) * share
