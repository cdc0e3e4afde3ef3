"""Messages for viewers: a compiled scene, and the poses of its bodies."""

from collections.abc import Collection, Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.scene import ROBOT, SPARE
from gigabrain_schemas.sim import (
    MAX_MESH_BYTES,
    MAX_MESHES,
    SHAPE_KINDS,
    SceneMesh,
    SimPoses,
    SimScene,
    Thing,
)

TYPES = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_MESH: "mesh",
}
BASE = f"{ROBOT}base"
SHOWN_GROUPS = 3  # MuJoCo's viewers draw geom groups 0 to 2


class _Rows(NamedTuple):
    """Shapes, one in each row of the arrays."""

    kinds: NDArray[np.uint8]
    bodies: NDArray[np.int64]  # ids in MuJoCo
    sizes: NDArray[np.float32]
    places: NDArray[np.float32]
    colours: NDArray[np.uint8]


class SceneWriter:
    """Writes scenes and poses. Shapes of other types, such as height fields, are left out."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, world: str) -> None:
        self._model, self._data, self._world = model, data, world
        moving = (model.body_weldid != 0) | (model.body_mocapid >= 0)
        for body in range(1, model.nbody):  # bodies fixed to a mocap body move with it
            moving[body] |= moving[model.body_parentid[body]]
            # viewers draw an arm's plan on its base, even if that is fixed
            moving[body] |= model.body(body).name == BASE
        spare = [model.body(body).name.startswith(SPARE) for body in range(model.nbody)]
        self._moving, self._spare = moving, np.array(spare)
        self._bodies = self._moving_bodies(())
        self._meshes: list[SceneMesh] = []
        self._mesh_numbers: dict[int, int] = {}
        self._mesh_bytes = 0
        self._means: dict[int, NDArray[np.float64]] = {}  # mean colours of textures
        owner_is_spare = self._spare[model.geom_bodyid]
        self._lasting = self._rows(np.flatnonzero(~owner_is_spare).tolist())

    def scene(self, version: int, things: tuple[Thing, ...], used: Mapping[int, str]) -> SimScene:
        """Return the scene with the spare bodies `used`; `poses` then includes them.

        A used body has the name of its thing. Only the shapes of things are read again.
        """
        model = self._model
        self._bodies = self._moving_bodies(used)
        bodies = self._bodies.tolist()
        numbers = np.zeros(model.nbody, np.uint16)
        numbers[self._bodies] = np.arange(1, len(self._bodies) + 1)
        mine = np.isin(model.geom_bodyid, list(used))
        rows = _Rows(*map(np.concatenate, zip(  # type: ignore[arg-type]
            self._lasting, self._rows(np.flatnonzero(mine).tolist()), strict=True,
        )))  # fmt: skip
        return SimScene(
            version=version,
            world=self._world[-256:],
            bodies=("world", *(used.get(body) or self._name(body) for body in bodies)),
            kinds=rows.kinds.tobytes(),
            owners=numbers[rows.bodies].astype("<u2").tobytes(),
            sizes=rows.sizes.tobytes(),
            places=rows.places.tobytes(),
            colours=rows.colours.tobytes(),
            meshes=tuple(self._meshes),
            things=things,
        )

    def poses(self, version: int) -> SimPoses:
        """Return the poses of the last scene's moving bodies."""
        data, bodies = self._data, self._bodies
        poses = np.hstack((data.xpos[bodies], data.xquat[bodies])).astype("<f4")
        return SimPoses(version=version, poses=poses.tobytes())

    def _moving_bodies(self, used: Collection[int]) -> NDArray[np.int64]:
        return np.array([
            body for body in np.flatnonzero(self._moving)
            if body in used or not self._spare[body]
        ], np.int64)  # fmt: skip

    def _name(self, body: int) -> str:
        return str(self._model.body(body).name[:128]) or f"body {body}"

    def _rows(self, geoms: list[int]) -> "_Rows":
        """Return the visible shapes among `geoms`."""
        found = [(geom, *shape) for geom in geoms if (shape := self._shape(geom))]
        drawn = [geom for geom, _, _ in found]
        return _Rows(
            kinds=np.array([kind for _, kind, _ in found], np.uint8),
            bodies=np.array(self._model.geom_bodyid[drawn], np.int64),
            sizes=np.array([size for _, _, size in found], "<f4").reshape(-1, 3),
            places=np.array([self._place(geom) for geom in drawn], "<f4").reshape(-1, 7),
            colours=np.array([self._colour(geom) for geom in drawn], np.uint8).reshape(-1, 4),
        )

    def _shape(self, geom: int) -> tuple[int, list[float]] | None:
        """Return kind and sizes; None for a shape that is not drawn."""
        model = self._model
        kind = TYPES.get(mujoco.mjtGeom(int(model.geom_type[geom])))
        if kind is None or model.geom_group[geom] >= SHOWN_GROUPS or self._colour(geom)[3] == 0:
            return None
        sizes = model.geom_size[geom].tolist()
        if kind == "mesh":
            number = self._mesh(int(model.geom_dataid[geom]))
            if number is None:
                kind, sizes = "box", model.geom_aabb[geom, 3:].tolist()
            else:
                sizes = [float(number), 0.0, 0.0]
        return SHAPE_KINDS.index(kind), sizes

    def _mesh(self, mesh: int) -> int | None:
        """Return a mesh's number in the scene; None beyond the limits of count or size."""
        model = self._model
        if mesh not in self._mesh_numbers:
            vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
            vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
            faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
            size = 4 * (vertices.size + faces.size)
            if self._mesh_bytes + size > MAX_MESH_BYTES or len(self._meshes) == MAX_MESHES:
                return None
            self._mesh_bytes += size
            self._mesh_numbers[mesh] = len(self._meshes)
            self._meshes.append(SceneMesh(
                vertices=vertices.astype("<f4").tobytes(), faces=faces.astype("<u4").tobytes(),
            ))  # fmt: skip
        return self._mesh_numbers[mesh]

    def _place(self, geom: int) -> NDArray[np.float64]:
        """Return the pose of a geom relative to its body, or to the world if that is fixed."""
        model, data = self._model, self._data
        if self._moving[model.geom_bodyid[geom]]:
            return np.concatenate((model.geom_pos[geom], model.geom_quat[geom]))
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.geom_xmat[geom])
        return np.concatenate((data.geom_xpos[geom], quaternion))

    def _colour(self, geom: int) -> NDArray[np.uint8]:
        model, material = self._model, int(self._model.geom_matid[geom])
        colour = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
        texture = -1 if material < 0 else int(model.mat_texid[material].max())
        if texture >= 0:  # viewers draw no textures
            colour = np.append(colour[:3] * self._mean(texture), colour[3])
        return np.asarray(np.clip(colour * 255, 0, 255).round(), np.uint8)

    def _mean(self, texture: int) -> NDArray[np.float64]:
        """Return the mean colour of a texture, 0 to 1."""
        if texture in self._means:
            return self._means[texture]
        model = self._model
        channels = int(model.tex_nchannel[texture])
        size = int(model.tex_height[texture]) * int(model.tex_width[texture]) * channels
        start = int(model.tex_adr[texture])
        mean = model.tex_data[start : start + size].reshape(-1, channels).mean(axis=0) / 255
        self._means[texture] = np.resize(mean[:3], 3)
        return self._means[texture]
