"""Cameras of a simulated robot, rendered from the scene and poses that its driver publishes."""

from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from gigabrain_drivers.cameras.base import (
    CameraOptions,
    CameraSource,
    Frame,
    Picture,
)
from gigabrain_drivers.cameras.depth_noise import NO_ERRORS, SENSOR, DepthSensor
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_drivers.sim.scene import ROBOT
from gigabrain_drivers.sim.scene_model import BASE, SceneModel
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sim import SimPoses, SimScene
from gigabrain_zenoh.errors import ConfigError, Unsupported

NEAR_M, FAR_M = 0.01, 60.0  # clipping planes
COSTLY = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)
MAX_RAY_SLOPE = 4.0  # sideways for each metre ahead
MIN_LIT_SHARE = 0.5  # of the pixels, those that light reaches through the lens
OUTSIDE = -9.0  # column and row of pixels that no light reaches
UNDISTORT = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 1e-9)
PIXEL_NOISE = 2.0  # standard deviation, of 255
NOISE_MARGIN = 256  # [px], extra size of the noise table, to shift it randomly


class RenderedCamera(CameraSource):
    """A camera that MuJoCo renders. One `Renderer` draws all cameras of a robot."""

    Options = CameraOptions

    def open(self) -> None:
        """Raise Unsupported: see `Renderer`."""
        raise Unsupported("rendered cameras share one renderer")

    def read(self) -> Frame:
        """Raise Unsupported: see `Renderer`."""
        raise Unsupported("rendered cameras share one renderer")

    def close(self) -> None:
        """Do nothing."""


class View:
    """One rendered camera: its lens, its true mounting and its errors."""

    def __init__(self, camera: Camera, seed: int, *, errors: bool) -> None:
        self.camera = camera
        self.sensor = DepthSensor(camera, seed, SENSOR if errors else NO_ERRORS)
        random = np.random.default_rng(seed)
        shape = (camera.height + NOISE_MARGIN, camera.width + NOISE_MARGIN, 3)
        sigma = PIXEL_NOISE if errors else 0.0
        self._noise = (sigma * random.standard_normal(shape, np.float32)).astype(np.int16)
        self.lens = Lens(camera)

    def exposure(self, colours: Picture, depth: NDArray[np.float32], number: int) -> Frame:
        """Return the exposure for ideal colours (height, width, 3) and depth [m].

        Exposures with the same `number` have the same errors.
        """
        camera = self.camera
        down, right = self.sensor.begin(number).integers(0, NOISE_MARGIN, 2).tolist()
        noise = self._noise[down : down + camera.height, right : right + camera.width]
        noisy = cv2.add(cv2.cvtColor(colours, cv2.COLOR_RGB2BGR), noise, dtype=cv2.CV_8U)
        measured = self.sensor.measure(depth) if camera.depth else None
        if measured is not None:
            measured[np.isnan(depth)] = 0
        return Frame(np.asarray(noisy, np.uint8), measured)


class Lens:
    """Turns pictures of an ideal camera, as drawn, into those of a camera with any intrinsics."""

    def __init__(self, camera: Camera) -> None:
        fx, fy, cx, cy = camera.pinhole
        self.width, self.height, self.focal = camera.width, camera.height, fy
        self.centre = cx, cy
        self._maps: tuple[Any, Any] | None = None
        if fx == fy and not any(camera.distortion):
            return
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2).astype(np.float64)
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
        given = np.array(camera.distortion)
        coefficients = np.zeros(5 if len(given) <= 5 else 8)
        coefficients[: len(given)] = given
        plain = np.eye(3)
        rays = cv2.undistortPoints(pixels, matrix, coefficients, None, plain, plain, UNDISTORT)
        ahead = np.column_stack([rays[:, 0], np.ones(len(rays))])
        back, _ = cv2.projectPoints(ahead, np.zeros(3), np.zeros(3), matrix, coefficients)
        lit = ((np.abs(rays) < MAX_RAY_SLOPE) & (np.abs(back - pixels) < 1.0)).all(axis=(1, 2))
        if lit.mean() < MIN_LIT_SHARE:
            raise ConfigError(
                f"camera {camera.name!r}: its distortion folds the picture; "
                "expected the k1, k2, p1, p2, k3 of its calibration"
            )
        self.focal = max(fx, fy)
        x, y = rays[lit, 0].T
        left, top = -np.floor(self.focal * x.min()), -np.floor(self.focal * y.min())
        self.centre = float(left), float(top)
        self.width = int(left + np.ceil(self.focal * x.max())) + 1
        self.height = int(top + np.ceil(self.focal * y.max())) + 1
        shape = camera.height, camera.width
        column, row = (
            np.where(lit, self.focal * ways + middle, OUTSIDE).reshape(shape).astype(np.float32)
            for ways, middle in ((rays[:, 0, 0], left), (rays[:, 0, 1], top))
        )
        self._maps = column, row

    def bend(
        self, colours: Picture, depth: NDArray[np.float32]
    ) -> tuple[Picture, NDArray[np.float32]]:
        """Return the ideal pictures as the lens shows them.

        Pixels that no light reaches are black, and their depth is NaN.
        """
        if self._maps is None:
            return colours, depth
        bent = cv2.remap(colours, *self._maps, cv2.INTER_LINEAR)
        return np.asarray(bent, np.uint8), np.asarray(
            cv2.remap(depth, *self._maps, cv2.INTER_NEAREST, borderValue=np.nan), np.float32
        )


