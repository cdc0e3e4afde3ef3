"""A body in a world, simulated in steps of 10 ms, without bus, clock or threads."""

import hashlib
import logging
from dataclasses import replace
from typing import Any

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.kinematics.legs import Gait
from gigabrain_drivers.kinematics.wheels import Differential, Twist
from gigabrain_drivers.sim import STEP_NS
from gigabrain_drivers.sim.arm import SimArm
from gigabrain_drivers.sim.body import (
    SimBody,
    SimModel,
    SimQuadruped,
)
from gigabrain_drivers.sim.checkpoint import Checkpoint, CheckpointFiles
from gigabrain_drivers.sim.locomotion import (
    Battery,
    Charge,
    Fixed,
    FreeRolling,
    Locomotion,
    Motor,
    OdometryReading,
    Rolling,
    Walking,
)
from gigabrain_drivers.sim.scene import PERSON, ROBOT, Person, compile_scene, yaw_quaternion
from gigabrain_drivers.sim.sensors import Imu, ImuSample, Lidar
from gigabrain_drivers.sim.things import Things
from gigabrain_drivers.sim.truth import Truth
from gigabrain_drivers.sim.world import Stream, World, generator
from gigabrain_zenoh.errors import BodyLost, ConfigError, Unsupported

log = logging.getLogger(__name__)

GRAVITY = 9.81  # [m/s2]
STALL_AMPERES = 1.4  # stall current of the usual motor
STALL_FRICTION_FACTOR = 4.0  # added stall torque, as a multiple of the gears' friction
MAX_COORDINATE_M = 1e3  # farther away, the physics has diverged
PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS.value
DIVERGENCE_WARNINGS = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


