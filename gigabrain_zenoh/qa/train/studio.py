"""A MuJoCo model with things of all classes, which are painted and placed for each picture.

A model and its renderer take 0.5 s, a picture about 20 ms. So one studio is used for many pictures.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib.resources import files

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_zenoh.qa.train import textures
from gigabrain_zenoh.qa.train.distractors import draw_all
from gigabrain_zenoh.qa.train.drawing import Drawing
from gigabrain_zenoh.qa.train.looks import MAKERS, Geom, Look, Random
from gigabrain_zenoh.vision.recognizer import HEIGHT_PX, WIDTH_PX

VARIANTS = 2  # looks of each class in one studio
CUBE_TEXTURES, FLAT_TEXTURES = 14, 8
CUBE_PX, FLAT_PX = 48, 192
# range of a texture's contrast, and chance of bright colours
OF_ROOMS, OF_THINGS = ((0.1, 0.4), 0.15), ((0.2, 0.6), 0.5)
SHOWN, HIDDEN = 0, 5  # groups of geoms
SMOOTH_EDGES = 0.3  # share of studios with multisampling, which takes three times as long
TRAINED_BODIES = ("turtlebot3_burger", "turtlebot3_waffle", "skid_rover", "ackermann_car")
OTHER_BODIES = ("omni_disc", "mecanum_cart")  # only for tests with other proportions
RGB = int(mujoco.mjtTextureRole.mjTEXROLE_RGB)
GEOMS = {
    kind: getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
    for kind in ("box", "cylinder", "sphere", "capsule", "ellipsoid")
}


@dataclass
class Thing:
    """A thing of the studio: its look, the mocap number of its body, and its geoms."""

    look: Look
    mocap: int
    geoms: NDArray[np.intp]
    labelled: NDArray[np.intp]
    paints: dict[str, int] = field(default_factory=dict)  # number of the material by paint


class Studio:
    """A model, its data and its renderer. Close it after use.

    `wide` draws proportions beyond those of training; `families` are the textures.
    """

    def __init__(self, rng: Random, families: tuple[textures.Family, ...], wide: int) -> None:
        looks = [
            m[rng.integers(len(m))](rng, wide) for m in MAKERS.values() for _ in range(VARIANTS)
        ]
        looks += draw_all(rng)
        bodies = OTHER_BODIES if wide else rng.choice(TRAINED_BODIES, 2, replace=False)
        self.model = _compile(looks, bodies)
        self.model.vis.quality.offsamples = 4 if rng.random() < SMOOTH_EDGES else 0
        self.data = mujoco.MjData(self.model)
        for texture in range(self.model.ntex):
            self._fill(texture, rng, families)
        self.cube_textures = list(range(CUBE_TEXTURES))
        self.flat_textures = list(range(CUBE_TEXTURES, CUBE_TEXTURES + FLAT_TEXTURES))
        self.things = [self._thing(n, look) for n, look in enumerate(looks)]
        self.things += [self._shipped(len(looks) + n) for n in range(len(bodies))]
        self.owner = np.full(
            self.model.ngeom + 1, -1
        )  # thing of each labelled geom; -1, the last, for none
        for n, thing in enumerate(self.things):
            if thing.look.label:
                self.owner[thing.labelled] = n
        self._options = mujoco.MjvOption()
        self._options.geomgroup[:] = self._options.sitegroup[:] = 0
        self._options.geomgroup[SHOWN] = 1
        self._drawing = Drawing(self.model, 0, WIDTH_PX, HEIGHT_PX)

    def close(self) -> None:
        """Free OpenGL's memory."""
        self._drawing.close()

    def _fill(self, texture: int, rng: Random, families: tuple[textures.Family, ...]) -> None:
        model = self.model
        start, n = model.tex_adr[texture], model.tex_width[texture]
        faces = model.tex_height[texture] // n
        (low, high), vivid = OF_ROOMS if faces == 1 else OF_THINGS
        one = textures.draw(rng, families, n, rng.uniform(low, high), vivid)
        data = np.concatenate([np.rot90(one, k % 4) for k in range(faces)])
        model.tex_data[start : start + data.size] = data.ravel()

    def _thing(self, number: int, look: Look) -> Thing:
        body = self.model.body(f"thing{number}")
        geoms = np.arange(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
        labelled = geoms[[part.labelled for part in look.parts]]
        paints = {
            part.paint: self.model.material(f"{number}/{part.paint}").id
            for part in look.parts
            if part.fixed is None
        }
        return Thing(look, int(body.mocapid[0]), geoms, labelled, paints)

    def _shipped(self, number: int) -> Thing:
        body = self.model.body(f"thing{number}")
        geoms = np.flatnonzero(self.model.body_rootid[self.model.geom_bodyid] == body.id)
        seen = geoms[self.model.geom_rgba[geoms, 3] > 0]
        look = Look("robot", (), 0.22, 0.2)
        return Thing(look, int(body.mocapid[0]), seen, seen)

    def show(self, things: Iterable[Thing], *, room: bool = True, labelled: bool = False) -> None:
        """Show only these things, or their labelled parts, with or without floor and walls."""
        self.model.geom_group[:] = HIDDEN
        if room:
            self.model.geom_group[self.model.geom_bodyid == 0] = SHOWN
        for thing in things:
            self.model.geom_group[thing.labelled if labelled else thing.geoms] = SHOWN

    def picture(self) -> NDArray[np.uint8]:
        """Render a picture (h, w, 3), RGB."""
        return self._drawing.colours(self.data, self._options)

    def owners(self) -> NDArray[np.int64]:
        """Return the number of the visible thing for each pixel (h, w); -1 for none."""
        return np.asarray(self.owner[self._drawing.geoms(self.data, self._options)])


def _compile(looks: list[Look], bodies: Iterable[str]) -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = WIDTH_PX, HEIGHT_PX
    spec.visual.quality.shadowsize = 1024
    spec.visual.map.znear, spec.visual.map.zfar = 0.01, 30.0
    spec.stat.extent, spec.stat.center = 1.0, (2.0, 0, 0.5)
    for n in range(CUBE_TEXTURES):
        _texture(spec, f"cube{n}", mujoco.mjtTexture.mjTEXTURE_CUBE, CUBE_PX, 6 * CUBE_PX)
    for n in range(FLAT_TEXTURES):
        _texture(spec, f"flat{n}", mujoco.mjtTexture.mjTEXTURE_2D, FLAT_PX, FLAT_PX)
    _texture(spec, "sky", mujoco.mjtTexture.mjTEXTURE_SKYBOX, CUBE_PX, 6 * CUBE_PX)
    _room(spec)
    for number, look in enumerate(looks):
        _add(spec, number, look)
    for number, name in enumerate(bodies, len(looks)):
        _add_shipped(spec, number, str(name))
    return spec.compile()


def _texture(spec: mujoco.MjSpec, name: str, kind: int, width: int, height: int) -> None:
    flat = mujoco.mjtBuiltin.mjBUILTIN_FLAT
    spec.add_texture(name=name, type=kind, builtin=flat, width=width, height=height)


def _material(spec: mujoco.MjSpec, name: str, texture: str = "") -> None:
    material = spec.add_material(name=name, texuniform=bool(texture))
    names = [""] * int(mujoco.mjtTextureRole.mjNTEXROLE)
    names[RGB] = texture
    material.textures = names


def _room(spec: mujoco.MjSpec) -> None:
    """Add floor, three walls, lights and the camera; their poses are drawn for each picture."""
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    for name in ("floor", "front", "left", "right"):
        _material(spec, name, "flat0")
        pose = {} if name == "floor" else {"pos": (1, 1, 1), "quat": (0.6, 0.8, 0, 0)}  # any but 0
        spec.worldbody.add_geom(name=name, type=plane, size=(12, 12, 0.1), material=name, **pose)
    for n in range(3):
        spec.worldbody.add_light(name=f"light{n}", pos=(0, 0, 3))
    spec.worldbody.add_camera(name="camera")


def _add(spec: mujoco.MjSpec, number: int, look: Look) -> None:
    body = spec.worldbody.add_body(name=f"thing{number}", mocap=True)
    painted = set()
    for n, part in enumerate(look.parts):
        if part.fixed is None and part.paint not in painted:
            painted.add(part.paint)
            _material(spec, f"{number}/{part.paint}", "cube0")
        _add_geom(spec, body, f"{number}/{n}", part, f"{number}/{part.paint}")


def _add_geom(spec: mujoco.MjSpec, body: mujoco.MjsBody, name: str, part: Geom, paint: str) -> None:
    looks: dict[str, object] = {"material": paint}
    if part.fixed is not None:
        material = spec.add_material(name=name, rgba=(*part.fixed, 1.0))
        material.specular = material.shininess = part.shine
        looks = {"material": name}
    if part.kind == "hull":
        spec.add_mesh(name=name, uservert=list(part.size))
        looks |= {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
    else:
        looks |= {"type": GEOMS[part.kind], "size": [*part.size, 0.0, 0.0][:3]}
    body.add_geom(name=name, pos=part.at, quat=part.turn, contype=0, conaffinity=0, **looks)


def _add_shipped(spec: mujoco.MjSpec, number: int, name: str) -> None:
    """Add a body of the drivers' package without its joints."""
    path = files("gigabrain_drivers.bodies").joinpath(name, "model.xml")
    child = mujoco.MjSpec.from_string(path.read_text("utf-8"))
    parts: Callable[[str], list[mujoco.MjsElement]] = lambda kind: list(getattr(child, kind))  # noqa: E731
    for kind in ("actuators", "sensors", "equalities", "tendons", "excludes", "joints"):
        for element in parts(kind):
            child.delete(element)
    body = spec.worldbody.add_body(name=f"thing{number}", mocap=True)
    spec.attach(child, prefix=f"thing{number}/", frame=body.add_frame())
