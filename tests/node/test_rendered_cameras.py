"""Rendered cameras show the physics at the right pixels, and publish their pictures."""

import asyncio
import functools
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path

import cv2
import msgspec
import mujoco
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_drivers.cameras import process as camera_process
from gigabrain_drivers.cameras.rendered import Renderer, View, mounting
from gigabrain_drivers.driver.catalog import load_robot, make_driver
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.driver import MujocoDriver
from gigabrain_drivers.sim.graphics import open_graphics
from gigabrain_schemas.base import Message
from gigabrain_schemas.body import Camera
from gigabrain_schemas.sim import SimPoses, SimScene
from gigabrain_schemas.topics import CAMERA, DEPTH, IMAGE, SIM_POSES, SIM_SCENE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import CameraConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.testing import samples
from gigabrain_zenoh.testing.waiting import until

BOOT = samples.BOOT
FRONT = load_robot("turtlebot3_waffle").cameras[0]
SEEN_GEOM_GROUPS = np.array([1, 1, 0, 1, 1, 1], np.uint8)  # without the robot itself


@pytest.fixture(scope="module", autouse=True)
def graphics() -> None:
    try:
        open_graphics(64, 64).free()
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def driver() -> MujocoDriver:
    _, made = make_driver("turtlebot3_waffle", Run(folder=Path(), world="house", cameras=True))
    assert isinstance(made, MujocoDriver)
    return made


def scene_and_poses(driver: MujocoDriver) -> tuple[SimScene, SimPoses]:
    (_, scene), (_, poses) = driver._world.scene()
    return scene, poses  # type: ignore[return-value]


def true_depth(driver: MujocoDriver, camera: Camera, u: float, v: float) -> float:
    """Return the depth along the camera's axis [m] at a pixel, by a ray in the physics."""
    model, data = driver._simulation.model, driver._simulation.data
    base = model.body("robot/base").id
    turn = data.xmat[base].reshape(3, 3)
    height = data.xpos[base][2]
    place = data.xpos[base] + turn @ np.array([camera.x, camera.y, camera.z - height])
    fx, fy, cx, cy = camera.pinhole
    ray = turn @ mounting(camera) @ np.array([1.0, -(u - cx) / fx, -(v - cy) / fy])
    hit = np.zeros(1, np.int32)
    distance = mujoco.mj_ray(
        model, data, place, ray / np.linalg.norm(ray), SEEN_GEOM_GROUPS, 1, -1, hit
    )
    return float(distance / np.linalg.norm(ray)) if distance > 0 else np.inf


TILTED = replace(FRONT, pitch=0.3, roll=0.1, yaw=0.4, z=0.3)
WITH_INTRINSICS = replace(FRONT, intrinsics=(250.0, 230.0, 150.0, 130.0), distortion=(0.0,))


@pytest.mark.parametrize(
    "camera", [FRONT, TILTED, WITH_INTRINSICS], ids=["front", "tilted", "intrinsics"]
)
def test_depth_pixels_agree_with_rays_in_the_physics(driver: MujocoDriver, camera: Camera) -> None:
    scene, poses = scene_and_poses(driver)
    with closing(Renderer({"front": View(camera, 0, errors=False)})) as renderer:
        renderer.show(scene)
        depth = renderer.expose(poses, ["front"])["front"].depth
    assert depth is not None
    assert (depth > 0).mean() > 0.3
    off_mm = []
    for v in range(8, 240, 24):
        for u in range(8, 320, 24):
            around = depth[v - 2 : v + 3, u - 2 : u + 3].astype(int)
            if around.min() > 0 and np.ptp(around) < 100:  # not at an edge
                off_mm.append(abs(depth[v, u] - 1000 * true_depth(driver, camera, u, v)))
    assert len(off_mm) > 30
    assert np.percentile(off_mm, 95) < 5.0
    assert np.median(off_mm) < 2.0


def test_a_lens_distorts_the_picture_like_opencv() -> None:
    bent = replace(FRONT, distortion=(-0.2, 0.05, 0.0, 0.0, 0.0))
    lens = View(bent, 0, errors=False).lens
    assert (lens.width, lens.height) > (FRONT.width, FRONT.height)
    columns = np.arange(lens.width, dtype=np.float32)
    depth = np.repeat((columns - lens.centre[0])[None], lens.height, axis=0)  # focal * x
    colours = np.zeros((lens.height, lens.width, 3), np.uint8)
    _, seen = lens.bend(colours, depth)
    assert seen.shape == (240, 320)
    focal, _, cx, _ = bent.pinhole
    x = float(seen[119, 300]) / focal  # a ray of the ideal camera
    bent_x = x * (1 - 0.2 * x**2 + 0.05 * x**4)
    assert focal * bent_x + cx == pytest.approx(300, abs=1.0)


