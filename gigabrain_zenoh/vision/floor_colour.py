"""The boundary of the floor by colour, a simple source for cameras without depth.

The floor's colours are those of the patch before the robot, in pictures where that patch is even.
Where a column of the picture leaves these colours, there is an obstacle. The plane of the floor (a
homography) gives its place, not its height. Shadows, carpets and patterns look like obstacles;
obstacles of the floor's colour look like floor.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gigabrain_schemas.arrays import Floats
from gigabrain_zenoh.vision.camera_model import CameraModel, Singles
from gigabrain_zenoh.vision.depth_picture import Mask

STEP = 2  # the picture is reduced by this factor
REACH_M = 2.5  # beyond it, a row of pixels covers too much floor
PATCH_WIDTH, PATCH_M = 0.4, 0.25  # share of the width, and length from the nearest visible floor
MAX_EVEN_SIGMA = 30.0  # largest standard deviation of the brightness (0 to 255) of an even patch
MIN_SPREAD = 6.0  # least standard deviation of a colour, by noise and JPEG
MIN_UNLIKE = 5.0  # least distance from the floor's colour, in standard deviations
GAIN = 0.1  # weight of a new picture in the tracked colour
RUN_PX = 3  # rows in sequence that are no floor; fewer are joints and specks
DEEP_M = (0.0, 0.02)  # assumed depth range of an obstacle behind the boundary
MIN_PX = 40  # of a patch
DARK = 40.0  # added to the brightness before dividing by it, as dark pixels have no colour


@dataclass(frozen=True, slots=True)
class ColourView:
    """The floor and its boundary in one picture, in the body's frame."""

    boundary: Floats  # (n, 2) [m], where the floor ends
    is_floor: Mask  # (height, width)
    known: Singles  # (height, width): 1 where `is_floor` is known


class ColourCamera:
    """Analyses the pictures of one camera; tracks the colour of the floor."""

    def __init__(self, model: CameraModel) -> None:
        self.model = model
        self._rows = np.s_[::-1] if model.rotation[2, 2] < 0 else np.s_[:]
        # so that lower rows show nearer floor, even if the camera is upside down
        rays = model.rays[:, ::STEP, ::STEP][:, self._rows].astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(rays[2] < -1e-3, -model.origin[2] / rays[2], np.inf)
            self._places = (rays[:2] * depth + model.origin[:2, None, None]).transpose(1, 2, 0)
            distance = np.hypot(*(self._places - model.origin[:2]).transpose(2, 0, 1))
        self._near: Mask = np.isfinite(distance) & (distance < REACH_M)
        half = int(rays.shape[2] * PATCH_WIDTH / 2)
        middle = rays.shape[2] // 2
        self._patch = np.zeros_like(self._near)
        if self._near.any():
            nearest = distance[self._near].min()
            self._patch[:, middle - half : middle + half] = True
            self._patch &= self._near & (distance < nearest + PATCH_M)
        self._mean: Floats | None = None
        self._spread: Floats = np.full(3, MIN_SPREAD)

    def view(self, pixels: NDArray[np.uint8]) -> ColourView | None:
        """Return the content of a picture (height, width, 3); None before the floor is known."""
        features = _features(pixels[::STEP, ::STEP][self._rows])
        self._learn(features[self._patch])
        if self._mean is None:
            return None
        off = np.square((features - self._mean) / self._spread).sum(axis=2)
        floor = (off < MIN_UNLIKE * MIN_UNLIKE) & self._near
        row, column = _boundary(floor, self._near)
        ends = np.full(floor.shape[1], -1)
        ends[column] = row
        seen = self._near & (np.arange(floor.shape[0])[:, None] > ends)
        places = self._places[row, column]
        outward = places - self.model.origin[:2]
        outward /= np.maximum(np.hypot(*outward.T), 1e-9)[:, None]
        boundary = np.concatenate([places + deep * outward for deep in DEEP_M])
        known = _large(seen[self._rows], pixels)
        return ColourView(boundary, known, known.astype(np.float32))

    def _learn(self, patch: Floats) -> None:
        """Learn the colour of the patch before the robot, if it shows only floor."""
        if len(patch) < MIN_PX:
            return
        mean, spread = np.median(patch, axis=0), np.maximum(patch.std(axis=0), MIN_SPREAD)
        if spread[0] > MAX_EVEN_SIGMA:
            return
        if self._mean is None:
            self._mean, self._spread = mean, spread
        elif np.all(np.abs(mean - self._mean) < MIN_UNLIKE * self._spread):
            self._mean = self._mean + GAIN * (mean - self._mean)
            self._spread = self._spread + GAIN * (spread - self._spread)


def _features(pixels: NDArray[np.uint8]) -> Floats:
    """Return brightness and chromaticity (height, width, 3), each 0 to 255 and more."""
    colour = pixels.astype(np.float64)
    bright = colour.mean(axis=2)
    parts = 255.0 * colour[..., :2] / (3 * bright + DARK)[..., None]
    return np.concatenate((bright[..., None], 2 * parts), axis=2)


def _boundary(floor: Mask, near: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return row and column of the lowest run of pixels without floor, in each column."""
    other = near & ~floor
    run = other.copy()
    for above in range(1, RUN_PX):
        run[above:] &= other[:-above]
        run[:above] = False
    lowest = floor.shape[0] - 1 - np.argmax(run[::-1], axis=0)
    column = np.flatnonzero(run.any(axis=0))
    return lowest[column], column


def _large(small: Mask, pixels: NDArray[np.uint8]) -> Mask:
    """Return a mask for each pixel of the whole picture."""
    large = small.repeat(STEP, axis=0).repeat(STEP, axis=1)
    return np.ascontiguousarray(large[: pixels.shape[0], : pixels.shape[1]])
