"""Contents of a depth picture: points above the floor, floor, holes in it, and unknown parts."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.vision.camera_model import CameraModel, Singles
from gigabrain_zenoh.vision.floor import FloorPlane, fit_floor, unseen_floor

Mask = NDArray[np.bool_]
SIGMA_AT_1M = 0.0015  # [m], standard deviation of depth; grows with depth squared
REACH_M = 3.5  # largest depth of obstacles and holes
LOW_M, HIGH_M = 0.012, 0.02  # least heights of an obstacle's points, and of its highest ones
SIGMAS = 4.0  # least height of an obstacle, relative to noise
HOLE_M = 0.025  # below the floor
LIKE_M, LIKE_SHARE, LIKE_SIGMAS = 0.008, 0.005, 3.5  # tolerances for pixels at the same depth
SUPPORT = 3  # least neighbours, of eight, at the same depth, as at a thing's corner
MISSING_REACH_M = 1.2  # up to here the floor always gives depth
MISSING_PX, MISSING_SHARE = 9, 0.75  # side of a window, and its share of pixels without depth
ROW_M = 0.25  # longest stretch of floor in one row of pixels, to locate a hole's edge
BLIND_SHARE = 0.02  # least share of pixels with depth
FIT_REACH_M = 4.0  # largest depth of points for the fit
FIT_STEP = 3  # rows and columns between two points for the fit
SUB_ROWS = (-0.375, -0.125, 0.125, 0.375)


@dataclass(frozen=True, slots=True)
class DepthView:
    """The content of a picture. Points are in the body's frame [m], heights above the floor [m]."""

    obstacles: Singles  # (n, 3): x, y, height
    holes: Singles  # (m, 3): x, y where the floor should be, height of the seen point
    missing: Singles  # (k, 2): x, y where the floor should be, without depth
    depth: Singles  # (height, width) [m]; 0 is unknown
    is_floor: Mask  # (height, width)
    floor: FloorPlane


