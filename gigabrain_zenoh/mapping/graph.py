"""The pose graph: keyframes joined by links and loops, optimised as it grows (iSAM2, in gtsam).

M. Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012.
"""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from gigabrain_zenoh.geometry.se2 import Floats, compose
from gigabrain_zenoh.mapping.keyframe import Edge

ANCHOR = 1e-3  # [m] and [rad], how firmly the first pose is held
ROBUST = 1.0  # standard deviations, doubtful edges beyond it lose their weight
MOVED = 0.01  # [m] and [rad], what moves farther is linearised anew
NEVER = 1 << 30  # updates
ROUNDS = 3  # of that after loops are closed
PIECE = 1500  # poses solved for anew take some 15 to 40 us each: so many in one go
FAILURES = (RuntimeError, ValueError, IndexError)  # what gtsam's exceptions become in Python


class Graph:
    """Poses of keyframes 0 to n - 1. One thread at a time.

    What closing a loop takes comes in pieces, as gtsam lets nobody else go on meanwhile.

    gtsam raises where it takes a system for indeterminate, and is of no use afterwards. The
    optimiser is rebuilt then, with QR in place of Cholesky: slower, and it solves what Cholesky
    cannot. Where that fails as well, even without the newest loops, poses stay and no loop closes.
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
        """Whether a piece of work, of which so many poses have been solved for, is the last."""
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
    """Keyframes by their links, and where they are."""
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
