"""Pose graph of keyframes, optimised incrementally (iSAM2, gtsam), and bounds of its drift.

M. Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012. Drift is
summed along the least uncertain path between two keyframes: an upper bound.
"""

import heapq
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.geometry.se2 import between, compose
from gigabrain_zenoh.mapping.keyframes import Edge

ANCHOR_SIGMA = 1e-3  # [m] and [rad], of the first pose
ROBUST_SIGMAS = 1.0  # doubtful edges with larger residuals lose their weight
RELINEARIZE_THRESHOLD = 0.01  # [m] and [rad], poses that move farther are linearised again
RELINEARIZE_SKIP = 1 << 30  # updates: as linearising takes long, it happens only when forced
RELINEARIZATIONS = 3  # after loops are closed
MAX_POSES_AT_ONCE = 1500  # solved for in one go; each takes 15 to 40 us
GTSAM_ERRORS = (RuntimeError, ValueError, IndexError)  # as Python sees its exceptions

LOOP_SIGMA = 0.03  # [m] and [rad]
CHI_SQUARE_LIMIT = 16.3  # 99.9 %, three degrees of freedom


class Graph:
    """Poses of keyframes 0 to n - 1. One thread at a time.

    Loops are closed in pieces, as gtsam blocks all other threads.

    If gtsam takes a system for indeterminate, it raises, and cannot be used afterwards. The
    optimiser is then rebuilt with QR instead of Cholesky: slower, but it solves more. If that fails
    too, even without the newest loops, poses stay and no loop closes.
    """

    def __init__(self) -> None:
        self._isam: gtsam.ISAM2 | None = _optimiser("CHOLESKY")
        self._links: list[Edge] = []
        self.poses: Floats = np.empty((0, 3))
        self.loops: list[Edge] = []
        self._unsettled = 0  # newest loops, not yet settled
        self._rounds_left = 0
        self._poses_per_round = 0  # that the last round solved for
        self.rebuilt = 0  # times that the optimiser was rebuilt
        self.failure = ""  # reason why no more loops are closed

    def extend(self, links: Iterable[Edge], poses: Floats | None = None) -> None:
        """Add keyframes by their links, at `poses` (n, 3) or where the links lead."""
        links, known = list(links), len(self.poses)
        placed = np.concatenate((self.poses, np.empty((len(links), 3))))
        for at, link in enumerate(links, known):
            first = link.first == link.second
            led = link.relative if first else compose(placed[link.first], link.relative)
            placed[at] = led if poses is None else poses[link.second]
        self.poses = placed
        self._links += links
        if self._isam is None:
            return
        try:
            self._isam.update(*_keyframe_factors(links, placed))
        except GTSAM_ERRORS as error:
            self._rebuild(error)

    def close(self, loops: Sequence[Edge], *, known: bool = False) -> bool:
        """Add loops, and start to settle; return whether that is done.

        Loops that cannot be closed are missing in `self.loops` afterwards, unless the poses are
        `known` to include them.
        """
        if known or self._isam:
            self.loops = [*self.loops, *loops]
        if self._isam is None:
            return True
        self._unsettled = 0 if known else len(loops)
        self._rounds_left, self._poses_per_round = RELINEARIZATIONS, len(self.poses)
        try:
            added = self._isam.update(_loop_factors(loops), gtsam.Values())
            return self._settled(self._isam, added.getVariablesReeliminated())
        except GTSAM_ERRORS as error:
            self._rebuild(error)
            return True

    def settle(self) -> bool:
        """Continue to move all poses to the optimum; return whether that is done."""
        if self._isam is None:
            return True
        try:
            return self._settled(self._isam, 0)
        except GTSAM_ERRORS as error:
            self._rebuild(error)
            return True

    def _settled(self, isam: gtsam.ISAM2, solved: int) -> bool:
        """Update until the rounds are done or the piece is full; return whether they are done.

        `solved` is the number of poses that this piece has solved for already.
        """
        while self._rounds_left:
            if solved and solved + self._poses_per_round > MAX_POSES_AT_ONCE:
                return False
            result = isam.update(force_relinearize=True)
            self._poses_per_round = result.getVariablesReeliminated()
            self._rounds_left = self._rounds_left - 1 if result.getVariablesRelinearized() else 0
            solved += self._poses_per_round
        self.poses, self._unsettled = _estimate(isam), 0
        return True

    def _rebuild(self, error: Exception) -> None:
        """Replace the optimiser that raised `error`; as that is rare, it settles in one go."""
        self._rounds_left = 0
        self.rebuilt += 1
        settled = self.loops[: len(self.loops) - self._unsettled]
        for loops in (self.loops, settled) if self._unsettled else (settled,):
            isam = _optimiser("QR")
            try:
                isam.update(*_keyframe_factors(self._links, self.poses))
                isam.update(_loop_factors(loops), gtsam.Values())
                for _ in range(RELINEARIZATIONS):
                    isam.update(force_relinearize=True)
                self.poses = _estimate(isam)
            except GTSAM_ERRORS as new_error:
                error = new_error
                continue
            self._isam, self.loops, self._unsettled = isam, loops, 0
            return
        self._isam, self.loops, self._unsettled = None, settled, 0
        self.failure = " ".join(str(error).split())[:120]


