"""Random worlds for `gigabrain bench eyes`, with their outlines, rendered by MuJoCo."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import Pose
from gigabrain_schemas.body import BodyDescription, Camera
from gigabrain_zenoh.geometry.polygon import distance
from gigabrain_zenoh.vision.camera_model import rotation

NEAR_M, FAR_M = 0.02, 50.0  # clipping planes of the renderer
CIRCLE = 24  # corners of the polygon that approximates a circle
CLEAR_M = 0.5  # free of things, round the place where the robot drives
FLOOR_M = 20.0  # half its size
Texture = Literal["plain", "checker", "stripes", "specks", "tiles"]
TEXTURES: tuple[Texture, ...] = ("plain", "checker", "stripes", "specks", "tiles")
LIGHTS = {  # direction of the sun, its brightness, and that of the ambient light
    "noon": ((0.1, 0.1, -1.0), 0.6, 0.4),
    "evening": ((1.0, 0.3, -0.35), 0.8, 0.2),
    "dim": ((0.2, -0.4, -1.0), 0.15, 0.1),
}


@dataclass(frozen=True)
class Part:
    """An upright box or cylinder of a thing."""

    thing: int
    x: float
    y: float
    half_x: float  # [m]; of a cylinder its radius
    half_y: float
    top: float
    bottom: float = 0.0
    yaw: float = 0.0
    round: bool = False

    @property
    def outline(self) -> Floats:
        """Its corners (n, 2) [m], counter-clockwise."""
        if self.round:
            angle = np.arange(CIRCLE) * (2 * math.pi / CIRCLE)
            return np.column_stack((np.cos(angle), np.sin(angle))) * self.half_x + (self.x, self.y)
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (self.half_x, self.half_y)
        return np.asarray(corners @ np.array([[cos, sin], [-sin, cos]]) + (self.x, self.y))


class Pit(NamedTuple):
    """A step down, with sides along x and y [m]."""

    x: float
    y: float
    half_x: float
    half_y: float
    depth: float

    @property
    def outline(self) -> Floats:
        """Its corners (4, 2) [m], counter-clockwise."""
        return Part(0, self.x, self.y, self.half_x, self.half_y, 0.0).outline


class EyesWorld(NamedTuple):
    """A floor with things on it, and with at most one pit."""

    parts: tuple[Part, ...] = ()
    pit: Pit | None = None
    texture: Texture = "plain"
    light: str = "noon"
    backdrop: Part | None = None  # a wall that stays when the things move

    def solids(self, body_height: float) -> list[Floats]:
        """Return the outlines of all parts that reach down below the body's top."""
        return [one.outline for one in self.parts if one.bottom < body_height]


def bodies() -> tuple[BodyDescription, BodyDescription]:
    """Return the two bodies to measure: the first camera of one is low, the other's looks down."""
    waffle = load_robot("turtlebot3_waffle").description()
    mast = replace(waffle.cameras[0], name="mast", x=0.05, z=0.5, pitch=0.4)
    return waffle, replace(waffle, robot_type="mast", body_height=0.55, cameras=(mast,))


def distances(outlines: Sequence[Floats], points: Floats) -> Floats:
    """Return the distance of each point (n, 2) to the nearest outline [m]; 0 inside."""
    if not outlines or not len(points):
        return np.full(len(points), np.inf)
    return np.asarray(np.min([distance(one, points) for one in outlines], axis=0))


def draw_world(seed: int) -> EyesWorld:
    """Return a world with boxes, cylinders, tables, sills and walls; every other one has a pit."""
    random = np.random.default_rng(np.random.SeedSequence((seed, 18)))
    parts: list[Part] = []
    pit = None
    if random.random() < 0.5:
        depth, x = random.uniform(0.04, 0.4), random.uniform(1.1, 1.6)
        pit = Pit(x + 0.3, random.uniform(-0.6, 0.6), 0.3, random.uniform(0.2, 0.6), depth)
    for _ in range(random.integers(4, 10)):
        for _ in range(30):
            new = list(_thing(random, len(parts)))
            if _is_clear(new, parts, pit):
                parts += new
                break
    texture = TEXTURES[int(random.integers(len(TEXTURES)))]
    return EyesWorld(tuple(parts), pit, texture, list(LIGHTS)[int(random.integers(len(LIGHTS)))])


def _is_clear(new: list[Part], parts: list[Part], pit: Pit | None) -> bool:
    corners = np.concatenate([one.outline for one in new])
    dense = np.concatenate([corners, (corners + np.roll(corners, 1, axis=0)) / 2])
    others = [one.outline for one in parts] + ([pit.outline] if pit else [])
    driven_area = np.array([[-0.3, -0.3], [0.3, -0.3], [0.3, 0.3], [-0.3, 0.3]])
    if distances([driven_area], dense).min() < CLEAR_M - 0.3:
        return False
    other_corners = np.concatenate(others) if others else np.empty((0, 2))
    outlines = [one.outline for one in new]
    to_new = distances(outlines, other_corners).min() if len(other_corners) else np.inf
    return min(float(distances(others, dense).min()), float(to_new)) > 0.08


