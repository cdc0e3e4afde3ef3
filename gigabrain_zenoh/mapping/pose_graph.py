"""Pose graph of keyframes, optimised incrementally (iSAM2, gtsam), and bounds of its drift.

M. Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012. Drift is
summed along the least uncertain path between two keyframes, an upper bound of what the graph
knows.
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

ANCHOR = 1e-3  # [m] and [rad], how firmly the first pose is held
ROBUST = 1.0  # standard deviations, doubtful edges beyond it lose their weight
MOVED = 0.01  # [m] and [rad], what moves farther is linearised again
NEVER = 1 << 30  # updates
ROUNDS = 3  # of that after loops are closed
PIECE = 1500  # poses solved for in one go; each takes 15 to 40 us
FAILURES = (RuntimeError, ValueError, IndexError)  # what gtsam's exceptions become in Python

JOINT = 0.03  # [m] and [rad], of every loop
GATE = 16.3  # 99.9 % of chi-square with three degrees of freedom


class Graph:
    """Poses of keyframes 0 to n - 1. One thread at a time.

    Closing a loop is done in pieces, as gtsam blocks all other threads.

    gtsam raises for a system that it takes for indeterminate, and cannot be used afterwards. The
    optimiser is then rebuilt with QR in place of Cholesky: slower, and it solves what Cholesky
    cannot. If that fails too, even without the newest loops, poses stay and no loop closes.
    """

    def __init__(self) -> None:
        self._isam: gtsam.ISAM2 | None = _optimiser("CHOLESKY")
        self._links: list[Edge] = []
        self.poses: Floats = np.empty((0, 3))
        self.loops: list[Edge] = []
        self._newest = 0  # loops that have not settled yet
        self._rounds = 0  # that are left
        self._round = 0  # poses solved for in the last of them
        self.rebuilt = 0  # how often the optimiser had to be
        self.failure = ""  # why no loop closes any more

    def extend(self, links: Iterable[Edge], poses: Floats | None = None) -> None:
        """Add keyframes, each by its link; at `poses` (n, 3), or where the links lead."""
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
            self._isam.update(*_linked(links, placed))
        except FAILURES as error:
            self._rebuild(error)

    def close(self, loops: Sequence[Edge], *, known: bool = False) -> bool:
        """Add loops, and begin to settle; whether that is done already.

        Those that cannot be closed are missing in `loops` afterwards, unless the poses are `known`
        to rest on them.
        """
        if known or self._isam:
            self.loops = [*self.loops, *loops]
        if self._isam is None:
            return True
        self._newest = 0 if known else len(loops)
        self._rounds, self._round = ROUNDS, len(self.poses)
        try:
            added = self._isam.update(_joined(loops), gtsam.Values())
            return self._settled(self._isam, added.getVariablesReeliminated())
        except FAILURES as error:
            self._rebuild(error)
            return True

    def settle(self) -> bool:
        """Go on moving all poses to where everything agrees best; whether that is done."""
        if self._isam is None:
            return True
        try:
            return self._settled(self._isam, 0)
        except FAILURES as error:
            self._rebuild(error)
            return True

    def _settled(self, isam: gtsam.ISAM2, solved: int) -> bool:
        """Update until the rounds are done or the piece is full; return whether they are done.

        `solved` poses of this piece have been solved for already.
        """
        while self._rounds:
            if solved and solved + self._round > PIECE:
                return False
            result = isam.update(force_relinearize=True)
            self._round = result.getVariablesReeliminated()
            self._rounds = self._rounds - 1 if result.getVariablesRelinearized() else 0
            solved += self._round
        self.poses, self._newest = _estimate(isam), 0
        return True

    def _rebuild(self, error: Exception) -> None:
        """Replace the optimiser that has raised `error`; it settles in one go, for that is rare."""
        self._rounds = 0
        self.rebuilt += 1
        settled = self.loops[: len(self.loops) - self._newest]
        for loops in (self.loops, settled) if self._newest else (settled,):
            isam = _optimiser("QR")
            try:
                isam.update(*_linked(self._links, self.poses))
                isam.update(_joined(loops), gtsam.Values())
                for _ in range(ROUNDS):
                    isam.update(force_relinearize=True)
                self.poses = _estimate(isam)
            except FAILURES as again:
                error = again
                continue
            self._isam, self.loops, self._newest = isam, loops, 0
            return
        self._isam, self.loops, self._newest = None, settled, 0
        self.failure = " ".join(str(error).split())[:120]


def _optimiser(factorization: str) -> gtsam.ISAM2:
    params = gtsam.ISAM2Params()
    params.setFactorization(factorization)
    params.setRelinearizeThreshold(MOVED)
    params.relinearizeSkip = NEVER  # unless it is asked for: it is what takes long
    return gtsam.ISAM2(params)


def _estimate(isam: gtsam.ISAM2) -> Floats:
    poses = np.array(gtsam.utilities.extractPose2(isam.calculateEstimate()))
    if not np.isfinite(poses).all():
        raise ValueError("poses that are no numbers")
    return poses


def _linked(
    links: Iterable[Edge], poses: Floats
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return factors and values of keyframes at their poses."""
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for link in links:
        if link.first == link.second:
            noise = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR)
            factors.add(gtsam.PriorFactorPose2(link.second, _pose(link.relative), noise))
        else:
            factors.add(_factor(link))
        values.insert(link.second, _pose(poses[link.second]))
    return factors, values