class DepthCamera:
    """Analyses the depth pictures of one camera; tracks the floor between them."""

    def __init__(self, model: CameraModel, body_height: float) -> None:
        self.model = model
        self._floor = unseen_floor()
        self._body_height = body_height
        camera = model.camera
        up = model.rays[2]
        room = body_height - camera.z + 0.02
        least = np.where(up < 0, up * REACH_M, up * camera.depth_min)
        low = np.any(least < room, axis=1)  # NaN is not
        self._first = int(np.argmax(low)) if low.any() else camera.height - 2
        # first row of the picture that may show points below the body's height
        self._grid = np.s_[FIT_STEP // 2 :: FIT_STEP, FIT_STEP // 2 :: FIT_STEP]
        fitting = model.rays[:, *self._grid].astype(np.float64)
        down = fitting[2] < 0.0  # rays upwards see no floor
        self._fitting, self._fit_rays = down, fitting[:, down]
        self._usable = np.isfinite(model.rays[0])

    def view(self, millimetres: NDArray[np.uint16]) -> DepthView | None:
        """Return the content of a picture (height, width); None if it shows nothing."""
        camera = self.model.camera
        depth = millimetres.astype(np.float32)
        depth *= np.float32(0.001)
        depth[(depth > camera.depth_max * 1.05) | ~self._usable] = 0.0
        if np.count_nonzero(depth) < BLIND_SHARE * depth.size:
            return None
        self._floor = self._fitted(depth)
        return self._apart(depth, self._floor)

    def _fitted(self, depth: Singles) -> FloorPlane:
        origin = self.model.origin
        along = depth[self._grid][self._fitting].astype(np.float64)
        at = np.flatnonzero((along > 0) & (along < FIT_REACH_M))
        along, rays = along[at], self._fit_rays[:, at]
        points = (rays * along).T + origin
        low = np.abs(points[:, 2]) < 0.15  # much more than mounting and tilt can cause
        sigma = SIGMA_AT_1M * np.square(along[low]) * np.abs(rays[2, low])
        return fit_floor(self._floor, points[low], sigma)

    def _apart(self, depth: Singles, floor: FloorPlane) -> DepthView:
        """Classify pixels by their height above the floor."""
        first = self._first
        rays = self.model.rays[:, first:]
        offset, slope_x, slope_y = (np.float32(c) for c in floor.coefficients)
        x0, y0, z0 = (np.float32(c) for c in self.model.origin)
        rise = rays[2] - slope_x * rays[0] - slope_y * rays[1]
        start = z0 - offset - slope_x * x0 - slope_y * y0
        raw = depth[first:]
        smooth, whole = smoothed(raw)
        known = raw > 0
        height = smooth * rise + start
        allowed = self._allowed(smooth, rise, floor)
        near = known & (smooth < REACH_M)
        reach = near & whole
        stands = reach & (height > LOW_M + allowed) & (height < self._body_height)
        on_floor = known & (np.abs(height) < LOW_M + allowed)
        with np.errstate(divide="ignore", invalid="ignore"):
            expected = np.where(rise < -1e-3, -start / rise, np.inf).astype(np.float32)
        below = reach & (height < -(HOLE_M + allowed)) & self._sharp(expected, start)
        is_floor = np.zeros(depth.shape, np.bool_)
        is_floor[first:] = on_floor
        return DepthView(
            obstacles=self._places(rays[:, stands], smooth[stands], height[stands]),
            holes=self._gaping(rays, rise, start, below, height),
            missing=self._missing(rays, expected, known),
            depth=depth,
            is_floor=is_floor,
            floor=floor,
        )

    def _allowed(self, depth: Singles, rise: Singles, floor: FloorPlane) -> Singles:
        """Return the largest height by noise and the floor's uncertainty [m], per pixel."""
        near, far = floor.sigma(np.array((0.0, REACH_M)), np.zeros(2)).tolist()
        plane = np.float32(near) + np.float32((far - near) / REACH_M) * depth
        noise = np.float32(SIGMA_AT_1M / 2) * depth * depth * np.abs(rise)  # smoothed
        return np.asarray(np.float32(SIGMAS) * np.maximum(noise - 0.001, 0) + plane, np.float32)

    def _places(self, rays: Singles, depth: Singles, height: Singles) -> Singles:
        x0, y0, _ = self.model.origin
        return np.stack((rays[0] * depth + x0, rays[1] * depth + y0, height), axis=1).astype(
            np.float32
        )

    def _sharp(self, expected: Singles, start: np.float32) -> Mask:
        """Return where a row of pixels covers little floor; `expected` is the floor's depth [m]."""
        fy = self.model.camera.pinhole[1]
        most = math.sqrt(max(float(start), 0.0) * fy * ROW_M)
        return np.asarray(expected < min(most, REACH_M))

    def _gaping(
        self, rays: Singles, rise: Singles, start: np.float32, below: Mask, height: Singles
    ) -> Singles:
        """Return where rays pass through the floor, with depth [m]; one point per part of a row."""
        rows, columns = np.nonzero(below)
        if not len(rows):
            return np.empty((0, 3), np.float32)
        above, under = np.maximum(rows - 1, 0), np.minimum(rows + 1, len(rise) - 1)
        step = np.nan_to_num(rise[under, columns] - rise[above, columns]) / np.float32(2)
        parts = [
            np.minimum(rise[rows, columns] + np.float32(part) * step, np.float32(-1e-3))
            for part in SUB_ROWS
        ]
        flat = [
            self._places(
                rays[:, rows, columns], (-start / part).astype(np.float32), height[rows, columns]
            )
            for part in parts
        ]
        return np.concatenate(flat)

    def _missing(self, rays: Singles, expected: Singles, known: Mask) -> Singles:
        """Return where much of the nearby floor gives no depth (k, 2)."""
        camera = self.model.camera
        looked_for = (expected > camera.depth_min * 1.2) & (expected < MISSING_REACH_M)
        absent = looked_for & ~known
        if np.count_nonzero(absent) < MISSING_SHARE * MISSING_PX**2:
            return np.empty((0, 2), np.float32)
        lines = np.flatnonzero(absent.any(axis=1))
        part = np.s_[lines[0] : lines[-1] + 1]  # mostly the lower half of the picture
        absent[part] &= window_sum(absent[part]) >= MISSING_SHARE * MISSING_PX**2
        return self._places(rays[:, absent], expected[absent], expected[absent])[:, :2]


def smoothed(depth: Singles) -> tuple[Singles, Mask]:
    """Return the mean of pixels and their neighbours at the same depth, and a mask of whole ones.

    A pixel at an edge may see two things and measure neither. It is whole if its depth is that of
    the neighbours on two opposite sides, or of enough neighbours.
    """
    threshold = LIKE_M + np.float32(LIKE_SHARE) * depth
    threshold += np.float32(LIKE_SIGMAS * SIGMA_AT_1M) * depth * depth
    threshold[depth <= 0] = -1.0
    total = depth.copy()
    count = np.zeros(depth.shape, np.uint8)
    whole = np.zeros(depth.shape, np.bool_)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        one, other = _shifted(down, right)
        a, b = depth[one], depth[other]
        step = b - a
        like = np.abs(step, out=step) < threshold[one]
        like &= b > 0
        sides = np.zeros(depth.shape, np.uint8)
        sides[one] += like
        sides[other] += like
        count += sides
        whole |= sides == 2
        total[one] += b * like
        total[other] += a * like
    whole |= count >= SUPPORT
    return total / (count + np.float32(1)), whole


def _shifted(down: int, right: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return slices of pixels that have a neighbour `down` and `right`, and of that neighbour."""
    above, below = slice(None, -down or None), slice(down, None)
    if right >= 0:
        return (above, slice(None, -right or None)), (below, slice(right, None))
    return (above, slice(-right, None)), (below, slice(None, right))


def window_sum(mask: Mask) -> NDArray[np.int32]:
    """Return the number of true pixels in the window round each pixel."""
    half = MISSING_PX // 2
    padded = np.pad(mask, ((half + 1, half), (half + 1, half)))
    total = padded.cumsum(axis=0, dtype=np.int32).cumsum(axis=1, dtype=np.int32)
    rows = total[MISSING_PX:] - total[:-MISSING_PX]
    return np.asarray(rows[:, MISSING_PX:] - rows[:, :-MISSING_PX])
