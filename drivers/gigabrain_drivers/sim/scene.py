"""From a world and a body to one MuJoCo model."""

import logging
import math

import mujoco

from gigabrain_drivers.sim.body import SimBody, SimModel
from gigabrain_drivers.sim.geometry import Box, Pose, Shape
from gigabrain_drivers.sim.looks import FLOOR, add_light, add_materials
from gigabrain_drivers.sim.person import RADIUS_M
from gigabrain_drivers.sim.tick import TICK_S
from gigabrain_drivers.sim.world import World
from gigabrain_zenoh.errors import ConfigError

log = logging.getLogger(__name__)

ROBOT = "robot/"  # prefix of all names of the robot's model
PERSON = "person"
UNLIKE = 0.05  # share by which two measures differ that should be the same
PERSON_HEIGHT_M = 1.45  # to the shoulders


def compile_scene(body: SimModel, world: World) -> mujoco.MjModel:
    """The model of `body` at the start of `world`. Raises ConfigError for a bad robot model."""
    mujoco.set_mju_user_warning(log.warning)  # instead of a file
    spec = world_spec(world)
    spec.option.timestep = TICK_S / body.substeps
    start = world.start
    try:
        robot = _robot_spec(body)
        frame = spec.worldbody.add_frame(pos=(start.x, start.y, 0), quat=yaw_quaternion(start))
        spec.attach(robot, prefix=ROBOT, frame=frame)
        return spec.compile()
    except ValueError as error:
        raise ConfigError(f"{body.path}: this MJCF model cannot be used: {error}") from error


def yaw_quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """The heading as a quaternion (w, x, y, z)."""
    return math.cos(pose.yaw / 2), 0.0, 0.0, math.sin(pose.yaw / 2)


def _robot_spec(body: SimModel) -> mujoco.MjSpec:
    """The robot's own model; worn wheels are smaller and hang lower, so the base stays level."""
    spec = mujoco.MjSpec.from_string(body.model)
    _check_names(spec, body)
    if not isinstance(body, SimBody):
        return spec
    _compare_wheels(spec, body)
    for name in body.wheels:
        wheel = spec.body(name)
        radius = spec.geom(name).size[0]
        wheel.pos[2] -= radius * (1 - body.wheel_scale)
        for geom in wheel.geoms:
            geom.size = geom.size * body.wheel_scale
    return spec


def _compare_wheels(spec: mujoco.MjSpec, body: SimBody) -> None:
    """Warn where the wheels of the model are not those of the robot's file."""
    left, right = (spec.body(name) for name in body.wheels)
    apart = math.dist(left.pos[:2], right.pos[:2])
    pairs = [("wheel_separation", body.wheel_separation, apart)]
    if body.wheel_scale == 1.0 and body.odometry_wheel_radius is None:  # else it is on purpose
        pairs.append(("wheel_radius", body.wheel_radius, spec.geom(body.wheels[0]).size[0]))
    for name, told, is_in_model in pairs:
        if abs(told / is_in_model - 1.0) > UNLIKE:
            log.warning(
                "%s: the wheels have a %s of %.3f m here, and of %.3f m in the robot's file",
                body.path, name, is_in_model, told,
            )  # fmt: skip


def _check_names(spec: mujoco.MjSpec, body: SimModel) -> None:
    """Raises ValueError naming what the model must have and has not."""
    wanted = [("body", "base"), ("joint", "free"), *body.parts()]
    wanted += [("sensor", name) for name in ("gyro", "accelerometer", "attitude")]
    if body.lidar:
        wanted.append(("site", "lidar"))
    find = {
        "body": spec.body,
        "joint": spec.joint,
        "geom": spec.geom,
        "actuator": spec.actuator,
        "sensor": spec.sensor,
        "site": spec.site,
    }
    missing = [f"{kind} {name!r}" for kind, name in wanted if find[kind](name) is None]
    if missing:
        raise ValueError(f"it has no {', no '.join(missing)}")


def world_spec(world: World) -> mujoco.MjSpec:
    """The world alone, not compiled, for one robot to be attached to."""
    spec = mujoco.MjSpec()
    spec.modelname = world.name
    _set_options(spec)
    add_materials(spec, world)
    add_light(spec)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name=FLOOR, type=plane, size=(0, 0, 0.05), material=FLOOR)
    for shape in world.everything():
        _add_shape(spec, shape)
    if world.path:
        _add_person(spec)
    return spec


def _set_options(spec: mujoco.MjSpec) -> None:
    """The solver's settings; the robots' models have none, or they would be ignored."""
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    # Without this a simulation that diverges goes back to its start without a word.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _add_shape(spec: mujoco.MjSpec, shape: Shape) -> None:
    half = shape.height / 2
    solid = int(shape.bottom == 0)
    geom = spec.worldbody.add_geom(
        pos=(shape.x, shape.y, shape.bottom + half),
        material=shape.material,
        contype=solid,
        conaffinity=solid,
    )
    if isinstance(shape, Box):
        geom.type = mujoco.mjtGeom.mjGEOM_BOX
        geom.size = (shape.half_x, shape.half_y, half)
        geom.quat = yaw_quaternion(Pose(shape.x, shape.y, shape.yaw))
    else:
        geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        geom.size = (shape.radius, half, 0)


def _add_person(spec: mujoco.MjSpec) -> None:
    """A figure as wide at the floor as at the hips, so that a low lidar sees what can be hit."""
    person = spec.worldbody.add_body(name=PERSON, mocap=True)
    person.add_geom(
        name=PERSON,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(RADIUS_M, 0, 0),
        material="blue",
        fromto=(0, 0, 0, 0, 0, PERSON_HEIGHT_M - RADIUS_M),
    )
    person.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(0.14, 0, 0),
        material="skin",
        pos=(0, 0, PERSON_HEIGHT_M + 0.1),
        contype=0,
        conaffinity=0,
    )
    person.add_geom(
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=(0.16, 0.15, 0.1),
        material="dark_wood",
        pos=(-0.02, 0, PERSON_HEIGHT_M + 0.18),
        contype=0,
        conaffinity=0,
    )
