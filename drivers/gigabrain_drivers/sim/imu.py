"""An inertial unit: MuJoCo's exact sensors with a little noise; heading 0 is that of the start."""

import math
from typing import NamedTuple

import mujoco
import numpy as np

from gigabrain_drivers.sim.scene import ROBOT

GYRO_NOISE = 0.002  # [rad/s], standard deviations for a sample at 100 Hz
ACCELEROMETER_NOISE = 0.02  # [m/s2]
ATTITUDE_NOISE = 0.001  # [rad]

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class ImuSample(NamedTuple):
    """One sample in the base's frame."""

    orientation: Quaternion  # x, y, z, w; from the frame of the start
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
        """Measure once; every call draws new noise."""
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
    """The attitude (w, x, y, z) after a small random rotation, as (x, y, z, w)."""
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
