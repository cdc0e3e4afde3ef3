"""A planar lidar: one call to MuJoCo casts all rays of a scan."""

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.body import SimLidar

SEES_GROUPS = np.array([1, 1, 0, 1, 1, 1], np.uint8)  # robots are geom group 2


class Lidar:
    """A lidar at a site of the model, with Gaussian noise of its own generator."""

    def __init__(
        self, config: SimLidar, model: mujoco.MjModel, site: str, noise: np.random.Generator
    ) -> None:
        self._config, self._model, self._noise = config, model, noise
        self._site = model.site(site).id
        self._body = int(model.site_bodyid[self._site])
        angle = np.arange(config.beams) * (math.tau / config.beams)
        self._directions = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)

    def scan(self, data: mujoco.MjData) -> NDArray[np.float32]:
        """Ranges (beams,) [m], counter-clockwise from straight ahead; inf: nothing in range.

        What is nearer than the sensor can measure is reported at its least range, not as free.
        """
        return self.cast(data, self._directions)

    def cast(self, data: mujoco.MjData, directions: NDArray[np.float64]) -> NDArray[np.float32]:
        """Ranges (n,) [m] along `directions` (n, 3) in the sensor's frame, as in `scan`."""
        config, count = self._config, len(directions)
        mujoco.mj_kinematics(self._model, data)  # sites lag one step behind, mocap bodies too
        rays = directions @ data.site_xmat[self._site].reshape(3, 3).T
        hit, ranges = np.empty(count, np.int32), np.empty(count)
        mujoco.mj_multiRay(
            self._model,
            data,
            data.site_xpos[self._site],
            rays.reshape(-1),
            SEES_GROUPS,
            True,
            self._body,
            hit,
            ranges,
            None,
            count,
            config.range_max,
        )
        # A hit beyond the cutoff may be any number, a miss is -1: neither is a return.
        missed = (ranges < 0) | (ranges > config.range_max)
        ranges += self._noise.normal(0.0, config.noise_m, count)
        np.maximum(ranges, config.range_min, out=ranges)
        ranges[missed | (ranges > config.range_max)] = np.inf
        return ranges.astype(np.float32)
