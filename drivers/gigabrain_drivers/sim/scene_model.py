"""A MuJoCo model made from a received scene, for a window and for pictures."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.picture import save_picture
from gigabrain_drivers.sim.scene import SUN, add_lights, add_sky
from gigabrain_drivers.sim.world import World
from gigabrain_schemas.sim import SHAPE_KINDS, ShapeKind, SimPoses, SimScene
from gigabrain_zenoh.errors import ConfigError

GEOMS = {
    "plane": mujoco.mjtGeom.mjGEOM_PLANE,
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}
BASE = "robot/base"
DISTANCE_M, ELEVATION_DEG, AZIMUTH_DEG = 4.0, -38.0, 130.0  # of the camera, from the robot
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
Pose = NDArray[np.float64]  # (7,): x, y, z, and a quaternion w, x, y, z


class SceneShape(NamedTuple):
    """One shape of a scene."""

    kind: ShapeKind
    body: str
    size: tuple[float, ...]
    place: tuple[float, ...]  # pose on its body: x, y, z, and a quaternion w, x, y, z
    colour: tuple[float, ...]  # red, green, blue, alpha, 0 to 1


def shapes_of(scene: SimScene) -> list[SceneShape]:
    """Return the shapes of a scene. Raises ValueError for invalid indices or sizes."""
    owners = np.frombuffer(scene.owners, "<u2")
    sizes = np.frombuffer(scene.sizes, "<f4").reshape(-1, 3).astype(float)
    places = np.frombuffer(scene.places, "<f4").reshape(-1, 7).astype(float)
    colours = np.frombuffer(scene.colours, np.uint8).reshape(-1, 4) / 255
    if not (np.isfinite(sizes).all() and np.isfinite(places).all()):
        raise ValueError("a shape has a size or a place that is not finite")
    try:
        return [
            SceneShape(SHAPE_KINDS[kind], scene.bodies[owner], tuple(size), tuple(at), tuple(rgba))
            for kind, owner, size, at, rgba in zip(
                scene.kinds, owners.tolist(), sizes.tolist(), places.tolist(), colours.tolist(),
                strict=True,
            )
        ]  # fmt: skip
    except IndexError:
        raise ValueError("a shape of an unknown kind, or on an unknown body") from None


def _triangles(scene: SimScene) -> Iterator[tuple[list[float], list[int]]]:
    """Yield vertices and faces of each mesh. Raises ValueError for a missing vertex."""
    for number, mesh in enumerate(scene.meshes):
        vertices, faces = np.frombuffer(mesh.vertices, "<f4"), np.frombuffer(mesh.faces, "<u4")
        if (faces >= len(vertices) // 3).any():
            raise ValueError(f"mesh {number} has faces at vertices that it has not")
        yield vertices.tolist(), faces.tolist()


class SceneModel:
    """A model of a scene, for drawing only. Things added by people are drawn separately."""

    def __init__(self, scene: SimScene) -> None:
        """Make the model. Raises ConfigError for a scene that cannot be drawn."""
        self._take(scene)
        try:
            self.model = self._spec().compile()
        except ValueError as error:
            text = " ".join(str(error).split())
            raise ConfigError(f"the world {scene.world} cannot be shown: {text}") from None
        self.data = mujoco.MjData(self.model)
        self._poses: dict[str, Pose] = {}
        mujoco.mj_forward(self.model, self.data)

    def update(self, scene: SimScene) -> bool:
        """Use the things of a newer scene; return False if anything else changed."""
        before = self._fixed
        self._take(scene)
        return self._fixed == before

    def place(self, poses: SimPoses) -> bool:
        """Move the bodies; return False for poses of another scene, or not finite ones."""
        values = np.frombuffer(poses.poses, "<f4").reshape(-1, 7).astype(float)
        if poses.version != self.scene.version or len(values) != len(self.scene.bodies) - 1:
            return False
        if not np.isfinite(values).all():
            return False
        self._poses = dict(zip(self.scene.bodies[1:], values, strict=True))
        for name, pose in self._poses.items():
            if name not in self._things:
                mocap = self.model.body(name).mocapid[0]
                self.data.mocap_pos[mocap], self.data.mocap_quat[mocap] = pose[:3], pose[3:]
        mujoco.mj_forward(self.model, self.data)
        return True

    def add_things(self, drawn: mujoco.MjvScene) -> None:
        """Add the things that people added to a renderer's scene."""
        for shape in self._shapes:
            if shape.body not in self._things or drawn.ngeom >= drawn.maxgeom:
                continue
            body = self._poses.get(shape.body, IDENTITY)
            position, turn, matrix = np.empty(3), np.empty(4), np.empty(9)
            mujoco.mju_mulPose(
                position, turn, body[:3], body[3:], np.array(shape.place[:3]),
                np.array(shape.place[3:]),
            )  # fmt: skip
            mujoco.mju_quat2Mat(matrix, turn)
            mujoco.mjv_initGeom(
                drawn.geoms[drawn.ngeom], GEOMS[shape.kind].value,
                np.array(shape.size), position, matrix, np.array(shape.colour, np.float32),
            )  # fmt: skip
            drawn.ngeom += 1

    def pose_of(self, body: str) -> Pose:
        """Return the pose of a body, or the identity if unknown."""
        return self._poses.get(body, IDENTITY)

    def robot_place(self) -> tuple[float, float]:
        """Return x, y of the robot, or the origin if unknown."""
        pose = self.pose_of(BASE)
        return float(pose[0]), float(pose[1])

    def aim(self, camera: mujoco.MjvCamera) -> None:
        """Point a camera at the robot from above."""
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat = (*self.robot_place(), 0.2)
        camera.distance, camera.elevation, camera.azimuth = DISTANCE_M, ELEVATION_DEG, AZIMUTH_DEG

    def save(self, path: Path) -> None:
        """Write a PNG. Raises ConfigError where nothing can be drawn."""
        camera = mujoco.MjvCamera()
        self.aim(camera)
        save_picture(self.model, self.data, camera, path, self.add_things)

    def _take(self, scene: SimScene) -> None:
        self.scene = scene
        self._things = {thing.name for thing in scene.things}
        try:
            self._shapes = shapes_of(scene)
        except ValueError as error:
            raise ConfigError(f"the world {scene.world} cannot be shown: {error}") from None
        fixed = [shape for shape in self._shapes if shape.body not in self._things]
        bodies = [name for name in scene.bodies if name not in self._things]
        self._fixed = fixed, bodies, scene.meshes, scene.world, scene.boot

    def _spec(self) -> mujoco.MjSpec:
        spec = mujoco.MjSpec()
        spec.modelname = Path(self.scene.world).stem
        add_sky(spec)
        add_lights(spec, World(
            name="", description="", half_x=0, half_y=0, shapes=(), lights=(SUN,),
        ))  # fmt: skip
        for number, (vertices, faces) in enumerate(_triangles(self.scene)):
            spec.add_mesh(
                name=f"mesh{number}", uservert=vertices, userface=faces,
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )  # fmt: skip
        fixed, names, *_ = self._fixed
        bodies = {names[0]: spec.worldbody}
        bodies |= {name: spec.worldbody.add_body(name=name, mocap=True) for name in names[1:]}
        for shape in fixed:
            geom = bodies[shape.body].add_geom(
                type=GEOMS[shape.kind], pos=shape.place[:3], quat=shape.place[3:],
                rgba=shape.colour, contype=0, conaffinity=0,
            )  # fmt: skip
            if shape.kind == "mesh":
                geom.meshname = f"mesh{int(shape.size[0])}"
            else:
                geom.size = shape.size
        return spec
