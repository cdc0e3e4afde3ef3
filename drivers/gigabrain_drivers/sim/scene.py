"""Compiles a world and a body into one MuJoCo model."""

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco

from gigabrain_drivers.sim import STEP_S
from gigabrain_drivers.sim.body import SimBody, SimModel
from gigabrain_drivers.sim.mjcf_world import has_floor, load_model, model_error
from gigabrain_drivers.sim.model_measures import align, mismatches
from gigabrain_drivers.sim.model_parts import ROBOT_GROUP, PartFinder
from gigabrain_drivers.sim.world import (
    Ball,
    Box,
    ClosedPath,
    Light,
    Pose,
    Shape,
    WalkingPath,
    World,
)
from gigabrain_drivers.sim.world_file import FLOOR, MATERIALS
from gigabrain_zenoh.errors import ConfigError

log = logging.getLogger(__name__)

SUN = Light((0.62, 0.60, 0.56), direction=(0.30, 0.38, -0.87))
PERSON_RADIUS_M = 0.25
PERSON_GAP_M = 0.5  # from the person's side to the robot's outer edge
NEW_MEETING_M = 1.0  # after this path, another stop counts as a new meeting
WORLD_SETTINGS = ("option", "njmax", "nconmax", "memory")  # of MjSpec
ROBOT = "robot/"  # prefix of names in the robot's model
MODEL = "world/"  # prefix of names in the world's own model
PERSON = "person"  # body of the first person; others have a number appended
WORLD_GROUP = 1  # for the world's geoms that are in the robot's group
SPARE = "spare/"  # prefix of bodies for things that people add while it runs
SPARE_THINGS, SPARE_PEOPLE = 12, 4  # each costs time in every step
UNUSED_M = 0.01  # of a spare body that is not in use
PERSON_HEIGHT_M = 1.45  # to the shoulders


def add_sky(spec: mujoco.MjSpec) -> None:
    """Add a sky that is lighter above."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.80, 0.87, 0.94),
        rgb2=(0.42, 0.52, 0.64),
        width=64,
        height=384,
    )


def add_materials(spec: mujoco.MjSpec, world: World) -> None:
    """Add sky, the floor's checks, and a material for each colour name."""
    add_sky(spec)
    spec.add_texture(
        name=FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=world.floor[0],
        rgb2=world.floor[1],
        width=128,
        height=128,
    )
    repeat = (0.5 / world.check[0], 0.5 / world.check[1])  # a texture has two checks each way
    floor = spec.add_material(name=FLOOR, texrepeat=repeat, texuniform=True, reflectance=0.04)
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = FLOOR
    for name, colour in (MATERIALS | dict(world.materials)).items():
        spec.add_material(name=name, rgba=(*colour, 1), specular=0.2, shininess=0.3)


def add_lights(spec: mujoco.MjSpec, world: World) -> None:
    """Add the world's lights, or a low sun with shadows, and a soft light at the camera."""
    spec.visual.headlight.ambient = (0.45, 0.45, 0.46)
    spec.visual.headlight.diffuse = (0.30, 0.30, 0.30)
    spec.visual.headlight.specular = (0.1, 0.1, 0.1)
    has_own = world.lights or (world.model and spec.lights)
    for light in world.lights if has_own else (SUN,):
        lamp = light.position is not None
        kind = mujoco.mjtLightType
        spec.worldbody.add_light(
            type=kind.mjLIGHT_SPOT if lamp else kind.mjLIGHT_DIRECTIONAL,
            pos=light.position or (0, 0, 5),
            dir=light.direction,
            cutoff=80,
            diffuse=light.colour,
            specular=(0.25, 0.25, 0.25),
            castshadow=not lamp,
        )


class Person:
    """Walks a closed path, and stands still where a step would be too close to the robot."""

    def __init__(self, walk: WalkingPath) -> None:
        self._path, self._step_m = ClosedPath(walk.corners), walk.speed * STEP_S
        self.go_to(walk.start)
        self.stood = 0  # number of stops for the robot
        self._since_m = NEW_MEETING_M

    def go_to(self, walked: float) -> None:
        """Set the position along the path [m]."""
        self.walked, self.pose = walked, self._path.at(walked)

    def advance(self, robot_distance: Callable[[float, float], float]) -> Pose:
        """Walk for one step; `robot_distance(x, y)` returns a point's distance to the robot [m]."""
        walked = (self.walked + self._step_m) % self._path.length
        ahead = self._path.at(walked)
        gap = robot_distance(ahead.x, ahead.y)
        if gap >= PERSON_GAP_M + PERSON_RADIUS_M or gap > robot_distance(self.pose.x, self.pose.y):
            self.walked, self.pose = walked, ahead
            self._since_m += self._step_m
        else:
            self.stood += self._since_m >= NEW_MEETING_M
            self._since_m = 0.0
        return self.pose


def compile_scene(body: SimModel, world: World) -> mujoco.MjModel:
    """Return the model of `body` at the start of `world`. Raises ConfigError."""
    mujoco.set_mju_user_warning(log.warning)  # not to MuJoCo's log file
    spec = world_spec(world)
    spec.option.timestep = STEP_S / body.substeps
    if body.joints:  # so that fingers do not lose their grip
        spec.option.cone, spec.option.impratio = mujoco.mjtCone.mjCONE_ELLIPTIC, 10.0
        spec.option.noslip_iterations = 10
    start = world.start
    try:
        robot = _robot_spec(body)
        for name in WORLD_SETTINGS:  # ignore the robot's
            setattr(robot, name, getattr(spec, name))
        frame = spec.worldbody.add_frame(pos=(start.x, start.y, 0), quat=yaw_quaternion(start))
        spec.attach(robot, prefix=ROBOT, frame=frame)
        return spec.compile()
    except ValueError as error:
        problem = " ".join(str(error).split())[:300]
        raise ConfigError(
            f"{body.path}: this MJCF model cannot be used: {problem}", value=body.named_by
        ) from error


