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
ROUNDS = 3  # of that after loops are closed


class Graph:
    """Poses of keyframes 0 to n - 1. One thread at a time."""

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(MOVED)
        params.relinearizeSkip = 1
        self._isam = gtsam.ISAM2(params)
        self.poses: Floats = np.empty((0, 3))
        self.loops: list[Edge] = []

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

    def close(self, loops: Iterable[Edge]) -> None:
        """Add loops, and move all poses to where everything agrees best."""
        factors = gtsam.NonlinearFactorGraph()
        for loop in loops:
            factors.add(_factor(loop))
            self.loops.append(loop)
        self._isam.update(factors, gtsam.Values())
        for _ in range(ROUNDS):
            if not self._isam.update().getVariablesRelinearized():
                break
        self.poses = np.array(gtsam.utilities.extractPose2(self._isam.calculateEstimate()))


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
