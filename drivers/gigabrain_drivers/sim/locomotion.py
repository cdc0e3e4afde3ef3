"""Motion of a simulated body on wheels or legs, its battery's charge and its motors' heat."""

import abc
import math
from collections import deque
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.kinematics.legs import JOINT_NAMES, LEGS, Gait, Senses, by_joint, by_leg
from gigabrain_drivers.kinematics.trot import Trot
from gigabrain_drivers.kinematics.wheels import Twist
from gigabrain_drivers.sim import STEP_S
from gigabrain_drivers.sim.body import SimBattery, SimBody, SimMotor, SimQuadruped
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.sensors import ImuSample
from gigabrain_zenoh.errors import Unsupported

HOUR_S = 3600.0

VELOCITY_TICKS = 5  # velocity is a mean over 50 ms, as a shorter one shows encoder noise
REST = Twist(0.0, 0.0, 0.0)


class Charge(NamedTuple):
    """The battery as the robot's board reports it."""

    voltage: float  # [V], at the terminals
    percentage: float  # 0-100
    current: float  # [A], positive when it drains


class Battery:
    """Integrates the current. The open-circuit voltage is piecewise linear in the charge."""

    def __init__(self, config: SimBattery) -> None:
        self._config = config
        self.left_ah = config.capacity_ah * config.percentage / 100
        self._current = config.idle_current_a

    def drain(self, drive_current: float) -> None:
        """Drain one step of `drive_current` [A] and the idle current."""
        self._current = self._config.idle_current_a + drive_current
        self.left_ah = max(self.left_ah - self._current * STEP_S / HOUR_S, 0.0)

    def read(self) -> Charge:
        """Return the board's report."""
        config, charge = self._config, self.left_ah / self._config.capacity_ah
        if charge > 0.5:
            voltage = config.nominal_voltage
            voltage += (2 * charge - 1) * (config.full_voltage - config.nominal_voltage)
        else:
            voltage = config.empty_voltage
            voltage += 2 * charge * (config.nominal_voltage - config.empty_voltage)
        return Charge(
            voltage - self._current * config.internal_resistance_ohm, 100 * charge, self._current
        )


class MotorHeat:
    """A motor's temperature: the squared current heats it, and the air cools it."""

    def __init__(self, config: SimMotor) -> None:
        self._config = config
        self.celsius = config.ambient_celsius

    def warm(self, free_current: float, torque: float) -> float:
        """Heat for one step of no-load current [A] and torque [N m]; return the current [A]."""
        config = self._config
        current = free_current + abs(torque) / config.torque_per_ampere
        cooling = (self.celsius - config.ambient_celsius) / config.thermal_resistance
        power = current * current * config.resistance_ohm - cooling
        self.celsius += power * STEP_S / config.heat_capacity
        return current


class Motor(NamedTuple):
    """A motor's report of its joint."""

    name: str  # of its joint
    position: float  # [rad]
    velocity: float  # [rad/s]
    effort: float  # [N m]
    temperature: float  # [deg C]
    current: float | None = None  # [A], if the servo measures it


class OdometryReading(NamedTuple):
    """Pose and velocity from the body's own sensors; the pose is (0, 0, 0) at the start."""

    x: float  # [m]
    y: float  # [m]
    yaw: float  # [rad], not wrapped
    linear_x: float  # [m/s]
    angular_z: float  # [rad/s]


class Locomotion(abc.ABC):
    """The body's own firmware: commands to motors, and sensors to odometry, without ground truth.

    In each step of 10 ms, call `act` before the physics, and `sense` and `wear` after it.
    """

    fallen = False  # True once the body lies on the floor

    @abc.abstractmethod
    def command(self, twist: Twist) -> Twist:
        """Set the target velocity; return the one that the body can reach."""

    def walk(self, gait: Gait) -> None:
        """Set the target gait instead. Raises Unsupported for a body without legs."""
        raise Unsupported("this body has no legs to walk on")

    @abc.abstractmethod
    def act(self) -> None:
        """Set the motors for the next step."""

    @abc.abstractmethod
    def sense(self, imu: ImuSample) -> None:
        """Read encoders and inertial unit after the step."""

    @abc.abstractmethod
    def wear(self) -> float:
        """Heat the motors by the past step; return their current [A]."""

    @abc.abstractmethod
    def odometry(self) -> OdometryReading:
        """Return pose and velocity."""

    @abc.abstractmethod
    def velocity(self) -> Twist:
        """Return the measured velocity, with its lateral part."""

    @abc.abstractmethod
    def motors(self) -> tuple[Motor, ...]:
        """Return all driven joints."""

    def contacts(self) -> tuple[bool, ...]:
        """Return for each foot whether it bears weight; empty without feet."""
        return ()