def test_pixels_without_light_through_the_lens_are_black(driver: MujocoDriver) -> None:
    lens = (190.0, 190.0, 159.5, 119.5), (-0.33, 0.11, 0.0, 0.0, -0.016)
    camera = replace(FRONT, intrinsics=lens[0], distortion=lens[1])
    scene, poses = scene_and_poses(driver)
    with closing(Renderer({"front": View(camera, 0, errors=False)})) as renderer:
        renderer.show(scene)
        frame = renderer.expose(poses, ["front"])["front"]
    assert frame.depth is not None
    assert frame.picture is not None
    corners = np.ix_((0, -1), (0, -1))
    assert not frame.picture[corners].any()
    assert not frame.depth[corners].any()
    assert (frame.picture.max(axis=2) > 0).mean() > 0.98
    matrix = np.array([[190.0, 0, 159.5], [0, 190.0, 119.5], [0, 0, 1]])
    rays = np.array([[x, y, 1.0] for x in np.linspace(-0.8, 0.8, 9) for y in (0.1, 0.3)])
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, np.array(lens[1]))
    off_mm = [
        abs(frame.depth[round(v), round(u)] - 1000 * true_depth(driver, camera, *straight))
        for (u, v), straight in zip(pixels[:, 0], 190 * rays[:, :2] + lens[0][2:], strict=True)
    ]
    assert np.median(off_mm) < 15.0  # rounding moves a ray by up to half a pixel


class FakeDriver:
    """Publishes a driver's messages for a camera process with real threads."""

    def __init__(self, driver: MujocoDriver) -> None:
        self.network = LocalNetwork()
        self.bus = Bus(self.network.transport(), Clock(), "driver")
        self.received: dict[str, list[Message]] = {"depth": [], "image": [], "camera": []}
        for topic in (DEPTH, IMAGE, CAMERA):
            name = topic.key.partition("/")[2]
            self.bus.subscribe(
                topic, lambda _, message, name=name: self.received[name].append(message)
            )  # type: ignore[misc]
        self.scene, self.poses = scene_and_poses(driver)
        self.bus.time.boot = BOOT

    def tick(self, tick: int, *, poses: bool = True) -> None:
        self.bus.time.tick = tick
        self.bus.publish(STATE, samples.state(tick))
        if poses:
            self.bus.publish(SIM_POSES, self.poses, basis=tick)

    async def drive(self, first: int, last: int, *, poses: bool = True) -> None:
        """Publish ticks; after each tick with an exposure, wait for the picture."""
        for tick in range(first, last + 1):
            before = len(self.received["image"]) + len(self.received["camera"])
            self.tick(tick, poses=poses)
            if poses and tick % 5 == 0:
                await until(
                    lambda: len(self.received["image"]) + len(self.received["camera"]) > before,  # noqa: B023
                    f"tick {tick}",
                )
            await asyncio.sleep(0)


@asynccontextmanager
async def running(driver: MujocoDriver) -> AsyncIterator[tuple[FakeDriver, Bus]]:
    world = FakeDriver(driver)
    world.bus.publish(SIM_SCENE, world.scene)
    bus = Bus(world.network.transport(), Clock(), "camera")
    ready = asyncio.Event()
    node = functools.partial(camera_process.run, CameraConfig(body="turtlebot3_waffle"))
    task = asyncio.ensure_future(node(bus, ready.set))
    try:
        await asyncio.wait(
            (task, asyncio.ensure_future(ready.wait())), return_when="FIRST_COMPLETED"
        )
        if not task.done():
            world.tick(1)
            world.bus.publish(SIM_SCENE, world.scene)
            world.tick(2)
            await until(lambda: world.received["image"] or task.done(), "the first picture")
        yield world, bus
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        await bus.close()
        await world.bus.close()


async def test_picture_depth_and_info_have_stamp_tick_and_basis_of_the_exposure(
    driver: MujocoDriver,
) -> None:
    async with running(driver) as (world, _):
        await world.drive(3, 15)
        images, depths = world.received["image"], world.received["depth"]
        assert [one.tick for one in images[-3:]] == [5, 10, 15]
        assert [(one.tick, one.basis, one.boot) for one in images] == [
            (one.tick, one.basis, one.boot) for one in depths
        ]
        assert {one.boot for one in images} == {BOOT}
        sent_at = dict(world_stamps(world))
        assert [one.stamp_ns for one in depths[-3:]] == [sent_at[tick] for tick in (5, 10, 15)]
        info = world.received["camera"][-1]
        assert (info.camera, info.source, info.problem) == (FRONT, "mujoco", "")  # type: ignore[attr-defined]
        assert (depths[-1].array() > 0).mean() > 0.3  # type: ignore[attr-defined]


