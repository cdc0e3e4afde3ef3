"""A rendered camera on a link of an arm: it moves with the link, and shows the fingertips."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from gigabrain_drivers.cameras.rendered import Renderer, View, mounting
from gigabrain_drivers.driver.catalog import make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_schemas.body import Camera
from gigabrain_zenoh.errors import ConfigError

POSTURES = ((0.0, -1.7, 1.2, 1.4, 0.0, 0.2), (0.4, -0.9, 0.9, -0.5, 1.5, 0.2))  # [rad]: down, up
PADS = ("pad_fixed", "pad_moving")
Pixels = NDArray[np.uint8]


class WristCamera:
    """An arm in a world, with the camera at its wrist."""

    def __init__(self, name: str, world: str, prefix: str) -> None:
        robot, driver = make_driver(name, Run(folder=Path(), world=world, cameras=True))
        assert isinstance(driver, MujocoDriver)
        (self.camera,) = [one for one in robot.cameras if one.link]
        self.model, self.data = driver._simulation.model, driver._simulation.data
        self._driver, self._prefix = driver, f"robot/{prefix}"
        self._joints = [f"robot/{one.name}" for one in robot.joints]
        self.renderer = Renderer({"wrist": View(self.camera, 0, errors=False)})

    def move(self, posture: tuple[float, ...]) -> None:
        for joint, position in zip(self._joints, posture, strict=True):
            self.data.joint(joint).qpos[0] = position
        mujoco.mj_forward(self.model, self.data)

    def picture(self) -> Pixels:
        (_, scene), (_, poses) = self._driver._world.scene()
        self.renderer.show(scene)  # type: ignore[arg-type]
        picture = self.renderer.expose(poses, ["wrist"])["wrist"].picture  # type: ignore[arg-type]
        assert picture is not None
        return picture

    def geoms_in_sight(self) -> NDArray[np.intp]:
        """Return the geom at every fourth pixel, by rays in the physics, (60, 80); -1 for none."""
        camera, link = self.camera, self.data.body(f"robot/{self.camera.link}")
        turn = link.xmat.reshape(3, 3)
        eye = link.xpos + turn @ np.array([camera.x, camera.y, camera.z])
        fx, fy, cx, cy = camera.pinhole
        found = np.full((camera.height // 4, camera.width // 4), -1)
        drawn, hit = np.array([1, 1, 1, 0, 0, 0], np.uint8), np.zeros(1, np.int32)
        for row, column in np.ndindex(found.shape):
            ray = np.array([1.0, -(4 * column - cx) / fx, -(4 * row - cy) / fy])
            way = turn @ mounting(camera) @ ray
            mujoco.mj_ray(self.model, self.data, eye, way, drawn, 1, -1, hit)
            found[row, column] = hit[0]
        return found

    def pads(self) -> list[NDArray[np.bool_]]:
        """Return the masks of the fixed and the moving pad in the picture, (60, 80) each."""
        seen = self.geoms_in_sight()
        return [seen == self.model.geom(f"{self._prefix}{name}").id for name in PADS]


@pytest.fixture(
    scope="module", params=[("so101", "table", ""), ("lekiwi", "kitchen", "arm_")],
    ids=["so101", "lekiwi"],
)  # fmt: skip
def wrist(request: pytest.FixtureRequest) -> Iterator[WristCamera]:
    try:
        open_graphics(64, 64).free()
    except ConfigError as error:
        pytest.skip(str(error))
    made = WristCamera(*request.param)
    with closing(made.renderer):
        yield made


def test_both_fingertips_are_at_their_true_pixels(
    wrist: WristCamera,
) -> None:
    for posture in POSTURES:
        wrist.move(posture)
        picture = wrist.picture()[::4, ::4].astype(int)
        for pad in wrist.pads():
            rows, columns = np.nonzero(pad)
            assert len(rows) > 20
            assert 15 < rows.mean() < 50  # of 60 rows
            assert 15 < columns.mean() < 65  # of 80 columns
            shades = picture[pad]
            assert np.median(shades.max(axis=1)) < 90  # pads are dark, fingers yellow
            assert np.median(np.ptp(shades, axis=1)) < 20


def test_the_camera_moves_with_the_link(wrist: WristCamera) -> None:
    pictures, fixed = [], []
    for posture in POSTURES:
        wrist.move(posture)
        pictures.append(wrist.picture().astype(int))
        fixed.append(wrist.pads()[0])
    apart = np.abs(pictures[0] - pictures[1]).max(axis=2)
    assert (apart[:80] > 20).mean() > 0.6  # another background
    assert (fixed[0] == fixed[1]).all()  # the finger stays at its pixels


def test_opening_the_gripper_moves_one_finger_in_the_picture(wrist: WristCamera) -> None:
    wrist.move(POSTURES[0])
    shut = [np.argwhere(pad)[:, 1].mean() for pad in wrist.pads()]
    wrist.move((*POSTURES[0][:-1], 0.6))
    opened = [np.argwhere(pad)[:, 1].mean() for pad in wrist.pads()]
    assert opened[0] == shut[0]
    assert opened[1] < shut[1] - 4  # to the left of the picture


def test_a_camera_without_a_link_does_not_move_with_the_arm(wrist: WristCamera) -> None:
    fixed = Camera(name="wrist", x=1.0, z=0.5, pitch=0.4, yaw=3.1416)  # looks at the robot
    with closing(Renderer({"wrist": View(fixed, 0, errors=False)})) as renderer:
        wrist.renderer, before = renderer, wrist.renderer
        wrist.move(POSTURES[0])
        one = wrist.picture().astype(int)
        wrist.move(POSTURES[1])
        other = wrist.picture().astype(int)
        wrist.renderer = before
    moved = np.abs(one - other).max(axis=2) > 20
    assert 0.001 < moved.mean() < 0.5  # only the arm moved