def yaw_quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """Return the heading as a quaternion (w, x, y, z)."""
    return math.cos(pose.yaw / 2), 0.0, 0.0, math.sin(pose.yaw / 2)


def _robot_spec(body: SimModel) -> mujoco.MjSpec:
    """Return the robot's model; scaled wheels are moved down, so the base stays level."""
    on_disk = Path(body.path).is_file()  # then meshes and includes are found beside it
    spec = mujoco.MjSpec.from_file(body.path) if on_disk else mujoco.MjSpec.from_string(body.model)
    PartFinder(spec, body).fit()
    align(spec, body)
    for text in mismatches(spec, body):
        log.warning("%s: %s", body.path, text, extra={"data": {"event": "mismatch"}})
    if not isinstance(body, SimBody):
        return spec
    for name in body.rolling:
        wheel = spec.body(name)
        radius = spec.geom(name).size[0]
        wheel.pos[2] -= radius * (1 - body.wheel_scale)
        for geom in wheel.geoms:
            geom.size = geom.size * body.wheel_scale
    return spec


def world_spec(world: World) -> mujoco.MjSpec:
    """Return the world without a robot, not compiled. Raises ConfigError."""
    spec = mujoco.MjSpec()
    spec.modelname = world.name
    _set_options(spec)
    add_materials(spec, world)
    if not (world.model and _attach_model(spec, world.model)):
        plane = mujoco.mjtGeom.mjGEOM_PLANE
        spec.worldbody.add_geom(name=FLOOR, type=plane, size=(0, 0, 0.05), material=FLOOR)
    add_lights(spec, world)
    for shape in world.everything():
        _add_shape(spec, shape)
    for number in range(len(world.people)):
        _add_person(spec, f"{PERSON}{number + 1 if number else ''}")
    _add_spares(spec, world)
    return spec


def _attach_model(spec: mujoco.MjSpec, path: Path) -> bool:
    """Attach the world's own model; return whether it has a floor. Raises ConfigError."""
    child = load_model(path)
    for key in list(child.keys):
        child.delete(key)
    for geom in child.geoms:
        if geom.group == ROBOT_GROUP and (geom.contype or geom.conaffinity):
            geom.group = WORLD_GROUP
    child.option, floor = mujoco.MjSpec().option, has_floor(child)
    try:
        spec.attach(child, prefix=MODEL, frame=spec.worldbody.add_frame())
    except ValueError as error:
        raise model_error(path, error) from None
    return floor


def _add_spares(spec: mujoco.MjSpec, world: World) -> None:
    """Add invisible bodies without contacts, for things that people add later."""
    middle = (*world.middle, 0.0)
    for number in range(SPARE_THINGS):
        name = f"{SPARE}thing{number}"
        body = spec.worldbody.add_body(name=name, mocap=True, pos=middle)
        body.add_geom(
            name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=(UNUSED_M, UNUSED_M, UNUSED_M),
            rgba=(0, 0, 0, 0), contype=0, conaffinity=0,
        )  # fmt: skip
    for number in range(SPARE_PEOPLE):
        _add_person(spec, f"{SPARE}person{number}", middle)


def _set_options(spec: mujoco.MjSpec) -> None:
    """Set the solver's options; those in robots' models are ignored."""
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    # Otherwise a diverging simulation silently returns to its start.
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
    elif isinstance(shape, Ball):
        geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
        geom.size = (shape.radius, 0, 0)
    else:
        geom.type = mujoco.mjtGeom.mjGEOM_CYLINDER
        geom.size = (shape.radius, half, 0)


FIGURE = ("blue", "skin", "dark_wood")  # colours of a person's parts


def _add_person(
    spec: mujoco.MjSpec, name: str, spare_at: tuple[float, float, float] | None = None
) -> None:
    """Add a figure as wide at the floor as at the hips, so that a low lidar sees its width.

    At `spare_at` it is a spare: invisible and without contacts until it is used.
    """
    person = spec.worldbody.add_body(name=name, mocap=True, pos=spare_at or (0, 0, 0))
    look: Any = {"rgba": (0, 0, 0, 0), "contype": 0, "conaffinity": 0}
    looks = [look] * len(FIGURE)
    if spare_at is None:
        body, *others = ({"material": material} for material in FIGURE)
        looks = [body, *({**other, "contype": 0, "conaffinity": 0} for other in others)]
    person.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=(PERSON_RADIUS_M, 0, 0),
        fromto=(0, 0, 0, 0, 0, PERSON_HEIGHT_M - PERSON_RADIUS_M),
        **looks[0],
    )
    person.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(0.14, 0, 0),
        pos=(0, 0, PERSON_HEIGHT_M + 0.1),
        **looks[1],
    )
    person.add_geom(
        type=mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        size=(0.16, 0.15, 0.1),
        pos=(-0.02, 0, PERSON_HEIGHT_M + 0.18),
        **looks[2],
    )
