"""The pose graph: keyframes joined by links and loops, optimised as it grows (iSAM2, in gtsam).

M. Kaess et al., iSAM2: Incremental smoothing and mapping using the Bayes tree, IJRR 2012.
"""

from collections.abc import Iterable

import gtsam
import numpy as np

from gigabrain_zenoh.mapping.keyframe import Edge
from gigabrain_zenoh.mapping.se2 import Floats, compose

ANCHOR = 1e-3  # [m] and [rad], how firmly the first pose is held
ROBUST = 1.0  # standard deviations, doubtful edges beyond it lose their weight
MOVED = 0.01  # [m] and [rad], what moves farther is linearised anew
NEVER = 1 << 30  # updates
ROUNDS = 3  # of that after loops are closed
PIECE = 1500  # poses solved for anew take some 15 to 40 us each: so many in one go


class Graph:
    """Poses of keyframes 0 to n - 1. One thread at a time.

    What closing a loop takes comes in pieces, as gtsam lets nobody else go on meanwhile.
    """

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(MOVED)
        params.relinearizeSkip = NEVER  # unless it is asked for: it is what takes long
        self._isam = gtsam.ISAM2(params)
        self.poses: Floats = np.empty((0, 3))
        self.loops: list[Edge] = []
        self._rounds = 0  # that are left
        self._round = 0  # poses solved for in the last of them

    def extend(self, links: Iterable[Edge], poses: Floats | None = None) -> None:
        """Add keyframes, each by its link; at `poses` (n, 3), or where the links lead."""
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        links, known = list(links), len(self.poses)
        placed = np.concatenate((self.poses, np.empty((len(links), 3))))
        for at, link in enumerate(links, known):
            if link.first == link.second:
                noise = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR)
                factors.add(gtsam.PriorFactorPose2(link.second, _pose(link.relative), noise))
                led = link.relative
            else:
                factors.add(_factor(link))
                led = compose(placed[link.first], link.relative)
            placed[at] = led if poses is None else poses[link.second]
            values.insert(link.second, _pose(placed[at]))
        self._isam.update(factors, values)
        self.poses = placed

    def close(self, loops: Iterable[Edge]) -> bool:
        """Add loops, and begin to settle; whether that is done already."""
        factors = gtsam.NonlinearFactorGraph()
        for loop in loops:
            factors.add(_factor(loop))
            self.loops.append(loop)
        added = self._isam.update(factors, gtsam.Values())
        self._rounds, self._round = ROUNDS, len(self.poses)
        return self._settled(added.getVariablesReeliminated())

    def settle(self) -> bool:
        """Go on moving all poses to where everything agrees best; whether that is done."""
        return self._settled(0)

    def _settled(self, solved: int) -> bool:
        """Whether a piece of work, of which so many poses have been solved for, is the last."""
        while self._rounds:
            if solved and solved + self._round > PIECE:
                return False
            result = self._isam.update(force_relinearize=True)
            self._round = result.getVariablesReeliminated()
            self._rounds = self._rounds - 1 if result.getVariablesRelinearized() else 0
            solved += self._round
        self.poses = np.array(gtsam.utilities.extractPose2(self._isam.calculateEstimate()))
        return True


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
