"""A quadruped in MuJoCo: twelve servos, their encoders, what feet and inertial unit feel."""

import math

import mujoco
import numpy as np

from gigabrain_drivers.kinematics import Gait, Twist
from gigabrain_drivers.legs.geometry import JOINT_NAMES, LEGS, Vector
from gigabrain_drivers.legs.senses import Senses
from gigabrain_drivers.legs.trot import Trot
from gigabrain_drivers.sim.body import SimQuadruped
from gigabrain_drivers.sim.imu import ImuSample
from gigabrain_drivers.sim.locomotion import Locomotion, Motor, Odometry
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.tick import TICK_S
from gigabrain_drivers.sim.wear import MotorHeat

REST = Twist(0.0, 0.0, 0.0)


class Walking(Locomotion):
    """Trots on what the body itself measures; stands at the start."""

    def __init__(self, body: SimQuadruped, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._body, self._data = body, data
        names = [f"{ROBOT}{name}" for name in JOINT_NAMES]
        self._angles = np.array([model.joint(name).qposadr[0] for name in names])
        self._motors = np.array([model.actuator(name).id for name in names])
        self._touch = np.array([model.sensor(f"{ROBOT}{leg}_contact").adr[0] for leg in LEGS])
        self._heat = [MotorHeat(body.motor) for _ in names]
        self._radians = math.tau / body.encoder_ticks
        self._gait = body.walker.to_gait(REST)
        height = self._gait.height
        self._targets = body.geometry.standing(height)
        standing = [angle for leg in self._targets for angle in leg]
        data.qpos[self._angles] = data.ctrl[self._motors] = standing
        self._counts = [round(angle / self._radians) for angle in standing]
        stiffness = float(model.actuator_gainprm[self._motors[0], 0])
        mass = float(model.body_subtreemass[model.body(f"{ROBOT}base").id])
        self._trot = Trot(body.geometry, mass, stiffness, height)
        self._senses: Senses | None = None
        self._turned = 0.0  # [rad], not wrapped

    @property
    def fallen(self) -> bool:  # type: ignore[override]
        """Whether it lies on the floor, by its own attitude."""
        return self._trot.fallen

    def command(self, twist: Twist) -> Twist:
        """By the walker's gait for it."""
        self._gait = self._body.walker.to_gait(twist)
        return self._body.walker.to_body(self._gait)

    def walk(self, gait: Gait) -> None:
        """From the next tick on."""
        self._gait = gait

    def act(self) -> None:
        """Where the servos shall be at the end of the tick."""
        if self._senses:
            self._targets = self._trot.step(self._gait, self._senses, TICK_S)
        self._data.ctrl[self._motors] = _flat(self._targets)

    def sense(self, imu: ImuSample) -> None:
        """Encoders, feet and inertial unit become one sample."""
        angles = self._data.qpos[self._angles].tolist()
        counts = [round(angle / self._radians) for angle in angles]
        steps = zip(counts, self._counts, strict=True)
        rates = [(now - before) * self._radians / TICK_S for now, before in steps]
        self._counts = counts
        forces = self._data.sensordata[self._touch].tolist()
        self._senses = Senses(
            joints=_by_leg([count * self._radians for count in counts]),
            rates=_by_leg(rates),
            contacts=tuple(force > self._body.contact_n for force in forces),
            orientation=imu.orientation,
            angular_velocity=imu.angular_velocity,
            linear_acceleration=imu.linear_acceleration,
        )
        self._trot.sense(self._senses, TICK_S)
        self._turned += self._trot.odometry.velocity.angular_z * TICK_S

    def wear(self) -> float:
        """Torque heats the windings; what the joints do to the world comes on top."""
        power, resistance = 0.0, self._body.motor.resistance_ohm
        rates = _flat(self._senses.rates) if self._senses else [0.0] * len(self._heat)
        for heat, effort, rate in zip(self._heat, self._efforts(), rates, strict=True):
            amperes = heat.warm(0.0, effort)
            power += amperes * amperes * resistance + max(effort * rate, 0.0)
        return power / self._body.battery.nominal_voltage

    def odometry(self) -> Odometry:
        """By legs and gyroscope."""
        pose, velocity = self._trot.odometry.pose, self._trot.odometry.velocity
        return Odometry(pose.x, pose.y, self._turned, velocity.linear_x, velocity.angular_z)

    def velocity(self) -> Twist:
        """By legs, accelerometer and gyroscope."""
        return self._trot.odometry.velocity

    def motors(self) -> tuple[Motor, ...]:
        """The twelve joints, leg by leg."""
        rates = _flat(self._senses.rates) if self._senses else [0.0] * len(self._heat)
        parts = zip(JOINT_NAMES, self._counts, rates, self._efforts(), self._heat, strict=True)
        return tuple(
            Motor(name, count * self._radians, rate, effort, heat.celsius)
            for name, count, rate, effort, heat in parts
        )

    def contacts(self) -> tuple[bool, ...]:
        """In the order of LEGS."""
        return self._senses.contacts if self._senses else (False,) * len(LEGS)

    def _efforts(self) -> list[float]:
        """Each joint's torque [N m]."""
        return self._data.actuator_force[self._motors].tolist()  # type: ignore[no-any-return]


def _flat(legs: tuple[Vector, ...]) -> list[float]:
    return [angle for leg in legs for angle in leg]


def _by_leg(values: list[float]) -> tuple[Vector, ...]:
    a = iter(values)
    return tuple(zip(a, a, a, strict=True))
