"""A live window of a running simulation, in its own process, fed over the bus."""

import asyncio
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gigabrain_drivers.sim.scene_model import SceneModel
from gigabrain_schemas.sim import SimPoses, SimScene
from gigabrain_schemas.topics import SIM_POSES, SIM_SCENE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import Latest
from gigabrain_zenoh.errors import BodyLost, ConfigError

FRAME_S = 0.04
WAIT_S = 5.0  # for the scene, and for the first poses
SILENT_S = 5.0  # without poses, before a warning
ELSEWHERE = (
    "use the 3-D view of the operator page, or `gigabrain view --picture FILE`, or run this "
    "where there is a display, with --connect"
)
NO_SCENE = (
    "this robot sends no simulated world; is it a simulation (`gigabrain demo`), and do your "
    "keys permit it?"
)


def check_display() -> None:
    """Check that a window can be opened. Raises ConfigError naming the alternatives."""
    try:
        import glfw
    except ImportError as error:
        raise ConfigError(
            f"a window needs more packages ({error}): pip install 'gigabrain-zenoh[view]'"
        ) from None
    if sys.platform == "darwin":
        raise ConfigError(f"MuJoCo's window needs its own Python on macOS; {ELSEWHERE}")
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & os.environ.keys():
        raise ConfigError(f"there is no display here; {ELSEWHERE}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # GLFW's errors are reported below
        window = None
        if glfw.init():
            glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
            window = glfw.create_window(64, 64, "", None, None)
            glfw.terminate()
    if not window:
        raise ConfigError(f"the display cannot be opened, or has no OpenGL; {ELSEWHERE}")


async def show(bus: Bus, picture: Path | None, say: Callable[[str], None]) -> None:
    """Show the simulation until its window is closed, or save one picture of it.

    A window needs a display, see `check_display`. Raises BodyLost where the robot sends no world.
    """
    scenes, poses = bus.latest(SIM_SCENE), bus.latest(SIM_POSES)
    made = SceneModel(await _first(scenes))
    if picture:
        await _placed(made, scenes, poses)
        await asyncio.to_thread(made.save, picture)
        say(str(picture))
        return
    while made := await _window(made, scenes, poses, say):  # type: ignore[assignment]
        pass


async def _first(scenes: Latest[SimScene]) -> SimScene:
    end_s = asyncio.get_running_loop().time() + WAIT_S
    while scenes.newest is None:
        if asyncio.get_running_loop().time() > end_s:
            raise BodyLost(NO_SCENE)
        await asyncio.sleep(FRAME_S)
    return scenes.newest


async def _placed(made: SceneModel, scenes: Latest[SimScene], poses: Latest[SimPoses]) -> None:
    """Wait for the first poses, and apply them."""
    end_s = asyncio.get_running_loop().time() + WAIT_S
    while not (poses.newest and made.place(poses.newest)):
        if asyncio.get_running_loop().time() > end_s:
            raise BodyLost("the simulation stands still: it has sent no poses")
        await asyncio.sleep(FRAME_S)
        if scenes.newest:
            made.update(scenes.newest)


async def _window(
    made: SceneModel,
    scenes: Latest[SimScene],
    poses: Latest[SimPoses],
    say: Callable[[str], None],
) -> SceneModel | None:
    """Show one world; return the next one if the robot is now in another, else None."""
    import mujoco.viewer

    viewer: Any = await asyncio.to_thread(
        mujoco.viewer.launch_passive, made.model, made.data,
        show_left_ui=False, show_right_ui=False,
    )  # fmt: skip
    try:
        await _placed(made, scenes, poses)
        with viewer.lock():
            made.aim(viewer.cam)
        loop = asyncio.get_running_loop()
        newest, moved_s, warned = poses.newest, loop.time(), False
        while viewer.is_running():
            scene = scenes.newest
            if poses.newest is not newest:
                newest, moved_s, warned = poses.newest, loop.time(), False
            elif loop.time() - moved_s > SILENT_S and not warned:
                say("the simulation is silent; the window shows its last state")
                warned = True
            if scene and scene is not made.scene and not made.update(scene):
                return SceneModel(scene)
            with viewer.lock():
                if poses.newest:
                    made.place(poses.newest)
                viewer.user_scn.ngeom = 0
                made.add_things(viewer.user_scn)
            viewer.sync()
            await asyncio.sleep(FRAME_S)
    finally:
        viewer.close()
    return None
