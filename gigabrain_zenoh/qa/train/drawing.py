"""Off-screen pictures of a model: colours, or the visible geom of each pixel."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.sim.graphics import open_graphics

GEOM = int(mujoco.mjtObj.mjOBJ_GEOM)
NOTHING = -1


class Drawing:
    """Draws with EGL or OSMesa. Raises ConfigError with the names of missing packages.

    Use it in one thread, and close it after use.
    """

    def __init__(self, model: mujoco.MjModel, camera: int, width: int, height: int) -> None:
        self._model, self._size = model, (height, width)
        self._graphics = open_graphics(width, height)
        self._scene = mujoco.MjvScene(model, maxgeom=max(1000, 2 * model.ngeom))
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._camera = mujoco.MjvCamera()
        self._camera.type, self._camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera

    def close(self) -> None:
        """Free OpenGL's memory."""
        self._context.free()
        self._graphics.free()

    def colours(self, data: mujoco.MjData, options: mujoco.MjvOption) -> NDArray[np.uint8]:
        """Return a picture (h, w, 3), RGB."""
        self._update(data, options)
        return self._pixels()

    def geoms(self, data: mujoco.MjData, options: mujoco.MjvOption) -> NDArray[np.int64]:
        """Return the number of the visible geom for each pixel (h, w); NOTHING if there is none."""
        self._update(data, options)
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        colours = self._pixels().astype(np.int64)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = False
        numbers = np.full(self._scene.ngeom + 1, NOTHING)  # by colour; 0 is the background
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == GEOM:
                numbers[geom.segid + 1] = geom.objid
        return np.asarray(numbers[colours @ (1, 1 << 8, 1 << 16)])

    def _update(self, data: mujoco.MjData, options: mujoco.MjvOption) -> None:
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self._model, data, options, None, self._camera, everything, self._scene
        )
        # the context has its own copy of the materials' textures
        for name in ("mat_texid", "mat_texrepeat"):
            values = getattr(self._model, name).ravel()
            getattr(self._context, name)[: values.size] = values

    def _pixels(self) -> NDArray[np.uint8]:
        height, width = self._size
        pixels, viewport = (
            np.empty((height, width, 3), np.uint8),
            mujoco.MjrRect(0, 0, width, height),
        )
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(pixels, None, viewport, self._context)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest
