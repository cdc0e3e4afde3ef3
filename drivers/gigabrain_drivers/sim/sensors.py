"""Simulated sensors with noise: a planar lidar and an inertial unit."""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.kinematics import Quaternion, Vector
from gigabrain_drivers.sim.body import SimLidar
from gigabrain_drivers.sim.scene import ROBOT

GYRO_NOISE = 0.002  # [rad/s]; standard deviations of samples at 100 Hz
ACCELEROMETER_NOISE = 0.02  # [m/s2]
ATTITUDE_NOISE = 0.001  # [rad]


VISIBLE_GROUPS = np.array([1, 1, 0, 1, 1, 1], np.uint8)  # not 2, the robots' geom group


class ImuSample(NamedTuple):
    """One sample in the base's frame."""

    orientation: Quaternion  # x, y, z, w, in the frame of the start
    angular_velocity: Vector  # [rad/s]
    linear_acceleration: Vector  # [m/s2], 9.81 upwards at rest


class Imu:
    """Reads the model's sensors `gyro`, `accelerometer` and `attitude`."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, yaw: float, noise: np.random.Generator
    ) -> None:
        self._noise, self._data = noise, data
        self._start = (math.cos(yaw / 2), math.sin(yaw / 2))
        self._gyro = int(model.sensor(f"{ROBOT}gyro").adr[0])
        self._accelerometer = int(model.sensor(f"{ROBOT}accelerometer").adr[0])
        self._attitude = int(model.sensor(f"{ROBOT}attitude").adr[0])

    def sample(self) -> ImuSample:
        """Return a sample; every call draws new noise."""
        values, noise = self._data.sensordata.tolist(), self._noise.standard_normal(9).tolist()
        gyro = _noisy(values, self._gyro, noise[0:3], GYRO_NOISE)
        acceleration = _noisy(values, self._accelerometer, noise[3:6], ACCELEROMETER_NOISE)
        w, x, y, z = values[self._attitude : self._attitude + 4]
        cos, sin = self._start
        from_start = (cos * w + sin * z, cos * x + sin * y, cos * y - sin * x, cos * z - sin * w)
        return ImuSample(_shaken(from_start, noise[6:9]), gyro, acceleration)


def _noisy(values: list[float], at: int, noise: list[float], sigma: float) -> Vector:
    return (
        values[at] + sigma * noise[0],
        values[at + 1] + sigma * noise[1],
        values[at + 2] + sigma * noise[2],
    )


def _shaken(attitude: Quaternion, noise: list[float]) -> Quaternion:
    """Rotate the attitude (w, x, y, z) by a small random rotation; return (x, y, z, w)."""
    w, x, y, z = attitude
    a, b, c = (ATTITUDE_NOISE / 2 * value for value in noise)
    turned = (
        x + w * a + y * c - z * b,
        y + w * b + z * a - x * c,
        z + w * c + x * b - y * a,
        w - x * a - y * b - z * c,
    )
    norm = math.hypot(*turned)
    return (turned[0] / norm, turned[1] / norm, turned[2] / norm, turned[3] / norm)


class Lidar:
    """A lidar at a site of the model, with Gaussian noise."""

    def __init__(
        self, config: SimLidar, model: mujoco.MjModel, site: str, noise: np.random.Generator
    ) -> None:
        self._config, self._model, self._noise = config, model, noise
        self._site = model.site(site).id
        self._body = int(model.site_bodyid[self._site])
        angle = np.arange(config.beams) * (math.tau / config.beams)
        self._directions = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)

    def scan(self, data: mujoco.MjData) -> NDArray[np.float32]:
        """Return ranges (beams,) [m], counter-clockwise from straight ahead; inf: nothing in range.

        Anything nearer than the least range is reported at that range, not as free.
        """
        return self.cast(data, self._directions)

    def cast(self, data: mujoco.MjData, directions: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return ranges (n,) [m] along `directions` (n, 3) in the sensor's frame, as in `scan`."""
        config, count = self._config, len(directions)
        mujoco.mj_kinematics(self._model, data)  # sites lag one step behind, mocap bodies too
        rays = directions @ data.site_xmat[self._site].reshape(3, 3).T
        hit, ranges = np.empty(count, np.int32), np.empty(count)
        mujoco.mj_multiRay(
            self._model,
            data,
            data.site_xpos[self._site],
            rays.reshape(-1),
            VISIBLE_GROUPS,
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
