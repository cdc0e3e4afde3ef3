"""A differential base in MuJoCo: two wheel motors and their encoders."""

import mujoco

from gigabrain_drivers.kinematics import Twist
from gigabrain_drivers.sim.body import SimBody
from gigabrain_drivers.sim.imu import ImuSample
from gigabrain_drivers.sim.locomotion import Locomotion, Motor, Odometry
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.wear import MotorHeat
from gigabrain_drivers.sim.wheels import DifferentialBase


class Rolling(Locomotion):
    """The wheels get to what is commanded at their greatest acceleration; nothing goes sideways."""

    def __init__(self, body: SimBody, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._body, self._base, self._data = body, DifferentialBase(body), data
        self._angles = [int(model.joint(f"{ROBOT}{n}_joint").qposadr[0]) for n in body.wheels]
        self._motors = [int(model.actuator(f"{ROBOT}{n}").id) for n in body.wheels]
        self._heat = [MotorHeat(body.motor) for _ in body.wheels]

    def command(self, twist: Twist) -> Twist:
        """Both wheels slow down alike if one would be too fast."""
        forward, turn = self._base.command(twist.linear_x, twist.angular_z)
        return Twist(forward, 0.0, turn)

    def act(self) -> None:
        """Wheel speeds."""
        left, right = self._base.ramp()
        control = self._data.ctrl
        control[self._motors[0]], control[self._motors[1]] = left, right

    def sense(self, imu: ImuSample) -> None:
        """Wheel angles alone."""
        position = self._data.qpos
        self._base.measure(float(position[self._angles[0]]), float(position[self._angles[1]]))

    def wear(self) -> float:
        """The motors draw by their speed and by their torque."""
        config, effort, current = self._body, self._data.actuator_force.tolist(), 0.0
        share = config.battery.drive_current_a / len(self._heat) / config.max_wheel_speed
        wheels = zip(self._heat, self._motors, self._base.wheels(), strict=True)
        for heat, motor, (_, speed) in wheels:
            current += heat.warm(share * abs(speed), effort[motor])
        return current

    def odometry(self) -> Odometry:
        """By the wheel encoders alone."""
        return self._base.odometry()

    def velocity(self) -> Twist:
        """By the wheel encoders alone."""
        odometry = self._base.odometry()
        return Twist(odometry.linear_x, 0.0, odometry.angular_z)

    def motors(self) -> tuple[Motor, ...]:
        """Left and right wheel."""
        effort = self._data.actuator_force
        parts = zip(self._body.wheels, self._base.wheels(), self._motors, self._heat, strict=True)
        return tuple(
            Motor(f"{name}_joint", angle, speed, float(effort[motor]), heat.celsius)
            for name, (angle, speed), motor, heat in parts
        )