def world_stamps(world: FakeDriver) -> list[tuple[int, int]]:
    decode = msgspec.msgpack.Decoder(SimPoses).decode
    poses = [decode(data) for key, data in world.network.sent if key == SIM_POSES.key]
    return [(one.tick, one.stamp_ns) for one in poses]


@pytest.mark.parametrize(
    ("fault", "problem"),
    [
        ("frozen", "frozen"),
        ("repeats", "repeats pictures"),
        ("covered", "covered"),
        ("dark", "underexposed"),
        ("bright", "overexposed"),
    ],
)
async def test_a_camera_fault_is_reported_and_its_pictures_are_not_published(
    driver: MujocoDriver, fault: str, problem: str
) -> None:
    async with running(driver) as (world, bus):
        await world.drive(3, 30)
        bus.params.change("front_fault", fault)
        await world.drive(31, 55)  # 0.5 s
        assert world.received["camera"][-1].problem == problem  # type: ignore[attr-defined]
        await until(lambda: bus.problems, "the health's problem")
        assert problem in bus.problems[0].text
        before = len(world.received["image"])
        await world.drive(56, 70)
        assert len(world.received["image"]) == before
        assert bus.counters["front_withheld"] >= 5
        bus.params.change("front_fault", "none")
        await world.drive(71, 110)
        assert world.received["camera"][-1].problem == ""  # type: ignore[attr-defined]
        assert len(world.received["image"]) > before


async def test_an_unplugged_camera_is_reported_by_the_clock_of_the_robot(
    driver: MujocoDriver,
) -> None:
    async with running(driver) as (world, bus):
        await world.drive(3, 30)
        bus.params.change("front_fault", "unplugged")
        for tick in range(31, 56):
            world.tick(tick)
        await until(lambda: bus.problems, "the health's problem")
        assert world.received["camera"][-1].problem == "no picture"  # type: ignore[attr-defined]


async def test_paused_robot_time_is_no_camera_fault(driver: MujocoDriver) -> None:
    async with running(driver) as (world, bus):
        await world.drive(3, 30)
        await asyncio.sleep(0.6)
        assert not bus.problems


async def test_pictures_follow_a_restart_of_the_driver_at_once(driver: MujocoDriver) -> None:
    async with running(driver) as (world, bus):
        await world.drive(3, 30)
        world.bus.time.boot = BOOT + 1
        for tick in range(1, 5):
            world.bus.time.tick = tick
            world.bus.publish(STATE, samples.state(tick, boot=BOOT + 1))
        await until(lambda: bus.time.boot == BOOT + 1, "the new start")
        world.bus.publish(SIM_SCENE, world.scene)
        world.bus.publish(SIM_POSES, world.poses)
        await until(lambda: world.received["image"][-1].boot == BOOT + 1, "its picture")


async def test_a_robot_without_cameras_is_refused() -> None:
    bus = Bus(LocalNetwork().transport(), Clock(), "camera")
    with pytest.raises(ConfigError, match="has no cameras"):
        await camera_process.run(CameraConfig(body="turtlebot3_burger"), bus, lambda: None)
    await bus.close()


def test_a_distortion_that_folds_the_picture_is_refused() -> None:
    with pytest.raises(ConfigError, match="distortion folds the picture"):
        View(replace(FRONT, distortion=(-90.0, 0.0, 0.0, 0.0, 0.0)), 0, errors=False)


async def test_an_invalid_scene_is_reported_and_the_next_valid_one_is_drawn(
    driver: MujocoDriver,
) -> None:
    async with running(driver) as (world, bus):
        await world.drive(3, 10)
        assert bus.progress()
        broken = replace(world.scene, kinds=b"\xff" * len(world.scene.kinds))
        world.bus.publish(SIM_SCENE, broken)
        world.tick(15)
        await until(lambda: "cannot be shown" in camera_problems(world)[-1], "what is wrong")
        assert bus.progress()  # the process does not count as hanging
        world.bus.publish(SIM_SCENE, world.scene)
        await world.drive(16, 30)
        assert world.received["image"][-1].tick == 30


def camera_problems(world: FakeDriver) -> list[str]:
    return [one.problem for one in world.received["camera"]]  # type: ignore[attr-defined]