def _thing(random: np.random.Generator, thing: int) -> Iterator[Part]:
    """Draw the parts of one thing; `thing` is its number."""
    away, angle = random.uniform(0.6, 3.2), random.uniform(-0.5, 0.5)
    x, y, yaw = away * math.cos(angle), away * math.sin(angle), random.uniform(-math.pi, math.pi)
    kind = random.choice(("box", "low", "cylinder", "table", "shelf", "sill", "wall", "least"))
    if kind == "table":
        half, legs, top = random.uniform(0.2, 0.4), random.uniform(0.015, 0.025), 0.72
        cos, sin = math.cos(yaw), math.sin(yaw)
        for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1)):
            dx, dy = a * (half - legs), b * (half - legs)
            leg_x, leg_y = x + cos * dx - sin * dy, y + sin * dx + cos * dy
            yield Part(thing, leg_x, leg_y, legs, legs, top, yaw=yaw)
        yield Part(thing, x, y, half, half, top + 0.03, top, yaw)
    elif kind == "shelf":  # hangs lower than the body's top
        bottom, half = random.uniform(0.06, 0.12), random.uniform(0.1, 0.3)
        yield Part(thing, x, y, half, random.uniform(0.1, 0.3), bottom + 0.05, bottom, yaw)
    elif kind == "cylinder":
        radius = random.uniform(0.015, 0.15)
        yield Part(thing, x, y, radius, radius, random.uniform(0.03, 1.0), round=True)
    else:
        half_x, half_y, top = {
            "box": (
                random.uniform(0.02, 0.25),
                random.uniform(0.02, 0.25),
                random.uniform(0.05, 1),
            ),
            "low": (
                random.uniform(0.05, 0.25),
                random.uniform(0.05, 0.25),
                random.uniform(0.03, 0.06),
            ),
            "sill": (0.03, random.uniform(0.3, 0.6), random.uniform(0.03, 0.05)),
            "wall": (0.05, random.uniform(0.4, 1.0), 1.0),
            "least": (0.015, 0.015, 0.03),
        }[str(kind)]
        yield Part(thing, x, y, half_x, half_y, top, yaw=yaw)