class Fixed(Locomotion):
    """A base that is screwed to the floor."""

    def command(self, twist: Twist) -> Twist:
        """Ignore the command."""
        return REST

    def act(self) -> None:
        """Do nothing."""

    def sense(self, imu: ImuSample) -> None:
        """Do nothing."""

    def wear(self) -> float:
        """Return 0: there are no motors."""
        return 0.0

    def odometry(self) -> OdometryReading:
        """Return the fixed pose."""
        return OdometryReading(0.0, 0.0, 0.0, 0.0, 0.0)

    def velocity(self) -> Twist:
        """Return zero."""
        return REST

    def motors(self) -> tuple[Motor, ...]:
        """Return an empty tuple."""
        return ()


class Wheels(Locomotion):
    """A wheeled base: motors and encoders of wheels and steering. Wheels may slip.

    Wheels reach the commanded speed with the maximum acceleration.
    """

    def __init__(self, body: SimBody, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._body, self._data = body, data
        self._kinematics = body.kinematics
        self._angles = [int(model.joint(f"{ROBOT}{n}_joint").qposadr[0]) for n in body.wheels]
        self._motors = [int(model.actuator(f"{ROBOT}{n}").id) for n in body.wheels]
        self._heat = [MotorHeat(body.motor) for _ in body.wheels]
        self._angle_per_tick = math.tau / body.encoder_ticks
        self._rolling = len(body.rolling)  # number of driven wheels, which precede the steering
        data.qpos[self._angles[: self._rolling]] = 0.0  # encoders start at 0
        angles = data.qpos[self._angles].tolist()
        self._target = self._speed = tuple(angles)  # [rad/s] for wheels, [rad] for steering
        self._counts = tuple(self._next_count(angle, 0) for angle in angles)
        self._history = deque([self._counts] * (VELOCITY_TICKS + 1), maxlen=VELOCITY_TICKS + 1)
        self._x = self._y = self._yaw = 0.0

    def command(self, twist: Twist) -> Twist:
        """Set the target velocity; if a wheel would be too fast, all are scaled down."""
        wheels = self._kinematics.to_wheels(twist)
        speeds = wheels[: self._rolling]
        scale = max(map(abs, speeds)) / self._body.max_wheel_speed
        if scale > 1:
            speeds = tuple(speed / scale for speed in speeds)
        steering = wheels[self._rolling :] if any(speeds) else self._target[self._rolling :]
        self._target = (*speeds, *steering)
        return self._kinematics.to_body(self._target)

    def act(self) -> None:
        """Set the wheel speeds and the steering of the next step."""
        step, control = self._body.max_wheel_acceleration * STEP_S, self._data.ctrl
        self._speed = tuple(
            now + min(max(target - now, -step), step)
            for target, now in zip(self._target, self._speed, strict=True)
        )
        for motor, speed in zip(self._motors, self._speed, strict=True):
            control[motor] = speed

    def sense(self, imu: ImuSample) -> None:
        """Count the encoder ticks of the past step."""
        position = self._data.qpos
        self._counts = tuple(
            self._next_count(float(position[angle]), count)
            for angle, count in zip(self._angles, self._counts, strict=True)
        )
        self._history.append(self._counts)

    def _next_count(self, angle: float, count: int) -> int:
        """Return the new count, with hysteresis, so that it is constant for a wheel at rest."""
        return count + math.trunc(angle / self._angle_per_tick - count)

    def wear(self) -> float:
        """Heat the motors by speed and torque; return their current [A]."""
        config, effort, current = self._body, self._data.actuator_force.tolist(), 0.0
        per_speed = config.battery.drive_current_a / len(self._heat) / config.max_wheel_speed
        wheels = zip(self._heat, self._motors, self._speeds(self._angle_per_tick), strict=True)
        for heat, motor, speed in wheels:
            current += heat.warm(per_speed * abs(speed), effort[motor])
        return current

    def motors(self) -> tuple[Motor, ...]:
        """Return the motors of wheels and steering."""
        effort = self._data.actuator_force
        speeds = self._speeds(self._angle_per_tick)
        parts = zip(self._body.wheels, self._counts, speeds, self._motors, self._heat, strict=True)
        return tuple(
            Motor(
                name=f"{name}_joint",
                position=count * self._angle_per_tick,
                velocity=speed,
                effort=float(effort[motor]),
                temperature=heat.celsius,
            )
            for name, count, speed, motor, heat in parts
        )

    def _speeds(self, per_tick: float) -> tuple[float, ...]:
        """Return the speed of all motors, in units of `per_tick` per second."""
        per_second = per_tick / (VELOCITY_TICKS * STEP_S)
        pairs = zip(self._counts, self._history[0], strict=True)
        return tuple((now - before) * per_second for now, before in pairs)


class Rolling(Wheels):
    """A differential base with two wheels, left and right."""

    def __init__(self, body: SimBody, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        super().__init__(body, model, data)
        radius = body.odometry_wheel_radius or body.wheel_radius
        self._metres_per_tick = self._angle_per_tick * radius

    def sense(self, imu: ImuSample) -> None:
        """Integrate the encoder ticks of the past step at the mid heading."""
        before = self._counts
        super().sense(imu)
        left, right = self._counts
        moved = (left + right - before[0] - before[1]) / 2 * self._metres_per_tick
        yaw = (right - left) * self._metres_per_tick / self._body.wheel_separation
        mid_heading = (yaw + self._yaw) / 2
        self._x += moved * math.cos(mid_heading)
        self._y += moved * math.sin(mid_heading)
        self._yaw = yaw

    def odometry(self) -> OdometryReading:
        """Return pose and velocity from the wheel encoders alone."""
        left, right = self._speeds(self._metres_per_tick)
        turn = (right - left) / self._body.wheel_separation
        return OdometryReading(self._x, self._y, self._yaw, (left + right) / 2, turn)

    def velocity(self) -> Twist:
        """Return the velocity from the wheel encoders alone."""
        odometry = self.odometry()
        return Twist(odometry.linear_x, 0.0, odometry.angular_z)


class FreeRolling(Wheels):
    """Any other wheeled base; if its wheels scrub, the gyroscope gives the heading."""

    def __init__(self, body: SimBody, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        super().__init__(body, model, data)
        self._scale = (body.odometry_wheel_radius or body.wheel_radius) / body.wheel_radius
        self._rates: deque[float] = deque([0.0] * VELOCITY_TICKS, maxlen=VELOCITY_TICKS)  # [rad/s]

    def sense(self, imu: ImuSample) -> None:
        """Integrate encoder ticks, and perhaps the gyroscope, at the mid heading."""
        before = self._counts
        super().sense(imu)
        moved = self._body_motion(before, 1.0)
        self._rates.append(imu.angular_velocity[2])
        turn = imu.angular_velocity[2] * STEP_S if self._body.gyro_heading else moved.angular_z
        mid_heading = self._yaw + turn / 2
        cos, sin = math.cos(mid_heading), math.sin(mid_heading)
        self._x += cos * moved.linear_x - sin * moved.linear_y
        self._y += sin * moved.linear_x + cos * moved.linear_y
        self._yaw += turn

    def odometry(self) -> OdometryReading:
        """Return pose and velocity from encoders, and from the gyroscope if wheels scrub."""
        velocity = self.velocity()
        return OdometryReading(self._x, self._y, self._yaw, velocity.linear_x, velocity.angular_z)

    def velocity(self) -> Twist:
        """Return the mean velocity of the last 50 ms."""
        moved = self._body_motion(self._history[0], VELOCITY_TICKS * STEP_S)
        if not self._body.gyro_heading:
            return moved
        turn = sum(self._rates) / len(self._rates)
        return moved._replace(angular_z=turn)

    def _body_motion(self, since: tuple[int, ...], seconds: float) -> Twist:
        """Return the mean velocity since the encoder counts `since`, over `seconds`."""
        wheels, unit = self._rolling, self._angle_per_tick
        pairs = zip(self._counts[:wheels], since[:wheels], strict=True)
        speeds = [(now - before) * unit * self._scale / seconds for now, before in pairs]
        steering = [count * unit for count in self._counts[wheels:]]
        return self._kinematics.to_body((*speeds, *steering))


class Walking(Locomotion):
    """A quadruped that trots, controlled by its own sensors. It stands at the start."""

    def __init__(self, body: SimQuadruped, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._body, self._data = body, data
        names = [f"{ROBOT}{name}" for name in JOINT_NAMES]
        self._angles = np.array([model.joint(name).qposadr[0] for name in names])
        self._motors = np.array([model.actuator(name).id for name in names])
        self._touch = np.array([model.sensor(f"{ROBOT}{leg}_contact").adr[0] for leg in LEGS])
        self._heat = [MotorHeat(body.motor) for _ in names]
        self._angle_per_tick = math.tau / body.encoder_ticks
        self._gait = body.walker.to_gait(REST)
        height = self._gait.height
        self._targets = body.geometry.standing(height)
        standing = by_joint(self._targets)
        data.qpos[self._angles] = data.ctrl[self._motors] = standing
        self._counts = [round(angle / self._angle_per_tick) for angle in standing]
        stiffness = float(model.actuator_gainprm[self._motors[0], 0])
        mass = float(model.body_subtreemass[model.body(f"{ROBOT}base").id])
        self._trot = Trot(body.geometry, mass, stiffness, height)
        self._senses: Senses | None = None
        self._yaw = 0.0  # [rad], not wrapped

    def resume(self, qpos: NDArray[np.float64]) -> None:
        """Stand on the feet as they are, and rise from there."""
        angles = qpos[self._angles].tolist()
        self._data.qpos[self._angles] = self._data.ctrl[self._motors] = angles
        self._counts = [round(angle / self._angle_per_tick) for angle in angles]
        self._targets = by_leg(angles)
        self._trot.resume(self._targets)

    @property
    def fallen(self) -> bool:  # type: ignore[override]
        """True once the body lies on the floor, by its inertial unit."""
        return self._trot.fallen

    def command(self, twist: Twist) -> Twist:
        """Set the gait for a velocity; return the velocity of that gait."""
        self._gait = self._body.walker.to_gait(twist)
        return self._body.walker.to_body(self._gait)

    def walk(self, gait: Gait) -> None:
        """Set the gait from the next step on."""
        self._gait = gait

    def act(self) -> None:
        """Set the servos' targets for the end of the step."""
        if self._senses:
            self._targets = self._trot.step(self._gait, self._senses, STEP_S)
        self._data.ctrl[self._motors] = by_joint(self._targets)

    def sense(self, imu: ImuSample) -> None:
        """Combine encoders, foot contacts and inertial unit into one sample."""
        angles = self._data.qpos[self._angles].tolist()
        counts = [round(angle / self._angle_per_tick) for angle in angles]
        steps = zip(counts, self._counts, strict=True)
        rates = [(now - before) * self._angle_per_tick / STEP_S for now, before in steps]
        self._counts = counts
        forces = self._data.sensordata[self._touch].tolist()
        self._senses = Senses(
            joints=by_leg([count * self._angle_per_tick for count in counts]),
            rates=by_leg(rates),
            contacts=tuple(force > self._body.contact_n for force in forces),
            orientation=imu.orientation,
            angular_velocity=imu.angular_velocity,
            linear_acceleration=imu.linear_acceleration,
        )
        self._trot.sense(self._senses, STEP_S)
        self._yaw += self._trot.odometry.velocity.angular_z * STEP_S

    def wear(self) -> float:
        """Heat the windings by torque; add the joints' mechanical power to the current."""
        power, resistance = 0.0, self._body.motor.resistance_ohm
        rates = by_joint(self._senses.rates) if self._senses else [0.0] * len(self._heat)
        for heat, effort, rate in zip(self._heat, self._efforts(), rates, strict=True):
            current = heat.warm(0.0, effort)
            power += current * current * resistance + max(effort * rate, 0.0)
        return power / self._body.battery.nominal_voltage

    def odometry(self) -> OdometryReading:
        """Return pose and velocity from legs and gyroscope."""
        pose, velocity = self._trot.odometry.pose, self._trot.odometry.velocity
        return OdometryReading(pose.x, pose.y, self._yaw, velocity.linear_x, velocity.angular_z)

    def velocity(self) -> Twist:
        """Return the velocity from legs, accelerometer and gyroscope."""
        return self._trot.odometry.velocity

    def motors(self) -> tuple[Motor, ...]:
        """Return the twelve joints, leg by leg."""
        rates = by_joint(self._senses.rates) if self._senses else [0.0] * len(self._heat)
        parts = zip(JOINT_NAMES, self._counts, rates, self._efforts(), self._heat, strict=True)
        return tuple(
            Motor(name, count * self._angle_per_tick, rate, effort, heat.celsius)
            for name, count, rate, effort, heat in parts
        )

    def contacts(self) -> tuple[bool, ...]:
        """Return whether each foot bears weight, in the order of LEGS."""
        return self._senses.contacts if self._senses else (False,) * len(LEGS)

    def _efforts(self) -> list[float]:
        """Return each joint's torque [N m]."""
        return self._data.actuator_force[self._motors].tolist()  # type: ignore[no-any-return]
