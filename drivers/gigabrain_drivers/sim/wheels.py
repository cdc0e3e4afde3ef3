"""The base's own firmware: wheel speeds from commands, odometry from encoder ticks."""

import math
from collections import deque

from gigabrain_drivers.sim.body import SimBody
from gigabrain_drivers.sim.locomotion import Odometry
from gigabrain_drivers.sim.tick import TICK_S

VELOCITY_TICKS = 5  # velocity is measured over 50 ms: a finer one would be encoder noise


class DifferentialBase:
    """Differential kinematics of two wheels with incremental encoders (left, right)."""

    def __init__(self, body: SimBody) -> None:
        self._body = body
        radius = body.odometry_wheel_radius or body.wheel_radius
        self._angle_per_tick = math.tau / body.encoder_ticks
        self._metres_per_tick = self._angle_per_tick * radius
        self._target = (0.0, 0.0)
        self._speed = (0.0, 0.0)
        self._counts = (0, 0)
        self._past = deque([(0, 0)] * (VELOCITY_TICKS + 1), maxlen=VELOCITY_TICKS + 1)
        self._x = self._y = self._yaw = 0.0

    def command(self, linear_x: float, angular_z: float) -> tuple[float, float]:
        """Aim for a velocity; both wheels slow down alike if one would be too fast."""
        body = self._body
        turn = angular_z * body.wheel_separation / 2
        left, right = (linear_x - turn) / body.wheel_radius, (linear_x + turn) / body.wheel_radius
        scale = max(abs(left), abs(right)) / body.max_wheel_speed
        if scale > 1:
            left, right = left / scale, right / scale
        self._target = (left, right)
        forward = (left + right) / 2 * body.wheel_radius
        return forward, (right - left) * body.wheel_radius / body.wheel_separation

    def ramp(self) -> tuple[float, float]:
        """The wheel speeds to ask the motors for in the next tick [rad/s]."""
        step = self._body.max_wheel_acceleration * TICK_S
        (left, right), (left_now, right_now) = self._target, self._speed
        self._speed = (
            left_now + min(max(left - left_now, -step), step),
            right_now + min(max(right - right_now, -step), step),
        )
        return self._speed

    def measure(self, left_angle: float, right_angle: float) -> None:
        """Count the encoder ticks of the past tick and integrate them at the mid heading."""
        left = self._count(left_angle, self._counts[0])
        right = self._count(right_angle, self._counts[1])
        moved = (left + right - self._counts[0] - self._counts[1]) / 2 * self._metres_per_tick
        self._counts = (left, right)
        self._past.append(self._counts)
        yaw = (right - left) * self._metres_per_tick / self._body.wheel_separation
        middle = (yaw + self._yaw) / 2
        self._x += moved * math.cos(middle)
        self._y += moved * math.sin(middle)
        self._yaw = yaw

    def _count(self, angle: float, count: int) -> int:
        """The new count; it moves by whole ticks only, so a wheel at rest does not flicker."""
        return count + math.trunc(angle / self._angle_per_tick - count)

    def odometry(self) -> Odometry:
        """Pose and velocity by the encoders alone."""
        (left, right), (left_then, right_then) = self._counts, self._past[0]
        per_second = self._metres_per_tick / (VELOCITY_TICKS * TICK_S)
        left_speed, right_speed = (left - left_then) * per_second, (right - right_then) * per_second
        turn = (right_speed - left_speed) / self._body.wheel_separation
        return Odometry(self._x, self._y, self._yaw, (left_speed + right_speed) / 2, turn)

    def wheels(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """(angle [rad], speed [rad/s]) of the left and of the right wheel, by the encoders."""
        (left, right), (left_then, right_then) = self._counts, self._past[0]
        angle, per_second = self._angle_per_tick, self._angle_per_tick / (VELOCITY_TICKS * TICK_S)
        return (
            (left * angle, (left - left_then) * per_second),
            (right * angle, (right - right_then) * per_second),
        )
