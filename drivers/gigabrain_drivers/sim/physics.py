"""A body in a world, one tick of 10 ms at a time. No bus, no clock and no thread of its own."""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.body import SimBattery, SimBody, SimLidar, SimMotor
from gigabrain_drivers.sim.geometry import ClosedPath
from gigabrain_drivers.sim.imu import Imu, ImuSample
from gigabrain_drivers.sim.lidar import Lidar
from gigabrain_drivers.sim.person import Person
from gigabrain_drivers.sim.scene import PERSON, ROBOT, compile_scene, yaw_quaternion
from gigabrain_drivers.sim.streams import Stream, generator
from gigabrain_drivers.sim.tick import SUBSTEPS, TICK_NS
from gigabrain_drivers.sim.truth import Truth
from gigabrain_drivers.sim.wear import Battery, Charge, MotorHeat
from gigabrain_drivers.sim.wheels import DifferentialBase, Odometry
from gigabrain_drivers.sim.world import World
from gigabrain_zenoh.errors import BodyLost, Unsupported

__all__ = [
    "Charge",
    "ImuSample",
    "Odometry",
    "SimBattery",
    "SimBody",
    "SimLidar",
    "SimMotor",
    "Simulation",
    "Wheel",
]

EDGE_OF_THE_WORLD_M = 1e3


class Wheel(NamedTuple):
    """One wheel as its motor reports it."""

    name: str  # of its joint
    position: float  # [rad]
    velocity: float  # [rad/s]
    effort: float  # [N m]
    temperature: float  # [deg C]


class Simulation:
    """The same body, world, seed and calls give the same numbers, bit for bit."""

    def __init__(self, body: SimBody, world: World, seed: int) -> None:
        self.model = compile_scene(body, world)
        self.data = mujoco.MjData(self.model)
        self._ticks = 0
        self._body, self._base = body, DifferentialBase(body)
        self._angles = [int(self.model.joint(self._joint(n)).qposadr[0]) for n in body.wheels]
        self._motors = [int(self.model.actuator(f"{ROBOT}{n}").id) for n in body.wheels]
        self._height = int(self.model.joint(f"{ROBOT}free").qposadr[0]) + 2
        self._battery = Battery(body.battery)
        self._heat = [MotorHeat(body.motor) for _ in body.wheels]
        self._person = Person(ClosedPath(world.path), world.person_start) if world.path else None
        self._place_person()
        self.truth = Truth(self.model, self.data)
        self._imu = Imu(self.model, self.data, world.start.yaw, generator(seed, Stream.IMU))
        self._sample = self._imu.sample()
        self._lidar = (
            Lidar(body.lidar, self.model, f"{ROBOT}lidar", generator(seed, Stream.LIDAR))
            if body.lidar
            else None
        )

    @property
    def time_ns(self) -> int:
        """Simulated time since the start."""
        return self._ticks * TICK_NS

    def command(self, linear_x: float, angular_z: float) -> tuple[float, float]:
        """Aim for a velocity [m/s], [rad/s]; returns the one the wheels can turn fast enough for.

        The wheels get there at their greatest acceleration.
        """
        return self._base.command(linear_x, angular_z)

    def advance(self) -> None:
        """Simulate the next 10 ms. Raises BodyLost when the physics has come apart."""
        if self._person:
            robot = self.truth.pose()
            self._person.advance(lambda x, y: self.truth.footprint.distance(robot, x, y))
            self._place_person()
        left, right = self._base.ramp()
        control = self.data.ctrl
        control[self._motors[0]], control[self._motors[1]] = left, right
        mujoco.mj_step(self.model, self.data, nstep=SUBSTEPS)
        self._ticks += 1
        self._check()
        position = self.data.qpos
        self._base.measure(float(position[self._angles[0]]), float(position[self._angles[1]]))
        self._wear()
        self._sample = self._imu.sample()
        self.truth.update()

    def scan(self) -> NDArray[np.float32]:
        """Ranges (beams,) [m] from straight ahead counter-clockwise; inf: nothing in range.

        Raises Unsupported when the body has no lidar.
        """
        if self._lidar is None:
            raise Unsupported("this body has no lidar")
        return self._lidar.scan(self.data)

    def odometry(self) -> Odometry:
        """Pose and velocity by the wheel encoders."""
        return self._base.odometry()

    def imu(self) -> ImuSample:
        """The inertial unit's sample of this tick."""
        return self._sample

    def wheels(self) -> tuple[Wheel, ...]:
        """Left and right wheel."""
        effort = self.data.actuator_force
        parts = zip(self._body.wheels, self._base.wheels(), self._motors, self._heat, strict=True)
        return tuple(
            Wheel(f"{name}_joint", angle, speed, float(effort[motor]), heat.celsius)
            for name, (angle, speed), motor, heat in parts
        )

    def battery(self) -> Charge:
        """Voltage, percentage 0-100 and current, positive when it drains."""
        return self._battery.read()

    def bumper(self) -> bool:
        """Whether the robot touches anything but the floor right now."""
        return self.truth.touching

    def _joint(self, wheel: str) -> str:
        return f"{ROBOT}{wheel}_joint"

    def _place_person(self) -> None:
        if self._person:
            pose, place = self._person.pose, self.model.body(PERSON).mocapid[0]
            self.data.mocap_pos[place, :2] = pose.x, pose.y
            self.data.mocap_quat[place] = yaw_quaternion(pose)

    def _check(self) -> None:
        """A diverging simulation shows as NaN, or as a robot that flies away."""
        x, y, z = self.data.qpos[self._height - 2 : self._height + 1].tolist()
        if not (abs(x) < EDGE_OF_THE_WORLD_M and abs(y) < EDGE_OF_THE_WORLD_M and abs(z) < 1):
            raise BodyLost(f"the simulation came apart after {self.time_ns / 1e9:.2f} s")

    def _wear(self) -> None:
        """Motors warm with their load, and take from the battery what they need."""
        config, effort, current = self._body, self.data.actuator_force.tolist(), 0.0
        share = config.battery.drive_current_a / len(self._heat) / config.max_wheel_speed
        wheels = zip(self._heat, self._motors, self._base.wheels(), strict=True)
        for heat, motor, (_, speed) in wheels:
            current += heat.warm(share * abs(speed), effort[motor])
        self._battery.drain(current)
