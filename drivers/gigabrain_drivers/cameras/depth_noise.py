"""Errors of a depth camera, added to rendered depth: noise, holes, mixed pixels, mounting.

The camera process, benchmarks and tests share this model. Pure: the same seed gives the same bits.
"""

import math
import zlib
from dataclasses import dataclass

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_drivers.sim.world import Stream
from gigabrain_schemas.body import Camera

EDGE_M, EDGE_SHARE = 0.03, 0.03  # at an edge, depth jumps by more than both
NEAR_M, FAR_M = 1e-3, 1e4
PATCH_PX = 4  # side of a hole that is more than one pixel


@dataclass(frozen=True, kw_only=True, slots=True)
class DepthErrors:
    """Errors of a depth camera: noise, holes, edges and mounting."""

    sigma_at_1m: float = 0.0015  # [m], standard deviation at 1 m; grows with depth squared
    holes: float = 0.02  # share of pixels without depth: half of them single, half in patches
    mixed: float = 0.5  # share of the pixels at an edge that measure a depth between both sides
    mounting_m: float = 0.005  # largest displacement of the camera along each axis
    mounting_rad: float = math.radians(0.5)  # largest rotation of the camera about each axis


SENSOR = DepthErrors()
NO_ERRORS = DepthErrors(sigma_at_1m=0.0, holes=0.0, mixed=0.0, mounting_m=0.0, mounting_rad=0.0)


class DepthSensor:
    """A depth camera with random errors, drawn from `seed` (>= 0) and the camera's name."""

    def __init__(self, camera: Camera, seed: int, errors: DepthErrors = SENSOR) -> None:
        self._camera, self._errors = camera, errors
        self._key = (seed, Stream.CAMERA, zlib.crc32(camera.name.encode()))
        self.mounted = _displaced(camera, errors, np.random.default_rng(self._key))
        # the true mounting, for the renderer only; others know the one in the robot's file
        self.random = self.begin(0)

    def begin(self, exposure: int) -> np.random.Generator:
        """Start the random errors of the exposure with this number; return their generator."""
        self.random = np.random.Generator(np.random.SFC64([*self._key, 1 + exposure]))
        return self.random

    def measure(self, depth: NDArray[np.floating]) -> NDArray[np.uint16]:
        """Return the measured depth [mm], (height, width); 0 is unknown.

        `depth` [m] is the true depth, (height, width), along the camera's x axis. Every call draws
        new errors, and always equally many random numbers.
        """
        errors, camera = self._errors, self._camera
        true = np.fmax(np.fmin(depth, FAR_M), NEAR_M).astype(np.float32, order="C")  # NaN: far
        measured = _mixed(true, self.random, errors.mixed) if errors.mixed else true
        if errors.sigma_at_1m:
            noise = self.random.standard_normal(true.shape, np.float32)
            measured = measured + np.float32(errors.sigma_at_1m) * measured * measured * noise
        known = (measured >= camera.depth_min) & (measured <= min(camera.depth_max, 65.535))
        if errors.holes:
            known &= ~self._holes(true.shape)
        return np.rint(np.where(known, measured, 0.0) * 1000.0).astype(np.uint16)

    def _holes(self, shape: tuple[int, ...]) -> NDArray[np.bool_]:
        share = self._errors.holes / 2
        alone = self.random.random(shape, np.float32) < share
        height, width = (-(-side // PATCH_PX) + 1 for side in shape)
        down, right = self.random.integers(0, PATCH_PX, 2).tolist()
        patches = self.random.random((height, width), np.float32) < share
        large = patches.repeat(PATCH_PX, axis=0).repeat(PATCH_PX, axis=1)
        return alone | large[down : down + shape[0], right : right + shape[1]]


def _displaced(camera: Camera, errors: DepthErrors, random: np.random.Generator) -> Camera:
    """Return the camera at its true mounting, with random errors."""
    x, y, z = (errors.mounting_m * random.uniform(-1, 1, 3)).tolist()
    roll, pitch, yaw = (errors.mounting_rad * random.uniform(-1, 1, 3)).tolist()
    return replace(
        camera,
        x=camera.x + x,
        y=camera.y + y,
        z=camera.z + z,
        roll=camera.roll + roll,
        pitch=camera.pitch + pitch,
        yaw=camera.yaw + yaw,
    )


def _mixed(
    depth: NDArray[np.float32], random: np.random.Generator, share: float
) -> NDArray[np.float32]:
    """Return the depth with mixed pixels: at edges, a pixel may see both sides."""
    drawn = random.random((2, depth.size), np.float32)
    true, mixed = depth.reshape(-1), depth.flatten()
    for axis, step in ((0, depth.shape[1]), (1, 1)):
        here = _edges(depth, axis)
        for own, beside in ((here, here + step), (here + step, here)):
            chosen = drawn[0][own] < share
            part, one, other = drawn[1][own][chosen], true[own][chosen], true[beside][chosen]
            # the nearer side returns more light, so inverse depths are mixed
            mixed[own[chosen]] = 1.0 / (part / one + (1 - part) / other)
    return mixed.reshape(depth.shape)


def _edges(depth: NDArray[np.float32], axis: int) -> NDArray[np.intp]:
    """Return the flat indices of pixels whose next pixel along `axis` is across an edge.

    Inverse depth changes evenly across a plane, at any angle. So an edge is where its step differs
    from the steps on both sides. Pixels at the border of the picture are left out.
    """
    step = depth.shape[1] if axis == 0 else 1
    steep = np.abs(np.diff(depth, axis=axis)) > EDGE_M
    row, column = np.nonzero(steep)
    along = row if axis == 0 else column
    inside = (along > 0) & (along < depth.shape[axis] - 2)
    here = row[inside] * depth.shape[1] + column[inside]
    flat = depth.reshape(-1)
    before, one, other, after = (1.0 / flat[here + shift * step] for shift in (-1, 0, 1, 2))
    jump = other - one
    difference = np.minimum(np.abs(jump - (one - before)), np.abs(jump - (after - other)))
    near, far = 1.0 / np.maximum(one, other), 1.0 / np.minimum(one, other)
    edges: NDArray[np.intp] = here[difference * near * far > np.maximum(EDGE_M, EDGE_SHARE * near)]
    return edges