def _optimiser(factorization: str) -> gtsam.ISAM2:
    params = gtsam.ISAM2Params()
    params.setFactorization(factorization)
    params.setRelinearizeThreshold(RELINEARIZE_THRESHOLD)
    params.relinearizeSkip = RELINEARIZE_SKIP
    return gtsam.ISAM2(params)


def _estimate(isam: gtsam.ISAM2) -> Floats:
    poses = np.array(gtsam.utilities.extractPose2(isam.calculateEstimate()))
    if not np.isfinite(poses).all():
        raise ValueError("poses that are no numbers")
    return poses


def _keyframe_factors(
    links: Iterable[Edge], poses: Floats
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return the factors and values of keyframes at `poses`."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for link in links:
        if link.first == link.second:
            noise = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_SIGMA)
            factors.add(gtsam.PriorFactorPose2(link.second, _pose(link.relative), noise))
        else:
            factors.add(_factor(link))
        values.insert(link.second, _pose(poses[link.second]))
    return factors, values


def _loop_factors(loops: Iterable[Edge]) -> gtsam.NonlinearFactorGraph:
    factors = gtsam.NonlinearFactorGraph()
    for loop in loops:
        factors.add(_factor(loop))
    return factors


def _pose(pose: Floats) -> gtsam.Pose2:
    return gtsam.Pose2(*map(float, pose))


def _factor(edge: Edge) -> gtsam.BetweenFactorPose2:
    return gtsam.BetweenFactorPose2(edge.first, edge.second, _pose(edge.relative), _noise(edge))


def _noise(edge: Edge) -> gtsam.noiseModel.Base:
    noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
    if not edge.doubtful:
        return noise
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST_SIGMAS)
    return gtsam.noiseModel.Robust.Create(cauchy, noise)


@dataclass(frozen=True, slots=True)
class DriftRates:
    """Upper bounds of the drift of matched scans."""

    away: float = 0.05  # [m] per square root of a metre driven
    turn: float = 0.01  # [rad] per square root of a metre driven


class Drift:
    """Variances of yaw [rad²] and position [m²] that drift adds along the edges of the graph."""

    def __init__(self, rates: DriftRates) -> None:
        self._rates = rates
        self._edges: dict[int, list[tuple[int, float, float]]] = defaultdict(list)

    def add_link(self, link: Edge) -> None:
        """Add the link of a keyframe, unless it is the first."""
        if link.first == link.second:
            return
        if link.doubtful:
            away = float(link.covariance[:2, :2].trace()) / 2
            self._add(link, float(link.covariance[2, 2]), away)
        else:
            driven = float(np.hypot(*link.relative[:2]))
            self._add(link, self._rates.turn**2 * driven, self._rates.away**2 * driven)

    def add_loop(self, loop: Edge) -> None:
        """Add a confirmed loop."""
        self._add(loop, LOOP_SIGMA**2, LOOP_SIGMA**2)

    def _add(self, edge: Edge, turn: float, away: float) -> None:
        self._edges[edge.first].append((edge.second, turn, away))
        self._edges[edge.second].append((edge.first, turn, away))

    def explains(self, loop: Edge, poses: Floats) -> bool:
        """Return whether drift may explain the correction by `loop`."""
        return explained(loop, poses, *self.between(loop.first, loop.second, poses))

    def between(self, first: int, second: int, poses: Floats) -> tuple[float, float]:
        """Return the variances of yaw and position on the least uncertain path (Dijkstra)."""
        turn, away = self._variances(second, poses, first)
        if not np.isfinite(turn[first]):
            raise ValueError(f"no way from keyframe {first} to {second}")
        return float(turn[first]), float(away[first])

    def spread(self, to: int, poses: Floats) -> tuple[Floats, Floats]:
        """Return the variances of yaw and position from each keyframe to `to`, (n,) each."""
        return self._variances(to, poses)

    def _variances(self, to: int, poses: Floats, goal: int | None = None) -> tuple[Floats, Floats]:
        far = poses[:, :2] - poses[to, :2]
        squared_levers = (far * far).sum(axis=1).tolist()  # a turn moves what is far from it
        turns, aways = np.full(len(poses), np.inf), np.full(len(poses), np.inf)
        queue = [(LOOP_SIGMA**2, LOOP_SIGMA**2, to)]
        done = set()
        while queue:
            turn, away, at = heapq.heappop(queue)
            if at in done:
                continue
            done.add(at)
            turns[at], aways[at] = turn, away
            if at == goal:
                break
            for neighbour, more_turn, more_away in self._edges[at]:
                if neighbour not in done:
                    new_away = away + more_away + more_turn * squared_levers[at]
                    heapq.heappush(queue, (turn + more_turn, new_away, neighbour))
        return turns, aways


def explained(loop: Edge, poses: Floats, turn: float, away: float) -> bool:
    """Return whether drift of these variances may explain the correction by `loop`."""
    x, y, yaw = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool((x * x + y * y) / away + yaw * yaw / turn < CHI_SQUARE_LIMIT)