def _joined(loops: Iterable[Edge]) -> gtsam.NonlinearFactorGraph:
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
    cauchy = gtsam.noiseModel.mEstimator.Cauchy.Create(ROBUST)
    return gtsam.noiseModel.Robust.Create(cauchy, noise)


@dataclass(frozen=True, slots=True)
class DriftRates:
    """Upper bounds of the drift of matched scans."""

    away: float = 0.05  # [m] per square root of a metre driven
    turn: float = 0.01  # [rad] per square root of a metre driven


class Drift:
    """The ways between keyframes, with the variance of yaw [rad²] and of place [m²] on each."""

    def __init__(self, rates: DriftRates) -> None:
        self._rates = rates
        self._ways: dict[int, list[tuple[int, float, float]]] = defaultdict(list)

    def linked(self, link: Edge) -> None:
        """Add the link of a keyframe, unless it is the first."""
        if link.first == link.second:
            return
        if link.doubtful:
            away = float(link.covariance[:2, :2].trace()) / 2
            self._add(link, float(link.covariance[2, 2]), away)
        else:
            driven = float(np.hypot(*link.relative[:2]))
            self._add(link, self._rates.turn**2 * driven, self._rates.away**2 * driven)

    def closed(self, loop: Edge) -> None:
        """Add a loop that is beyond doubt."""
        self._add(loop, JOINT**2, JOINT**2)

    def _add(self, edge: Edge, turn: float, away: float) -> None:
        self._ways[edge.first].append((edge.second, turn, away))
        self._ways[edge.second].append((edge.first, turn, away))

    def explains(self, loop: Edge, poses: Floats) -> bool:
        """Return whether drift may explain the correction that closing `loop` would make."""
        return explained(loop, poses, *self.between(loop.first, loop.second, poses))

    def between(self, first: int, second: int, poses: Floats) -> tuple[float, float]:
        """Return the variance of yaw and of place on the least uncertain path (Dijkstra)."""
        turn, away = self._spread(second, poses, first)
        if not np.isfinite(turn[first]):
            raise ValueError(f"no way from keyframe {first} to {second}")
        return float(turn[first]), float(away[first])

    def spread(self, to: int, poses: Floats) -> tuple[Floats, Floats]:
        """Return the variances of yaw and of place from each keyframe to one of them, (n,) each."""
        return self._spread(to, poses)

    def _spread(self, to: int, poses: Floats, only: int | None = None) -> tuple[Floats, Floats]:
        far = poses[:, :2] - poses[to, :2]
        levers = (far * far).sum(axis=1).tolist()  # a turn on the way moves what is far from it
        turns, aways = np.full(len(poses), np.inf), np.full(len(poses), np.inf)
        queue = [(JOINT**2, JOINT**2, to)]
        done = set()
        while queue:
            turn, away, at = heapq.heappop(queue)
            if at in done:
                continue
            done.add(at)
            turns[at], aways[at] = turn, away
            if at == only:
                break
            for by, more_turn, more_away in self._ways[at]:
                if by not in done:
                    moved = away + more_away + more_turn * levers[at]
                    heapq.heappush(queue, (turn + more_turn, moved, by))
        return turns, aways


def explained(loop: Edge, poses: Floats, turn: float, away: float) -> bool:
    """Return whether drift of these variances may have brought about what the loop corrects."""
    x, y, yaw = between(between(poses[loop.first], poses[loop.second]), loop.relative)
    return bool((x * x + y * y) / away + yaw * yaw / turn < GATE)
