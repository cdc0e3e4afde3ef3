"""Camera contours in perception's worlds: their positions, ages and camera statuses."""

import functools
from collections.abc import Callable

import cv2
import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.base import Pose
from gigabrain_schemas.brain import CameraStatus, Contour, WorldModel
from gigabrain_schemas.logs import FINISHED
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import BODY, CAMERA, DEPTH, IMAGE, SCAN, STATE, WORLD
from gigabrain_schemas.vision import CameraInfo, DepthImage
from gigabrain_zenoh import codec
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.host.threads import Job
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.perception.camera_contours import SKIPPED
from gigabrain_zenoh.runtime.replay import Event, record, replay
from gigabrain_zenoh.testing.in_memory import NodeBench, PatientJournal
from gigabrain_zenoh.testing.samples import (
    ARMED,
    BOOT,
    WAFFLE,
    WRIST,
    body,
    open_space,
    scan,
    state,
)
from tests.unit.vision.scenes import HIGH, LOW, Box, depth_of, image, millimetres, near
from tests.unit.vision.test_floor_colour import picture

CAMERA_BODY = replace(WAFFLE, cameras=(LOW,), body_height=0.2)
BOX = Box(x=1.0, y=0.0, half_x=0.05, half_y=0.1, top=0.1)
MAPPING = pytest.mark.parametrize("mapping", ["off", "slam"])


class Bench(NodeBench):
    """Perception of a body that drives along x with one depth camera."""

    def __init__(self, mapping: str = "off", boot: int = BOOT) -> None:
        config = PerceptionConfig(mapping=mapping)  # type: ignore[arg-type]
        super().__init__(functools.partial(perception.run, config))
        self.boot = boot
        self.pose = Pose(x=0.0, y=0.0, yaw=0.0)

    async def begin(self, tick: int = 1) -> None:
        await self.ready()
        self.send(BODY, body(CAMERA_BODY, boot=self.boot))
        self.drive(tick)

    def drive(self, tick: int, x: float | None = None) -> None:
        """Send the state of a body at x [m] at a tick."""
        self.pose = self.pose if x is None else replace(self.pose, x=x)
        self.send(STATE, state(tick, pose=(self.pose.x, 0.0, 0.0), boot=self.boot))

    async def look(self, tick: int, picture: DepthImage | None = None, name: str = "front") -> None:
        """Send a picture of BOX from the body's position, and wait until it is processed."""
        seen = millimetres(LOW, depth_of(LOW, (BOX,), pose=self.pose))
        picture = replace(picture or image(seen), boot=self.boot, tick=tick, basis=tick)
        self.network.deliver(DEPTH.at(name), codec.encode(picture))
        await self.settled()

    async def settled(self) -> None:
        await self.clock.advance(0)

    async def world(self, tick: int) -> WorldModel:
        """Send a scan at a tick, and return its world."""
        self.sent(WORLD)
        self.send(SCAN, scan(open_space(), tick, boot=self.boot))
        await self.settled()
        return self.sent(WORLD)[-1]


def status(world: WorldModel) -> CameraStatus:
    (one,) = world.cameras
    return one


def front_of(world: WorldModel) -> float:
    """Return where the nearest contour begins [m]."""
    return min(x for x, _ in world.contours[0].polygon)


@MAPPING
async def test_the_next_world_has_the_contours_of_a_picture_moved_to_its_pose(mapping: str) -> None:
    async with Bench(mapping) as bench:
        await bench.begin()
        await bench.look(1)
        bench.drive(6, x=0.3)
        world = await bench.world(6)
        assert status(world) == CameraStatus(name="front", ok=True, exposure=1)
        assert near(world.contours, 0.65, 0.0)
        assert front_of(world) == pytest.approx(0.65, abs=0.02)
        assert world.contours[0].age == pytest.approx(0.1)


@MAPPING
async def test_a_picture_republishes_the_newest_world_with_its_contours(mapping: str) -> None:
    async with Bench(mapping) as bench:
        await bench.begin()
        before = await bench.world(1)
        assert not before.contours
        bench.drive(3, x=0.1)
        await bench.look(3)
        (again,) = bench.sent(WORLD)
        assert (again.basis, again.tick) == (before.basis, before.tick)
        assert status(again).exposure == 3
        assert front_of(again) == pytest.approx(0.95, abs=0.02)  # where the body was at the scan
        bench.drive(1 + 30)
        await bench.look(1 + 30)
        assert bench.sent(WORLD) == []  # that scan is old by now


@MAPPING
async def test_a_scan_without_a_pose_has_contours_at_the_newest_pose(mapping: str) -> None:
    """Perception was busy, so that it received only the newest of several states."""
    async with Bench(mapping) as bench:
        await bench.begin()
        await bench.look(1)
        bench.drive(18, x=0.1)
        world = await bench.world(12)
        assert status(world).ok
        assert front_of(world) == pytest.approx(0.85, abs=0.02)  # as of the newest state
        await bench.look(18)
        assert near(bench.sent(WORLD)[-1].contours, 0.85, 0.0)


