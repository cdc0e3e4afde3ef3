"""Finds the corners of a tag to a tenth of a pixel, as intersections of lines along its edges.

It measures the middle of the step from black to white at several points of each edge, and fits a
line to them, as in AprilTag 3 (Krogius, Haggenmiller and Olson 2019).
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats

POINTS = 16  # of an edge
ENDS = 0.12  # share of an edge left out at each end
CELLS = 8.0  # of the smallest family, across its black square
REACH_CELLS, MAX_PX, MIN_PX = 0.7, 3.0, 1.0  # search range on both sides of an edge
STEP_PX = 0.25
MAX_MOVE_PX = 2.5  # beyond it, the first guess is kept


def refined(grey: NDArray[np.uint8], corners: Floats) -> Floats:
    """Return the refined corners (4, 2) of a tag [px], from a first guess."""
    ends = np.roll(corners, -1, axis=0)
    along = ends - corners
    length = np.linalg.norm(along, axis=1)
    outward = np.stack((along[:, 1], -along[:, 0]), axis=1) / length[:, None]
    if (outward * (corners - corners.mean(axis=0))).sum() < 0:
        outward = -outward
    shares = np.linspace(ENDS, 1 - ENDS, POINTS)
    reach = float(np.clip(REACH_CELLS * length.min() / CELLS, MIN_PX, MAX_PX))
    offsets = np.arange(-reach, reach + STEP_PX, STEP_PX)
    on_edge = corners[:, None] + shares[:, None] * along[:, None]  # (4, POINTS, 2)
    sampled = on_edge[:, :, None] + offsets[:, None] * outward[:, None, None]
    at = sampled.reshape(4 * POINTS, -1, 2).astype(np.float32)
    values = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    steps = np.maximum(np.diff(values, axis=1), 0.0).reshape(4, POINTS, -1)
    weights = steps.sum(axis=2) + 1e-6
    middles = (steps * (offsets[:-1] + STEP_PX / 2)).sum(axis=2) / weights
    edges = on_edge + middles[..., None] * outward[:, None]
    found = _crossings(edges, weights)
    if not np.isfinite(found).all():
        return corners
    near = np.linalg.norm(found - corners, axis=1) <= MAX_MOVE_PX
    return np.where(near[:, None], found, corners)


def _crossings(edges: Floats, weights: Floats) -> Floats:
    """Return the intersections (4, 2) of lines through points on four edges (4, n, 2)."""
    share = weights / weights.sum(axis=1, keepdims=True)
    middle = (share[..., None] * edges).sum(axis=1)
    off = edges - middle[:, None]
    spread = np.einsum("en,eni,enj->eij", share, off, off)
    normals = np.linalg.eigh(spread)[1][:, :, 0]
    distances = (normals * middle).sum(axis=1)
    before = np.roll(normals, 1, axis=0), np.roll(distances, 1)
    lines = np.stack((before[0], normals), axis=1)  # a corner is on its edge and the one before it
    wanted = np.stack((before[1], distances), axis=1)
    if (np.abs(np.linalg.det(lines)) < 1e-3).any():
        return np.full((4, 2), np.nan)
    return np.asarray(np.linalg.solve(lines, wanted[..., None])[..., 0], np.float64)
