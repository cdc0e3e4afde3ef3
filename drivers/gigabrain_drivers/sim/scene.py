"""Compiles a world and a body into one MuJoCo model."""

import logging
import math
from collections.abc import Callable

import mujoco

from gigabrain_drivers.sim import STEP_S
from gigabrain_drivers.sim.body import SimBody, SimModel
from gigabrain_drivers.sim.world import Box, ClosedPath, Pose, Shape, World
from gigabrain_zenoh.errors import ConfigError

log = logging.getLogger(__name__)

FLOOR = "floor"  # name of the floor's geom, material and texture

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

PERSON_RADIUS_M = 0.25
PERSON_SPEED = 0.8  # [m/s]
PERSON_GAP_M = 0.5  # from the person's side to the robot's outer edge
NEW_MEETING_M = 1.0  # walked since it last stood: standing again is another meeting
ROBOT = "robot/"  # prefix of all names of the robot's model
PERSON = "person"
MAX_MISMATCH = 0.05  # share by which two measures differ that should be the same
PERSON_HEIGHT_M = 1.45  # to the shoulders


def add_materials(spec: mujoco.MjSpec, world: World) -> None:
    """Sky, the floor's checks, and a material for each colour that a shape may name."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.80, 0.87, 0.94),
        rgb2=(0.42, 0.52, 0.64),
        width=64,
        height=384,
    )
    spec.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=world.floor[0],
        rgb2=world.floor[1],
        width=128,
        height=128,
    )
    repeat = (0.5 / world.check[0], 0.5 / world.check[1])  # a texture holds two checks each way
    floor = spec.add_material(name=FLOOR, texrepeat=repeat, texuniform=True, reflectance=0.04)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    for name, colour in MATERIALS.items():
        spec.add_material(name=name, rgba=(*colour, 1), specular=0.2, shininess=0.3)


def add_light(spec: mujoco.MjSpec) -> None:
    """A low sun that casts shadows, and soft light from the camera."""
    spec.visual.headlight.ambient = (0.45, 0.45, 0.46)
    spec.visual.headlight.diffuse = (0.30, 0.30, 0.30)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=(0, 0, 5),
        dir=(0.30, 0.38, -0.87),
        diffuse=(0.62, 0.60, 0.56),
        specular=(0.25, 0.25, 0.25),
        castshadow=True,
    )


class Person:
    """Walks a closed path at 0.8 m/s, and stands while one more step would come too close."""

    def __init__(self, path: ClosedPath, start: float) -> None:
        self._path = path
        self._walked = start
        self.pose = path.at(start)
        self.stood = 0  # how often it had to, for the robot
        self._since_m = NEW_MEETING_M

    def advance(self, robot_distance: Callable[[float, float], float]) -> Pose:
        """Walk for one step; `robot_distance(x, y)` is from a point to the robot's edge [m]."""
        walked = (self._walked + PERSON_SPEED * STEP_S) % self._path.length
        ahead = self._path.at(walked)
        gap = robot_distance(ahead.x, ahead.y)
        if gap >= PERSON_GAP_M + PERSON_RADIUS_M or gap > robot_distance(self.pose.x, self.pose.y):
            self._walked, self.pose = walked, ahead
            self._since_m += PERSON_SPEED * STEP_S
        else:
            self.stood += self._since_m >= NEW_MEETING_M
            self._since_m = 0.0
        return self.pose


def compile_scene(body: SimModel, world: World) -> mujoco.MjModel:
    """The model of `body` at the start of `world`. Raises ConfigError for a bad robot model."""
    mujoco.set_mju_user_warning(log.warning)  # instead of a file
    spec = world_spec(world)
    spec.option.timestep = STEP_S / body.substeps
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
    for name in body.rolling:
        wheel = spec.body(name)
        radius = spec.geom(name).size[0]
        wheel.pos[2] -= radius * (1 - body.wheel_scale)
        for geom in wheel.geoms:
            geom.size = geom.size * body.wheel_scale
    return spec


def _compare_wheels(spec: mujoco.MjSpec, body: SimBody) -> None:
    """Warn where the wheels of the model are not those of the robot's file."""
    left, right = (spec.body(name) for name in body.rolling[:2])
    apart = math.dist(left.pos[:2], right.pos[:2])
    pairs = [("wheel_separation", body.wheel_separation, apart)]
    if body.wheel_scale == 1.0 and body.odometry_wheel_radius is None:  # else it is on purpose
        pairs.append(("wheel_radius", body.wheel_radius, spec.geom(body.wheels[0]).size[0]))
    for name, told, is_in_model in pairs:
        if abs(told / is_in_model - 1.0) > MAX_MISMATCH:
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
    # Without this a simulation that diverges goes back to its start silently.
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
        size=(PERSON_RADIUS_M, 0, 0),
        material="blue",
        fromto=(0, 0, 0, 0, 0, PERSON_HEIGHT_M - PERSON_RADIUS_M),
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
