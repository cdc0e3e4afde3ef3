"""Matching a scan to a local map: point-to-line ICP, from where a search has found it to lie.

A. Censi, An ICP variant using a point-to-line metric, ICRA 2008.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.geometry.se2 import Floats
from gigabrain_zenoh.kernels.kernel import kernel, lean_kernel
from gigabrain_zenoh.mapping.local_map import BUCKET, Buckets
from gigabrain_zenoh.mapping.points import Points

ITERATIONS = 25
STILL = 1e-4  # [m] and [rad], a step this small ends ICP
SHRINK = 0.6  # of the gate, each iteration
GATE_LEAST = 0.12  # [m]
SIGMA = 0.06  # [m], residuals beyond it lose their weight
SOFT = 1e-9  # keeps the normal equations regular where the points say nothing


@dataclass(frozen=True, slots=True)
class Fit:
    """What ICP arrived at."""

    pose: Floats
    information: Floats  # (3, 3), of x, y and yaw about the body, in the map's axes
    inliers: float  # share of the scan's points
    rms: float  # [m], of the inliers


def icp(
    local: Buckets, points: Points, start: Floats, gate: float, prior: Floats, guess: Floats
) -> Fit:
    """Slide `points` onto the lines of `local`, beginning at `start`.

    `prior` is the (3, 3) information about `guess`, the pose that odometry expects: it decides
    where the lines leave a direction open.
    """
    pose, information, inliers, rms = _icp(
        local.points, local.normals, local.starts, local.width, local.origin,
        points, start, gate, prior, guess,
    )  # fmt: skip
    return Fit(pose, information, inliers, rms)


@lean_kernel
def _nearest(
    local: Points,
    starts: NDArray[np.int32],
    width: int,
    origin: Floats,
    x: float,
    y: float,
    gate: float,
    known: int,
) -> int:
    """The index of the nearest point within `gate`, or -1; one that is `known` to be near helps."""
    best, found = gate * gate, -1
    if known >= 0:
        away = _away(local, known, x, y)
        if away < best:
            best, found, gate = away, known, np.sqrt(away)
    height = (len(starts) - 1) // width
    left = max(int(np.floor((x - gate - origin[0]) / BUCKET)), 0)
    right = min(int(np.floor((x + gate - origin[0]) / BUCKET)), width - 1)
    top = max(int(np.floor((y - gate - origin[1]) / BUCKET)), 0)
    bottom = min(int(np.floor((y + gate - origin[1]) / BUCKET)), height - 1)
    if left > right:
        return found
    for row in range(top, bottom + 1):
        for k in range(starts[row * width + left], starts[row * width + right + 1]):
            away = _away(local, k, x, y)
            if away < best:
                best, found = away, k
    return found


@lean_kernel
def _away(local: Points, k: int, x: float, y: float) -> float:
    """The squared distance of a point from (x, y)."""
    dx, dy = local[k, 0] - x, local[k, 1] - y
    away: float = dx * dx + dy * dy
    return away


@kernel
def solved(m: Floats, v: Floats) -> Floats:
    """x of m x = v, m being a symmetric (3, 3) matrix, by Cramer's rule."""
    a, b, c = m[0, 0], m[0, 1], m[0, 2]
    d, e, f = m[1, 1], m[1, 2], m[2, 2]
    aa, bb, cc = d * f - e * e, c * e - b * f, b * e - c * d
    dd, ee, ff = a * f - c * c, b * c - a * e, a * d - b * b
    whole = a * aa + b * bb + c * cc
    x = np.empty(3)
    x[0] = (aa * v[0] + bb * v[1] + cc * v[2]) / whole
    x[1] = (bb * v[0] + dd * v[1] + ee * v[2]) / whole
    x[2] = (cc * v[0] + ee * v[1] + ff * v[2]) / whole
    return x


@kernel
def _lay(
    local: Points,
    normals: Points,
    starts: NDArray[np.int32],
    width: int,
    origin: Floats,
    points: Points,
    pose: Floats,
    gate: float,
    nearest: NDArray[np.int32],
    hessian: Floats,
    gradient: Floats,
) -> tuple[int, float]:
    """Add the points at `pose` to the normal equations; how many have a line, and squares.

    `nearest` are the points of `local` that they were laid onto before, or -1.
    """
    inliers, squares, near = 0, 0.0, -1
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    for k in range(len(points)):
        rx = cos * points[k, 0] - sin * points[k, 1]
        ry = sin * points[k, 0] + cos * points[k, 1]
        near = nearest[k] if nearest[k] >= 0 else near  # or that of the beam beside
        j = _nearest(local, starts, width, origin, pose[0] + rx, pose[1] + ry, gate, near)
        nearest[k] = j
        if j < 0:
            continue
        near = j
        nx, ny = normals[j, 0], normals[j, 1]
        error = (pose[0] + rx - local[j, 0]) * nx + (pose[1] + ry - local[j, 1]) * ny
        weight = (SIGMA / (SIGMA * SIGMA + error * error)) ** 2  # divided by the variance
        lever = rx * ny - ry * nx  # how the error grows with yaw
        inliers += 1
        squares += error * error
        gradient[0] += weight * error * nx
        gradient[1] += weight * error * ny
        gradient[2] += weight * error * lever
        hessian[0, 0] += weight * nx * nx
        hessian[0, 1] += weight * nx * ny
        hessian[0, 2] += weight * nx * lever
        hessian[1, 1] += weight * ny * ny
        hessian[1, 2] += weight * ny * lever
        hessian[2, 2] += weight * lever * lever
    hessian[1, 0], hessian[2, 0], hessian[2, 1] = hessian[0, 1], hessian[0, 2], hessian[1, 2]
    return inliers, squares


@kernel
def _icp(
    local: Points,
    normals: Points,
    starts: NDArray[np.int32],
    width: int,
    origin: Floats,
    points: Points,
    start: Floats,
    gate: float,
    prior: Floats,
    guess: Floats,
) -> tuple[Floats, Floats, float, float]:
    pose = start.copy()
    hessian = np.zeros((3, 3))
    inliers, squares = 0, 0.0
    nearest = np.full(len(points), -1, np.int32)
    for _ in range(ITERATIONS):
        hessian, gradient = np.zeros((3, 3)), np.zeros(3)
        inliers, squares = _lay(
            local, normals, starts, width, origin, points, pose, gate, nearest, hessian, gradient
        )
        off = pose - guess
        off[2] = (off[2] + np.pi) % (2 * np.pi) - np.pi
        for row in range(3):  # `@` would call for a BLAS
            gradient[row] += (prior[row] * off).sum()
        step = solved(hessian + prior + SOFT * np.eye(3), gradient)
        pose -= step
        if np.abs(step).max() < STILL and gate <= GATE_LEAST:
            break
        gate = max(gate * SHRINK, GATE_LEAST)
    return pose, hessian, inliers / max(len(points), 1), np.sqrt(squares / max(inliers, 1))