class Renderer:
    """Renders a world from a camera's pose. Use it in `with`: it holds graphics memory."""

    def __init__(self, world: EyesWorld, camera: Camera) -> None:
        """Open the graphics. Raises ConfigError if rendering is impossible."""
        self._camera = camera
        self.model = _spec(world, camera).compile()
        visual = self.model.vis.global_
        visual.offwidth, visual.offheight = camera.width, camera.height
        self.data = mujoco.MjData(self.model)
        self._floors = self.model.ngeom - len(world.parts)
        self._graphics = open_graphics(camera.width, camera.height)
        self._scene = mujoco.MjvScene(self.model, maxgeom=self.model.ngeom + 10)
        self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_: object) -> None:
        self._context.free()
        self._graphics.free()

    def move(self, pose: Pose, mounted: Camera, thing: tuple[float, float] = (0.0, 0.0)) -> None:
        """Place the robot and shift all things; `mounted` is the camera's true mounting."""
        turn = rotation(0.0, 0.0, pose.yaw)
        place = turn @ (mounted.x, mounted.y, mounted.z) + (pose.x, pose.y, 0.0)
        matrix = turn @ rotation(mounted.roll, mounted.pitch, mounted.yaw)
        self.data.mocap_pos[0] = place
        mujoco.mju_mat2Quat(self.data.mocap_quat[0], matrix.reshape(-1))
        self.data.mocap_pos[1, :2] = thing
        mujoco.mj_forward(self.model, self.data)
        eye = mujoco.MjvCamera()
        eye.type, eye.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self.model, self.data, mujoco.MjvOption(), None, eye, everything, self._scene
        )

    def depth(self) -> NDArray[np.float32]:
        """Return the depth of each pixel [m]."""
        return self._draw(shadows=False)[1]

    def colour(self) -> NDArray[np.uint8]:
        """Return a picture (height, width, 3)."""
        return self._draw(shadows=True)[0]

    def parts(self) -> NDArray[np.int32]:
        """Return the number of the visible part for each pixel; -1 for none."""
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = 1
        colours = self._draw(shadows=False)[0].astype(np.int32)
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = 0
        drawn = colours[..., 0] + colours[..., 1] * 256 + colours[..., 2] * 65536 - 1
        geoms = np.full(self._scene.ngeom + 1, -1, np.int32)  # the last one: background
        for one in self._scene.geoms[: self._scene.ngeom]:
            if one.segid >= 0 and one.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geoms[one.segid] = one.objid
        return np.asarray(np.maximum(geoms[drawn] - self._floors, -1), np.int32)

    def _draw(self, *, shadows: bool) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colours (height, width, 3) and depth (height, width) [m]."""
        width, height = self._camera.width, self._camera.height
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        colours, raw = np.empty((height, width, 3), np.uint8), np.empty((height, width), np.float32)
        viewport = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(colours, raw, viewport, self._context)
        # OpenGL's first row is the lowest; the depth is 1 at the near plane, 0 at the far plane
        depth = NEAR_M * FAR_M / (NEAR_M + (FAR_M - NEAR_M) * raw[::-1])
        return np.ascontiguousarray(colours[::-1]), depth.astype(np.float32)


def _spec(world: EyesWorld, camera: Camera) -> mujoco.MjSpec:
    spec = mujoco.MjSpec()
    spec.stat.extent, spec.visual.map.znear, spec.visual.map.zfar = 1.0, NEAR_M, FAR_M
    spec.visual.quality.offsamples = 0
    direction, sun, rest = LIGHTS[world.light]
    spec.visual.headlight.ambient = spec.visual.headlight.diffuse = (rest / 2,) * 3
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, dir=direction, diffuse=(sun,) * 3,
        pos=tuple(-4.0 * one for one in direction), castshadow=True,
    )  # fmt: skip
    _add_floor(spec, world)
    eye = spec.worldbody.add_body(name="eye", mocap=True)
    fy = camera.pinhole[1]
    eye.add_camera(
        name="eye",
        fovy=math.degrees(2 * math.atan(camera.height / 2 / fy)),
        quat=(0.5, 0.5, -0.5, -0.5),  # MuJoCo looks along -z
    )
    if world.backdrop:
        _add_part(spec.worldbody, world.backdrop)
    things = spec.worldbody.add_body(name="things", mocap=True)
    for one in world.parts:
        _add_part(things, one)
    return spec


def _add_part(body: mujoco.MjsBody, one: Part) -> None:
    half = (one.top - one.bottom) / 2
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER if one.round else mujoco.mjtGeom.mjGEOM_BOX,
        size=(one.half_x, half, 0) if one.round else (one.half_x, one.half_y, half),
        pos=(one.x, one.y, one.bottom + half),
        quat=(math.cos(one.yaw / 2), 0, 0, math.sin(one.yaw / 2)),
        rgba=(0.3 + 0.25 * (one.thing % 3), 0.35, 0.7 - 0.4 * (one.thing % 2), 1),
    )


def _add_floor(spec: mujoco.MjSpec, world: EyesWorld) -> None:
    """Add the floor: a plane, or slabs round a pit and one at its bottom."""
    builtin, mark = mujoco.mjtBuiltin, mujoco.mjtMark
    kind, spots = {
        "plain": (builtin.mjBUILTIN_FLAT, mark.mjMARK_NONE),
        "checker": (builtin.mjBUILTIN_CHECKER, mark.mjMARK_NONE),
        "stripes": (builtin.mjBUILTIN_GRADIENT, mark.mjMARK_NONE),
        "specks": (builtin.mjBUILTIN_FLAT, mark.mjMARK_RANDOM),
        "tiles": (builtin.mjBUILTIN_FLAT, mark.mjMARK_EDGE),
    }[world.texture]
    spec.add_texture(
        name="floor", type=mujoco.mjtTexture.mjTEXTURE_2D, builtin=kind, mark=spots, random=0.05,
        rgb1=(0.5, 0.45, 0.4), rgb2=(0.3, 0.3, 0.35), markrgb=(0.2, 0.2, 0.2),
        width=128, height=128,
    )  # fmt: skip
    material = spec.add_material(name="floor", texrepeat=(2, 2), texuniform=True)
    textures = list(material.textures)
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    material.textures = textures
    if world.pit is None:
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_PLANE, size=(FLOOR_M, FLOOR_M, 1), material="floor"
        )
        return
    pit, low = world.pit, -world.pit.depth
    left, right = pit.y + pit.half_y, pit.y - pit.half_y
    near, far = pit.x - pit.half_x, pit.x + pit.half_x
    for x, y, half_x, half_y, top in (
        ((near - FLOOR_M) / 2, 0.0, (near + FLOOR_M) / 2, FLOOR_M, 0.0),
        ((far + FLOOR_M) / 2, 0.0, (FLOOR_M - far) / 2, FLOOR_M, 0.0),
        (pit.x, (left + FLOOR_M) / 2, pit.half_x, (FLOOR_M - left) / 2, 0.0),
        (pit.x, (right - FLOOR_M) / 2, pit.half_x, (right + FLOOR_M) / 2, 0.0),
        (pit.x, pit.y, pit.half_x, pit.half_y, low),
    ):
        half_z = 0.5 + (top - low) / 2  # all reach the same depth, as sides of the pit
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=(half_x, half_y, half_z),
            pos=(x, y, top - half_z), material="floor",
        )  # fmt: skip
