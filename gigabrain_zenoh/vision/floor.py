"""The floor: a plane that is fitted to each depth picture, and tracked between them.

With an exact mounting and without tilt, it would be z = 0 in the body's frame. Both errors are so
small that the fit can never reach a table top, a wall or a ramp.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats

OFFSET_M, SLOPE = 0.004, 0.009  # standard deviations before the first picture: 4 mm, 0.5 degrees
MAX_OFFSET_M, MAX_SLOPE = 0.015, 0.035  # 1.5 cm and 2 degrees: mounting and tilt together
WALK_OFFSET_M, WALK_SLOPE = 0.001, 0.006  # standard deviations of the change per picture
ROUGH_M = 0.003  # standard deviation of a real floor from its plane
REACHES_M = (0.6, 1.0, 1.6, 2.4, 3.2, 3.2)  # of the rounds of a fit, from near to far
GATE = 3.0  # largest distance of floor points from the plane, in standard deviations
INDEPENDENT = 60.0  # largest number of independent points in a picture
MIN_POINTS = 60  # for a floor in view


@dataclass(frozen=True, slots=True)
class FloorPlane:
    """Height of the floor, `offset` + `slope_x` x + `slope_y` y, in the body's frame."""

    coefficients: Floats  # (3,): offset [m], slope_x, slope_y
    covariance: Floats  # (3, 3)
    seen: bool = False  # in the newest picture

    def sigma(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the standard deviation of its height at points [m]."""
        return np.asarray(np.sqrt(self.variance(x, y)))

    def variance(self, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return the variance of its height at points [m2]."""
        c = self.covariance
        along = x * (2 * c[0, 1] + c[1, 1] * x)
        across = y * (2 * c[0, 2] + c[2, 2] * y + 2 * c[1, 2] * x)
        return np.asarray(np.maximum(c[0, 0] + along + across, 0.0))


def unseen_floor() -> FloorPlane:
    """Return the floor before the first picture."""
    return FloorPlane(np.zeros(3), np.diag((OFFSET_M, SLOPE, SLOPE)) ** 2)


def fit_floor(before: FloorPlane, points: Floats, sigma: Floats) -> FloorPlane:
    """Return the floor in a picture of `points` (n, 3) in the body's frame.

    `sigma` (n,) is the standard deviation of each height [m]. The fit starts near the robot and
    extends outwards, so that only a continuation of the near floor counts as floor. If too little
    of it is in view, `before` is kept.
    """
    walk = np.diag((WALK_OFFSET_M, WALK_SLOPE, WALK_SLOPE)) ** 2
    predicted = FloorPlane(before.coefficients, _bounded(before.covariance + walk))
    distance = np.hypot(points[:, 0], points[:, 1])
    outwards = np.argsort(distance)
    distance, (x, y, z) = distance[outwards], points[outwards].T
    design = np.stack((np.ones_like(x), x, y))
    noise = sigma[outwards] ** 2 + ROUGH_M * ROUGH_M
    spread = np.square(np.clip(distance, 0.3, 1.6))  # near ones are many
    information = np.linalg.inv(predicted.covariance)
    now = predicted
    for count in np.searchsorted(distance, REACHES_M):
        near = np.s_[:count]
        off = z[near] - now.coefficients @ design[:, near]
        gate = GATE * GATE * (now.variance(x[near], y[near]) + noise[near])
        inlying = np.maximum(1.0 - off * off / gate, 0.0)  # Tukey
        weight = inlying * inlying * spread[near]
        total = float(weight.sum())
        if np.count_nonzero(inlying) < MIN_POINTS or total <= 0.0:
            continue
        weight *= INDEPENDENT / total / noise[near]
        weighed = design[:, near] * weight
        precision = information + weighed @ design[:, near].T
        covariance = np.linalg.inv(precision)
        solved = covariance @ (information @ predicted.coefficients + weighed @ z[near])
        limits = np.array((MAX_OFFSET_M, MAX_SLOPE, MAX_SLOPE))
        now = FloorPlane(np.clip(solved, -limits, limits), covariance, seen=True)
    return now


def _bounded(covariance: Floats) -> Floats:
    """Limit a covariance to that before the first picture, axis by axis."""
    most = np.array((OFFSET_M, SLOPE, SLOPE))
    shrink = np.minimum(1.0, most / np.sqrt(np.diag(covariance)))
    return np.asarray(covariance * np.outer(shrink, shrink))