class Simulation:
    """A body in a world. The same body, world, seed and calls give identical results."""

    def __init__(
        self, body: SimModel, world: World, seed: int, checkpoint: Checkpoint | None = None
    ) -> None:
        """Start at the world's start, or at rest at a checkpoint. Raises ConfigError."""
        self.model = compile_scene(body, world)
        self._digest = _digest(self.model)
        body = with_motors(body, self.model)
        self.data = mujoco.MjData(self.model)
        self._warnings = [self.data.warning[kind] for kind in DIVERGENCE_WARNINGS]
        self._steps, self._substeps = 0, body.substeps
        self._locomotion = make_locomotion(body, self.model, self.data)
        self._base = self.model.body(f"{ROBOT}base").id
        self.arm = SimArm(body, self.model, self.data) if body.joints else None
        self._battery = Battery(body.battery)
        self._people = {
            self.model.body(f"{PERSON}{number + 1 if number else ''}").id: Person(walk)
            for number, walk in enumerate(world.people)
        }
        self._past_stops = 0  # stops of people before a checkpoint, or who were removed
        self._place_people()
        self.truth = Truth(self.model, self.data)
        self.things = Things(self.model, self.data, world, self.truth, self._set_walking)
        if world.start_fixed and self.truth.touching:
            raise ConfigError(
                f"{world.start_place()}: the robot touches something at its start "
                f"({world.start.x:g}, {world.start.y:g}); expected a `start` with room round it"
            )
        yaw = world.start.yaw
        if checkpoint:
            self._resume(checkpoint, body)
            yaw = self.truth.pose().yaw
        self._imu = Imu(self.model, self.data, yaw, generator(seed, Stream.IMU))
        self._sample = self._imu.sample()
        self._lidar = (
            Lidar(body.lidar, self.model, f"{ROBOT}lidar", generator(seed, Stream.LIDAR))
            if body.lidar
            else None
        )

    def checkpoint(self) -> Checkpoint:
        """Return the state at the end of this step."""
        physics = np.empty(mujoco.mj_stateSize(self.model, PHYSICS))
        mujoco.mj_getState(self.model, self.data, physics, PHYSICS)
        arm, truth = self.arm, self.truth
        return Checkpoint(
            model=self._digest,
            steps=self._steps,
            physics=physics.tobytes(),
            charge_ah=self._battery.left_ah,
            aims=arm.targets if arm else (),
            limp=bool(arm and arm.limp),
            things=self.things.all(),
            walked=tuple(person.walked for person in self._people.values()),
            person_stood=self.person_stood,
            contacts=truth.contacts,
            falls=truth.falls,
            min_clearance_m=truth.min_clearance_m,
            distance_m=truth.distance_m,
        )

    def _resume(self, checkpoint: Checkpoint, body: SimModel) -> None:
        """Continue at rest, with odometry from zero. Raises ConfigError."""
        if checkpoint.model != self._digest:
            raise ConfigError("the checkpoint is of another body or world")
        physics = np.frombuffer(checkpoint.physics)
        mujoco.mj_setState(self.model, self.data, physics, PHYSICS)
        self.data.qvel[:] = 0.0
        self._steps, joints = checkpoint.steps, self.data.qpos.copy()
        self._locomotion = make_locomotion(body, self.model, self.data)
        if isinstance(self._locomotion, Walking):  # wheels count from zero
            self._locomotion.resume(joints)
        if self.arm:
            self.arm.restore(checkpoint.aims, limp=checkpoint.limp)
        self._battery.left_ah = checkpoint.charge_ah
        self.things.restore(checkpoint.things)
        for person, walked in zip(self._people.values(), checkpoint.walked, strict=True):
            person.go_to(walked)
        self._past_stops = checkpoint.person_stood
        self._place_people()
        mujoco.mj_forward(self.model, self.data)
        if self.truth.tipped:
            raise ConfigError("the robot had fallen over")
        self.truth.restore(
            contacts=checkpoint.contacts,
            falls=checkpoint.falls,
            min_clearance_m=checkpoint.min_clearance_m,
            distance_m=checkpoint.distance_m,
        )

    @property
    def time_ns(self) -> int:
        """Simulated time since the start [ns]."""
        return self._steps * STEP_NS

    def people(self) -> tuple[Person, ...]:
        """Return the walking people of this world."""
        return tuple(self._people.values())

    @property
    def person_stood(self) -> int:
        """The number of times that people had to stand for the robot."""
        return self._past_stops + sum(person.stood for person in self._people.values())

    def command(self, linear_x: float, angular_z: float) -> tuple[float, float]:
        """Drive without sideways motion; return (forward, turning) as `drive` does."""
        twist = self.drive(linear_x, 0.0, angular_z)
        return twist.linear_x, twist.angular_z

    def drive(self, linear_x: float, linear_y: float, angular_z: float) -> Twist:
        """Set the target velocity [m/s, m/s, rad/s]; return it within the body's abilities.

        The body accelerates to it as fast as it can.
        """
        return self._locomotion.command(Twist(linear_x, linear_y, angular_z))

    def walk(self, gait: Gait) -> None:
        """Set the target gait. Raises Unsupported for a body without legs."""
        self._locomotion.walk(gait)

    def advance(self) -> None:
        """Simulate the next 10 ms. Raises BodyLost when the physics diverges."""
        if self._people:
            robot = self.truth.pose()
            for person in self._people.values():
                person.advance(lambda x, y: self.truth.footprint.distance(robot, x, y))
            self._place_people()
        self._locomotion.act()
        if self.arm:
            for _ in range(self._substeps):
                self.arm.act()
                mujoco.mj_step(self.model, self.data)
        else:
            mujoco.mj_step(self.model, self.data, nstep=self._substeps)
        self._steps += 1
        self._check()
        self._sample = self._imu.sample()
        self._locomotion.sense(self._sample)
        current = self._locomotion.wear()
        if self.arm:
            self.arm.sense()
            current += self.arm.wear()
        self._battery.drain(current)
        self.truth.update()

    def scan(self) -> NDArray[np.float32]:
        """Return the ranges (beams,) [m], counter-clockwise from straight ahead; inf without a hit.

        Raises Unsupported when the body has no lidar.
        """
        if self._lidar is None:
            raise Unsupported("this body has no lidar")
        return self._lidar.scan(self.data)

    def odometry(self) -> OdometryReading:
        """Return pose and velocity as measured by the body's sensors."""
        return self._locomotion.odometry()

    def velocity(self) -> Twist:
        """Return the velocity as measured by the body's sensors, including the sideways one."""
        return self._locomotion.velocity()

    def imu(self) -> ImuSample:
        """Return the sample of the IMU in this step."""
        return self._sample

    def motors(self) -> tuple[Motor, ...]:
        """Return all driven joints, those of the arm last."""
        return (*self._locomotion.motors(), *(self.arm.motors() if self.arm else ()))

    def contacts(self) -> tuple[bool, ...]:
        """Return for each foot whether it bears weight, by its sensor; empty on wheels."""
        return self._locomotion.contacts()

    @property
    def fallen(self) -> bool:
        """True once the body lies on the floor, by its attitude."""
        return self._locomotion.fallen

    def battery(self) -> Charge:
        """Return voltage, percentage 0-100 and current, positive while discharging."""
        return self._battery.read()

    def bumper(self) -> bool:
        """Return whether the robot, except its hand, touches anything but the floor."""
        return self.truth.touching

    def report(self, robot: RobotFile, run: Run) -> dict[str, Any]:
        """Return the ground truth of the run so far."""
        truth = self.truth
        pose = truth.pose()
        return {
            "body": robot.robot_type,
            "world": run.world,
            "seed": run.seed,
            "sim_seconds": round(self.time_ns / 1e9, 2),
            "distance_m": round(truth.distance_m, 3),
            "contacts": truth.contacts,
            "falls": truth.falls,
            "min_clearance_m": round(truth.min_clearance_m, 3),
            "person_stood": self.person_stood,
            "true_speed": round(truth.speed()[0], 4),
            "true_x": round(pose.x, 4),
            "true_y": round(pose.y, 4),
            "true_yaw": round(pose.yaw, 4),
        }

    def _set_walking(self, body: int, person: Person | None) -> None:
        """Let a spare body walk as `person`; with None, stop it."""
        if person:
            self._people[body] = person
        elif body in self._people:
            self._past_stops += self._people.pop(body).stood

    def _place_people(self) -> None:
        for body, person in self._people.items():
            place = self.model.body_mocapid[body]
            self.data.mocap_pos[place, :2] = person.pose.x, person.pose.y
            self.data.mocap_quat[place] = yaw_quaternion(person.pose)

    def _check(self) -> None:
        """Raise BodyLost after a warning of MuJoCo, or if the robot has flown away."""
        x, y, z = self.data.xpos[self._base].tolist()
        limit = MAX_COORDINATE_M
        diverged = any(warning.number for warning in self._warnings)
        if diverged or not (abs(x) < limit and abs(y) < limit and abs(z) < 1):
            raise BodyLost(f"the simulation diverged after {self.time_ns / 1e9:.2f} s")