async def test_a_picture_waits_for_the_state_of_its_tick() -> None:
    async with Bench() as bench:
        await bench.begin()
        await bench.look(2)
        assert not (await bench.world(1)).contours
        bench.drive(2)
        await bench.settled()
        assert status(bench.sent(WORLD)[-1]).exposure == 2


def no_picture(status: CameraStatus) -> bool:
    return "no picture" in status.problem


async def test_a_camera_that_is_silent_withheld_or_wrong_is_not_ok_with_a_reason() -> None:
    async with Bench() as bench:
        await bench.begin()
        first = status(await bench.world(1))
        assert not first.ok
        assert no_picture(first)
        assert first.exposure == 0
        await bench.look(1)
        bench.drive(20)
        assert status(await bench.world(20)).ok
        bench.drive(23)
        silent = status(await bench.world(23))
        assert not silent.ok
        assert no_picture(silent)
        info = CameraInfo(camera=LOW, problem="covered", boot=BOOT, tick=23)
        bench.network.deliver(CAMERA.at("front"), codec.encode(info))
        await bench.look(23)
        assert status(await bench.world(23)).problem == "covered"
        bench.network.deliver(CAMERA.at("front"), codec.encode(replace(info, problem="")))
        bench.drive(28)
        small = DepthImage(frame_id="front", height=16, width=16, planes=(b"", b"", b"", b""))
        await bench.look(28, small)
        wrong = status(await bench.world(28))
        assert not wrong.ok
        assert "320 x 240" in wrong.problem
        assert near((await bench.world(28)).contours, 0.95, 0.0)  # the contours are kept
        bench.drive(33)
        await bench.look(33, replace(small, frame_id="rear"))
        assert "'rear'" in status(await bench.world(33)).problem
        bench.drive(38)
        await bench.look(38)
        assert status(await bench.world(38)).ok


@pytest.mark.parametrize(
    "spoil",
    [
        lambda picture: replace(picture, planes=(b"\x78", b"", b"", b"")),
        lambda picture: replace(picture, planes=(b"bomb" * 1000, *picture.planes[1:])),
        lambda picture: replace(picture, height=2048, width=4096),
    ],
)
async def test_broken_pictures_are_refused_and_perception_goes_on(
    spoil: Callable[[DepthImage], DepthImage],
) -> None:
    picture = image(millimetres(LOW, depth_of(LOW, (BOX,))))
    async with Bench() as bench:
        await bench.begin()
        await bench.look(1, spoil(picture))
        assert not status(await bench.world(1)).ok
        bench.drive(6)
        await bench.look(6)
        assert status(await bench.world(6)).ok


@pytest.mark.long
async def test_a_flood_of_pictures_is_processed_at_the_rate_of_the_camera() -> None:
    async with Bench() as bench:
        await bench.begin()
        for tick in range(1, 101):
            bench.drive(tick)
            await bench.look(tick)
        assert bench.bus.counters[SKIPPED] >= 60
        await bench.look(100, name="stranger")
        await bench.look(1)  # an old picture
        assert status(await bench.world(100)).exposure > 95


async def test_a_restart_of_the_driver_clears_the_contours() -> None:
    async with Bench() as bench:
        await bench.begin()
        await bench.look(1)
        bench.boot = BOOT + 1
        for tick in (1, 2, 3):
            bench.send(BODY, body(CAMERA_BODY, boot=bench.boot))
            bench.drive(tick)
        world = await bench.world(3)
        assert (world.contours, status(world).exposure) == ((), 0)
        await bench.look(3)
        assert (await bench.world(3)).contours


async def test_a_higher_body_gets_contours_that_were_above_the_lower_one() -> None:
    """The driver was restarted with another file; the cameras are the same."""
    beam = Box(x=1.0, y=0.0, half_x=0.05, half_y=0.2, top=0.45, bottom=0.3)
    seen = image(millimetres(LOW, depth_of(LOW, (beam,))))
    async with Bench() as bench:
        await bench.begin()
        await bench.look(1, seen)
        assert not near((await bench.world(1)).contours, 0.95, 0.0)
        bench.boot = BOOT + 1
        for tick in (1, 2, 3):
            bench.send(BODY, body(replace(CAMERA_BODY, body_height=0.5), boot=bench.boot))
            bench.drive(tick)
        await bench.look(3, seen)
        assert near((await bench.world(3)).contours, 0.95, 0.0)


@pytest.mark.parametrize("encoding", ["bgr8", "jpeg"])
async def test_a_camera_without_depth_gives_contours_by_colour_that_are_marked(
    encoding: str,
) -> None:
    plain = replace(HIGH, depth=False)
    async with Bench() as bench:
        await bench.ready()
        bench.send(BODY, body(replace(CAMERA_BODY, cameras=(plain,))))
        for tick in (1, 6, 11, 16):
            bench.drive(tick)
            pixels = picture(Box(1.5, 0.0, 0.1, 0.2, 0.3), seed=tick)
            data = pixels.tobytes() if encoding == "bgr8" else jpeg(pixels)
            sent = Image(
                frame_id="front", encoding=encoding, width=320, height=240, data=data,  # type: ignore[arg-type]
                boot=BOOT, tick=tick, basis=tick,
            )  # fmt: skip
            bench.network.deliver(IMAGE.at("front"), codec.encode(sent))
            await bench.settled()
        world = await bench.world(16)
    assert status(world).ok
    assert near(world.contours, 1.4, 0.0)
    assert {one.source for one in world.contours} == {"floor_colour"}