class Renderer:
    """Draws all cameras of one robot. Create, use and close it in one thread.

    Raises ConfigError where nothing can be drawn.
    """

    def __init__(self, views: Mapping[str, View]) -> None:
        self._views = views
        self._width = max(view.lens.width for view in views.values())
        self._height = max(view.lens.height for view in views.values())
        self._graphics = open_graphics(self._width, self._height)
        self._scene: SceneModel | None = None
        self._drawn: mujoco.MjvScene | None = None
        self._context: mujoco.MjrContext | None = None
        self._rest_height: float | None = None  # [m], of the base's origin at rest

    def show(self, scene: SimScene) -> None:
        """Set the scene. Raises ConfigError if it cannot be drawn; then no scene is set."""
        before, self._scene = self._scene, None
        if before and before.update(scene):
            self._scene = before
            return
        self._free()
        made = SceneModel(scene)
        model = made.model
        model.vis.global_.offwidth, model.vis.global_.offheight = self._width, self._height
        model.vis.quality.offsamples, model.vis.quality.shadowsize = 0, 0
        self._scene, self._rest_height = made, None
        self._drawn = mujoco.MjvScene(model, maxgeom=max(1000, 2 * model.ngeom))
        for costly in COSTLY:  # they would take three quarters of the time
            self._drawn.flags[costly] = 0
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR.value
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)

    def expose(self, poses: SimPoses, names: Sequence[str]) -> dict[str, Frame]:
        """Return exposures by camera name; none for poses of another version of the scene."""
        scene, drawn, context = self._scene, self._drawn, self._context
        if scene is None or drawn is None or context is None or not scene.place(poses):
            return {}
        if self._rest_height is None:  # at the first poses the body is at rest
            self._rest_height = float(scene.pose_of(BASE)[2])
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            scene.model, scene.data, mujoco.MjvOption(), None, mujoco.MjvCamera(), everything, drawn
        )
        scene.add_things(drawn)
        frames = {}
        for name in names:
            view = self._views[name]
            self._aim(drawn, view, scene)
            colours, depth = view.lens.bend(*self._draw(view.lens))
            frames[name] = view.exposure(colours, depth, poses.tick)
        return frames

    def close(self) -> None:
        """Free the graphics."""
        self._free()
        self._graphics.free()

    def _free(self) -> None:
        if self._context:
            self._context.free()
        self._scene = self._drawn = self._context = None

    def _aim(self, drawn: mujoco.MjvScene, view: View, scene: SceneModel) -> None:
        """Put both eyes of MuJoCo's camera at the true mounting of the robot's camera."""
        camera, lens = view.sensor.mounted, view.lens
        body = scene.pose_of(f"{ROBOT}{camera.link}" if camera.link else BASE)
        turn, height = rotation(body[3:]), 0.0 if camera.link else self._rest_height or 0.0
        place = body[:3] + turn @ np.array([camera.x, camera.y, camera.z - height])
        axes = turn @ mounting(camera)
        upper, lower = lens.centre[1] + 0.5, lens.height - 0.5 - lens.centre[1]
        middle = lens.width / 2 - 0.5 - lens.centre[0]
        for eye in drawn.camera:
            eye.pos, eye.forward, eye.up = place, axes[:, 0], axes[:, 2]
            eye.frustum_near, eye.frustum_far = NEAR_M, FAR_M
            eye.frustum_center = NEAR_M * middle / lens.focal
            eye.frustum_top = NEAR_M * upper / lens.focal
            eye.frustum_bottom = -NEAR_M * lower / lens.focal
            eye.orthographic = 0

    def _draw(self, lens: Lens) -> tuple[Picture, NDArray[np.float32]]:
        """Return colours (height, width, 3) and depth [m]; FAR_M where there is nothing."""
        whole = mujoco.MjrRect(0, 0, lens.width, lens.height)
        colours = np.empty((lens.height, lens.width, 3), np.uint8)
        raw = np.empty((lens.height, lens.width), np.float32)
        mujoco.mjr_render(whole, self._drawn, self._context)
        mujoco.mjr_readPixels(colours, raw, whole, self._context)
        # OpenGL counts rows from below; the depth buffer holds 1 at the near plane, 0 at the far
        depth = NEAR_M * FAR_M / (NEAR_M + (FAR_M - NEAR_M) * np.flipud(raw))
        return np.ascontiguousarray(np.flipud(colours)), depth.astype(np.float32)


def rotation(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of a quaternion w, x, y, z."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def mounting(camera: Camera) -> NDArray[np.float64]:
    """Return the axes of a mounted camera (3, 3): rotated by roll, then pitch, then yaw."""
    (sr, sp, sy), (cr, cp, cy) = (
        function([camera.roll, camera.pitch, camera.yaw]) for function in (np.sin, np.cos)
    )
    return np.array([
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ])  # fmt: skip
