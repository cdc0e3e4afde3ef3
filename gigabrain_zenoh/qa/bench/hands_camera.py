"""Camera of the arm in `gigabrain bench hands`, with the errors of a real one."""

from functools import partial

from msgspec.structs import replace

from gigabrain_drivers.cameras.rendered import Renderer, View
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.scene_message import SceneWriter
from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.objects import SeenSolid
from gigabrain_zenoh.geometry.pose import ORIGIN
from gigabrain_zenoh.manipulation.arm_mask import ArmMask
from gigabrain_zenoh.perception.solid_memory import SolidMemory
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.depth_picture import DepthCamera
from gigabrain_zenoh.vision.solids import find_solids, is_gone

PICTURES = 5  # per look


class ArmCamera:
    """The first camera of a simulated arm."""

    def __init__(self, body: BodyDescription, mjcf: str, simulation: Simulation, seed: int) -> None:
        """Open its own graphics. Raises ConfigError if rendering is impossible."""
        camera = body.cameras[0]
        self._name, self._mask = camera.name, ArmMask(mjcf, body)
        self._scene = SceneWriter(simulation.model, simulation.data, "table")
        self._renderer = Renderer({camera.name: View(camera, seed, errors=True)})
        self._renderer.show(self._scene.scene(1, (), {}))
        self._camera = DepthCamera(CameraModel(camera), body.body_height)
        self._memory, self._number = SolidMemory(), 0

    def look(self, state: RobotState) -> tuple[SeenSolid, ...]:
        """Return the solids that are seen in some pictures by a robot at rest."""
        joints = {one.name: one.position for one in state.joints}
        for _ in range(PICTURES):
            self._number += 1
            poses = replace(self._scene.poses(1), tick=self._number)
            pixels = self._renderer.expose(poses, [self._name])[self._name].depth
            view = None if pixels is None else self._camera.view(pixels)
            if view is None:
                continue
            own = self._mask.covers(view.obstacles.astype(float), joints)
            fits = find_solids(view, self._camera.model, own)
            gone = partial(is_gone, view, self._camera.model)
            self._memory.look(fits, ORIGIN, self._number, gone)
        return self._memory.solids(ORIGIN, self._number)

    def close(self) -> None:
        """Free the graphics."""
        self._renderer.close()
