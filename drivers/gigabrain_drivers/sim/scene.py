"""From a world and a body to one MuJoCo model."""

import logging
import math

import mujoco

from gigabrain_drivers.sim.body import SimBody
from gigabrain_drivers.sim.geometry import Box, Pose, Shape
from gigabrain_drivers.sim.person import RADIUS_M
from gigabrain_drivers.sim.tick import TIMESTEP_S
from gigabrain_drivers.sim.world import World
from gigabrain_zenoh.errors import ConfigError

ROBOT = "robot/"  # prefix of all names of the robot's model
FLOOR, PERSON = "floor", "person"
PERSON_HEIGHT_M = 1.45  # to the shoulders

MATERIALS = {
    "wall": (0.93, 0.92, 0.89),
    "wood": (0.66, 0.47, 0.28),
    "dark_wood": (0.36, 0.24, 0.16),
    "carton": (0.76, 0.60, 0.42),
    "white": (0.95, 0.95, 0.95),
    "black": (0.06, 0.06, 0.07),
    "steel": (0.66, 0.69, 0.72),
    "blue": (0.20, 0.36, 0.60),
    "teal": (0.13, 0.52, 0.53),
    "green": (0.38, 0.56, 0.36),
    "leaf": (0.20, 0.46, 0.20),
    "clay": (0.72, 0.38, 0.26),
    "orange": (0.90, 0.48, 0.16),
    "yellow": (0.94, 0.76, 0.26),
    "skin": (0.86, 0.66, 0.53),
}


def compile_scene(body: SimBody, world: World) -> mujoco.MjModel:
    """The model of `body` at the start of `world`. Raises ConfigError for a bad robot model."""
    mujoco.set_mju_user_warning(logging.getLogger(__name__).warning)  # instead of a file
    spec = world_spec(world)
    start = world.start
    try:
        robot = _robot_spec(body)
        frame = spec.worldbody.add_frame(pos=(start.x, start.y, 0), quat=yaw_quaternion(start))
        spec.attach(robot, prefix=ROBOT, frame=frame)
        return spec.compile()
    except ValueError as error:
        raise ConfigError(f"the body's MJCF model cannot be used: {error}") from error


def yaw_quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """The heading as a quaternion (w, x, y, z)."""
    return math.cos(pose.yaw / 2), 0.0, 0.0, math.sin(pose.yaw / 2)


def _robot_spec(body: SimBody) -> mujoco.MjSpec:
    """The robot's own model; worn wheels are smaller and hang lower, so the base stays level."""
    spec = mujoco.MjSpec.from_string(body.model)
    for name in body.wheels:
        wheel = spec.body(name)
        radius = spec.geom(name).size[0]
        wheel.pos[2] -= radius * (1 - body.wheel_scale)
        for geom in wheel.geoms:
            geom.size = geom.size * body.wheel_scale
    return spec


def world_spec(world: World) -> mujoco.MjSpec:
    """The world alone, not compiled, for one robot to be attached to."""
    spec = mujoco.MjSpec()
    spec.modelname = world.name
    _set_options(spec)
    _add_looks(spec, world)
    for shape in world.everything():
        _add_shape(spec, shape)
    if world.path:
        _add_person(spec)
    return spec


def _set_options(spec: mujoco.MjSpec) -> None:
    """The solver's settings; the robots' models have none, or they would be ignored."""
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    # Without this a simulation that diverges goes back to its start without a word.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET


def _add_looks(spec: mujoco.MjSpec, world: World) -> None:
    """Sky, light, colours and the floor."""
    sky, checker = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=sky,
        rgb1=(0.80, 0.87, 0.94),
        rgb2=(0.42, 0.52, 0.64),
        width=64,
        height=384,
    )
    spec.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=checker,
        rgb1=world.floor[0],
        rgb2=world.floor[1],
        width=128,
        height=128,
    )
    floor = spec.add_material(
        name=FLOOR,
        texrepeat=(0.5 / world.check[0], 0.5 / world.check[1]),
        texuniform=True,
        reflectance=0.04,
        specular=0.1,
    )
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    for name, colour in MATERIALS.items():
        spec.add_material(name=name, rgba=(*colour, 1), specular=0.2, shininess=0.3)
    spec.visual.headlight.ambient = (0.45, 0.45, 0.46)
    spec.visual.headlight.diffuse = (0.30, 0.30, 0.30)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(
        type=sun,
        pos=(0, 0, 5),
        dir=(0.30, 0.38, -0.87),
        diffuse=(0.62, 0.60, 0.56),
        specular=(0.25, 0.25, 0.25),
        castshadow=True,
    )
    spec.worldbody.add_geom(
        name=FLOOR, type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05), material=FLOOR
    )


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
