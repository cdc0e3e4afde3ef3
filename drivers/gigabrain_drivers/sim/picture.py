"""Pictures of a robot in its room, rendered off screen."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import SimModel, sim_body
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.png import png
from gigabrain_drivers.sim.world import Pose, World, clearance
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_zenoh.errors import Unsupported
from gigabrain_zenoh.host.files import cannot_write

DISTANCE_M, HEIGHT_M = 1.0, 0.50  # of the camera: from the robot, and above the floor
AIM_HEIGHT_M = 0.22  # aim above the robot, to have the room in the picture
FIELD_OF_VIEW_DEG = 44.0
SHADOW_REACH_M = 3.5  # radius of shadows round the robot; smaller ones have finer edges
SUN_DISTANCE_M = 4.0  # from the robot, beyond the tallest thing near it
SUPERSAMPLING = 2  # drawn larger by this factor, then averaged


def render(
    body: SimModel, world: World, seed: int, path: Path, width: int = 1280, height: int = 720
) -> None:
    """Write a PNG of the robot at its start. Raises ConfigError where nothing can be drawn."""
    simulation = Simulation(body, world, seed)
    model, data = simulation.model, simulation.data
    model.vis.global_.fovy, model.vis.map.zfar = FIELD_OF_VIEW_DEG, 3.0
    robot = simulation.truth.pose()
    _light(model, robot)
    mujoco.mj_forward(model, data)
    save_picture(model, data, _camera(world, robot), path, width=width, height=height)


def save_picture(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: mujoco.MjvCamera,
    path: Path,
    add: Callable[[mujoco.MjvScene], None] = lambda _: None,
    *,
    width: int = 1280,
    height: int = 720,
) -> None:
    """Write a camera's view as a PNG; `add` may add shapes to the scene.

    Raises ConfigError where nothing can be drawn, or the file cannot be written.
    """
    model.vis.global_.offwidth, model.vis.global_.offheight = (
        width * SUPERSAMPLING,
        height * SUPERSAMPLING,
    )
    with _graphics(width * SUPERSAMPLING, height * SUPERSAMPLING):
        fine = _draw(model, data, camera, add)
    pixels = fine.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING, 3).mean(axis=(1, 3)).round()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(png(pixels.astype(np.uint8)))
    except OSError as error:
        raise cannot_write(path, error) from None


def _light(model: mujoco.MjModel, robot: Pose) -> None:
    """Put the sun over the robot, and use the whole shadow map there."""
    model.vis.quality.shadowsize = 8192
    model.vis.map.shadowclip = SHADOW_REACH_M / model.stat.extent
    suns = model.light_type == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    model.light_pos[suns] = np.array([robot.x, robot.y, 0]) - SUN_DISTANCE_M * model.light_dir[suns]


@contextmanager
def _graphics(width: int, height: int) -> Iterator[None]:
    """Keep an off-screen OpenGL context. Raises ConfigError naming the missing packages."""
    context = open_graphics(width, height)
    try:
        yield
    finally:
        context.free()


def _draw(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: mujoco.MjvCamera,
    add: Callable[[mujoco.MjvScene], None],
) -> NDArray[np.uint8]:
    width, height = model.vis.global_.offwidth, model.vis.global_.offheight
    scene = mujoco.MjvScene(model, maxgeom=max(1000, 2 * model.ngeom))
    scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 1
    everything = mujoco.mjtCatBit.mjCAT_ALL.value
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    add(scene)
    pixels, whole = np.empty((height, width, 3), np.uint8), mujoco.MjrRect(0, 0, width, height)
    context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
    try:
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, context)
        mujoco.mjr_render(whole, scene, context)
        mujoco.mjr_readPixels(pixels, None, whole, context)
    finally:
        context.free()
    return pixels[::-1]  # OpenGL counts rows from below


def _camera(world: World, robot: Pose) -> mujoco.MjvCamera:
    """Return a camera obliquely in front of the robot, on the side with the most room."""
    shapes = world.everything()

    def room(angle: float) -> float:
        """Return the least clearance on the line from robot to camera, and just behind it."""
        cos, sin = math.cos(robot.yaw + angle), math.sin(robot.yaw + angle)
        reaches = (0.4, 0.7, 1.0, DISTANCE_M, DISTANCE_M + 0.2)
        return min(clearance(shapes, robot.x + cos * r, robot.y + sin * r) for r in reaches)

    side = max(math.radians(35), math.radians(-35), math.radians(55), math.radians(-55), key=room)
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.lookat = (robot.x, robot.y, AIM_HEIGHT_M)
    camera.distance = math.hypot(DISTANCE_M, HEIGHT_M - AIM_HEIGHT_M)
    camera.azimuth = math.degrees(robot.yaw + side) + 180
    camera.elevation = -math.degrees(math.atan2(HEIGHT_M - AIM_HEIGHT_M, DISTANCE_M))
    return camera


def portray(body: str, world: str, seed: int, file: Path) -> None:
    """Draw a robot in its world. Raises ConfigError, and Unsupported without a MuJoCo model."""
    robot, driver = make_driver(body, Run(folder=Path(), world=world, seed=seed))
    if not isinstance(driver, MujocoDriver):
        raise Unsupported(f"{body} has no MuJoCo model to draw")
    render(sim_body(robot, driver.options, driver.run), load_world(world, seed), seed, file)