def jpeg(pixels: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".jpg", pixels)[1].tobytes())


class Late(PatientJournal):
    """An executor whose only job lasts until a test ends it."""

    def __init__(self) -> None:
        self.unfinished: list[tuple[Job, Callable[[Job], None]]] = []

    def when_done(self, job: Job, then: Callable[[Job], None]) -> None:
        self.unfinished.append((job, then))

    def end_one(self) -> None:
        """End the only job."""
        (one,) = self.unfinished
        self.unfinished.clear()
        super().when_done(*one)


async def test_a_picture_that_waits_at_the_end_is_dropped() -> None:
    """The job ends after the node, and no other one begins then."""
    async with Bench() as bench:
        bench.bus.input_log = late = Late()
        await bench.begin()
        for tick in (1, 6):
            bench.drive(tick)
            await bench.look(tick)
    late.end_one()
    assert not late.unfinished


@pytest.mark.parametrize("behind", [0, 25])
async def test_cameras_take_turns_if_a_picture_takes_a_whole_period(behind: int) -> None:
    """This also holds if the pictures of one camera arrive late."""
    async with Bench() as bench:
        bench.bus.input_log = late = Late()
        await bench.ready()
        rear = replace(LOW, name="rear")
        bench.send(BODY, body(replace(CAMERA_BODY, cameras=(LOW, rear))))
        dark = DepthImage(frame_id="", height=LOW.height, width=LOW.width, planes=(b"",) * 4)
        for tick in range(26, 76, 5):
            bench.drive(tick)
            await bench.look(tick, dark, "front")
            await bench.look(tick - behind, dark, "rear")
            late.end_one()
        front, back = (await bench.world(71)).cameras
    assert sorted((front.exposure, back.exposure + behind)) == [61, 66]


async def test_a_body_without_cameras_costs_nothing() -> None:
    async with Bench() as bench:
        await bench.ready()
        bench.send(BODY, body())
        listened = {DEPTH.at("*"), IMAGE.at("*"), CAMERA.at("*"), STATE.key}
        assert not listened & set(bench.bus.listens)
        bench.send(BODY, body(CAMERA_BODY))
        assert listened - set(bench.bus.listens) == {IMAGE.at("*")}
        bench.send(BODY, body())
        assert not listened & set(bench.bus.listens)
        assert (await bench.world(1)).cameras == ()


async def test_a_camera_on_an_arm_gives_no_contours_and_has_no_status() -> None:
    async with Bench() as bench:
        await bench.ready()
        bench.send(BODY, body(replace(ARMED, cameras=(WRIST,))))
        assert not {IMAGE.at("*"), CAMERA.at("*"), STATE.key} & set(bench.bus.listens)
        assert (await bench.world(1)).cameras == ()
        bench.send(BODY, body(replace(ARMED, cameras=(WRIST, LOW), body_height=0.2)))
        assert IMAGE.at("*") not in bench.bus.listens
        bench.drive(2)
        await bench.look(2)
        world = await bench.world(2)
        assert status(world) == CameraStatus(name="front", ok=True, exposure=2)
        assert front_of(world) == pytest.approx(0.95, abs=0.02)


class Noting(PatientJournal):
    """Puts what threads have done between the other events."""

    def __init__(self, events: list[Event], clock: FakeClock) -> None:
        self._events, self._clock = events, clock

    def _note_finished(self) -> None:
        self._events.append((self._clock.now_ns(), FINISHED, b"\1"))


@pytest.mark.long
async def test_a_replay_gives_the_same_worlds() -> None:
    """The result of a job is used where the log says, not when the replayed job ends."""
    async with Bench("slam") as bench:
        events = record(bench.network, bench.clock)
        bench.bus.input_log = Noting(events, bench.clock)
        await bench.begin()
        for tick in range(6, 60, 5):
            bench.drive(tick, x=tick / 100)
            await bench.world(tick)
            await bench.look(tick)
            bench.drive(tick + 1)
    worlds = [data for _, key, data in events if key == WORLD.key]
    assert sum(bool(contours_of(data)) for data in worlds) > 15
    inputs = {BODY.key, STATE.key, SCAN.key, DEPTH.at("front"), FINISHED}
    received = [event for event in events if event[1] in inputs]
    config = PerceptionConfig(mapping="slam")
    now = await replay(functools.partial(perception.run, config), received, "perception")
    assert [data for key, data in now if key == WORLD.key] == worlds


def contours_of(data: bytes) -> tuple[Contour, ...]:
    return msgspec.msgpack.decode(data, type=WorldModel).contours