def resumed(body: SimModel, world: World, seed: int, files: CheckpointFiles | None) -> Simulation:
    """Resume at the checkpoint of an earlier process of this run, or start the world.

    Raises ConfigError as `Simulation` does.
    """
    if files:
        try:
            if checkpoint := files.read():
                simulation = Simulation(body, world, seed, checkpoint)
                log.info("the simulation continues at %.2f s", simulation.time_ns / 1e9)
                return simulation
        except (ConfigError, OSError) as error:
            log.warning("the simulation starts from the beginning: %s", error)
            files.clear()
    return Simulation(body, world, seed)


def _digest(model: mujoco.MjModel) -> bytes:
    """Return the SHA-256 of a model. Call it before the model is changed."""
    data = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, data)
    return hashlib.sha256(data.tobytes()).digest()


def with_motors(body: SimModel, model: mujoco.MjModel) -> SimModel:
    """Return a body of a foreign model with motors for its weight and its gears' friction."""
    if not body.names or not isinstance(body, SimBody):
        return body
    mass = float(model.body_subtreemass[model.body(f"{ROBOT}base").id])
    grip = mass * GRAVITY * body.wheel_radius  # [N m], of all wheels together
    wheels = [int(model.joint(f"{ROBOT}{name}_joint").dofadr[0]) for name in body.rolling]
    friction = float(model.dof_frictionloss[wheels].max())
    stall = grip + STALL_FRICTION_FACTOR * friction
    torque = max(stall / STALL_AMPERES, body.motor.torque_per_ampere)
    return replace(body, motor=msgspec.structs.replace(body.motor, torque_per_ampere=torque))


def make_locomotion(body: SimModel, model: mujoco.MjModel, data: mujoco.MjData) -> Locomotion:
    """Return the locomotion of a body. Raises ConfigError for an unknown kind."""
    if isinstance(body, SimBody):
        kind = Rolling if isinstance(body.kinematics, Differential) else FreeRolling
        return kind(body, model, data)
    if isinstance(body, SimQuadruped):
        return Walking(body, model, data)
    if body.fixed:
        return Fixed()
    raise ConfigError(f"{type(body).__name__} has neither wheels nor legs")
