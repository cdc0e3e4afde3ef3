"""Recognition on the bus: its detections, and broken or too many pictures."""

import asyncio
import logging
import math
import threading
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import Camera
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.objects import Detections, Labels
from gigabrain_schemas.sensors import Image
from gigabrain_schemas.topics import BODY, DEPTH, DETECTIONS, IMAGE, LABELS, POSE, STATE
from gigabrain_schemas.vision import DepthImage, pack_depth
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.config.settings import RecognitionConfig
from gigabrain_zenoh.recognition.node import Recognition, make_observer
from gigabrain_zenoh.recognition.observer import Observer
from gigabrain_zenoh.testing import samples
from gigabrain_zenoh.testing.waiting import settle, until
from gigabrain_zenoh.vision.camera_model import CameraModel
from gigabrain_zenoh.vision.labels import CLASSES
from gigabrain_zenoh.vision.recognizer import Found
from gigabrain_zenoh.vision.tags import TagFinder
from tests.unit.vision.tag_scenes import CAMERA, draw, facing

TAG, DEPTH_PICTURE = draw(
    facing(7, 0.16, (1.0, 0.2, 0.1), 0.3, 0.0, 0.0), CameraModel(CAMERA), np.random.default_rng(0)
)
BALL = (120, 60, 160, 100)  # [px]
DEPTH_PICTURE[60:90, :120] += 1500  # the surroundings of the ball are farther away
DEPTH_PICTURE[60:90, 160:] += 1500
REAR = Camera(name="rear", width=320, height=240, x=-0.2, z=0.1, yaw=math.pi)
STAMP_NS = 1_795_580_000_000_000_000


class BallNet:
    """A net that finds the same ball in each picture, or hangs."""

    classes: Sequence[str] = CLASSES

    def __init__(self) -> None:
        self.pictures_seen, self.go_on = 0, threading.Event()
        self.go_on.set()

    def find(self, picture: np.ndarray) -> Found:
        self.pictures_seen += 1
        assert self.go_on.wait(30)
        box = np.array([BALL], np.float32)
        return Found(box, np.array([1]), np.array([0.9], np.float32))


class Robot:
    """A stand-in for a robot's driver and cameras, which collects the detections."""

    def __init__(self, bus: Bus, clock: FakeClock, recognition: Recognition, net: BallNet):
        self.bus, self.clock, self.recognition, self.net = bus, clock, recognition, net
        self.received: list[Detections] = []
        bus.subscribe(DETECTIONS, lambda _, message: self.received.append(message))
        self.recognition_bus = recognition._bus

    def publish_state(self, tick: int, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.bus.time.boot, self.bus.time.tick = samples.BOOT, tick
        self.bus.publish(STATE, samples.state(tick, pose=pose))

    def publish_picture(
        self, basis: int, picture: Any = TAG, name: str = "front", depth: bool = True
    ) -> None:
        header: dict[str, Any] = {"basis": basis, "stamp_ns": STAMP_NS, "name": name}
        about: dict[str, Any] = {"frame_id": name, "width": 320, "height": 240}
        if depth:
            planes = pack_depth(DEPTH_PICTURE)
            self.bus.publish(DEPTH, DepthImage(**about, planes=planes), **header)
        data = picture if isinstance(picture, bytes) else cv2.imencode(".png", picture)[1]
        if not isinstance(picture, bytes):
            data = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, 90))[1].tobytes()
        self.bus.publish(IMAGE, Image(**about, encoding="jpeg", data=data), **header)

    async def wait_for_detections(self, count: int) -> Detections:
        await until(lambda: len(self.received) >= count, f"{count} detections")
        return self.received[-1]

    async def advance_s(self, seconds: float) -> None:
        await self.clock.advance(round(seconds * 1e9))


@asynccontextmanager
async def running(*cameras: Camera) -> AsyncIterator[Robot]:
    network, clock, net = LocalNetwork(), FakeClock(), BallNet()
    bus, recognition_bus = (
        Bus(network.transport(), clock, name) for name in ("driver", "recognition")
    )
    recognition = Recognition(RecognitionConfig(), recognition_bus, Observer(net, TagFinder()))
    robot = Robot(bus, clock, recognition, net)
    try:
        robot.publish_state(40)
        description = replace(samples.ARMED, cameras=cameras or (CAMERA,))
        bus.publish(BODY, samples.body(description))
        await settle()
        yield robot
    finally:
        net.go_on.set()
        recognition.close()
        await bus.close()
        await recognition_bus.close()


async def test_detections_have_basis_and_stamp_of_their_picture():
    async with running() as robot:
        robot.publish_picture(basis=38)
        found = await robot.wait_for_detections(1)
        assert (found.camera, found.width, found.height) == ("front", 320, 240)
        assert (found.basis, found.stamp_ns, found.boot) == (38, STAMP_NS, samples.BOOT)
        (ball,), (tag,) = found.things, found.tags
        assert (ball.label, ball.confidence) == ("ball", pytest.approx(0.9))
        assert ball.box == (120, 60, 160, 100)
        assert ball.in_map is None
        assert tag.id == 7
        assert tag.position == pytest.approx((1.0, 0.2, 0.1), abs=0.01)
        assert found.took_ms > 0


async def test_places_in_the_map_use_the_pose_at_the_exposure():
    async with running() as robot:
        robot.publish_state(41, (1.0, 0.0, 0.0))
        robot.publish_state(46, (1.5, 0.0, 0.0))
        pose = PoseInMap(x=5.5, y=2.0, yaw=math.pi / 2, covariance=(0.01,) * 9)
        robot.bus.publish(POSE, pose, basis=46)
        robot.publish_picture(basis=41)
        found = await robot.wait_for_detections(1)
        (tag,) = found.tags
        # at the exposure it was 0.5 m behind its newest pose: at (5.5, 1.5), facing +y
        assert tag.in_map == pytest.approx((5.5 - 0.2, 1.5 + 1.0, 0.1), abs=0.01)
        assert tag.yaw_in_map == pytest.approx(-math.pi / 2 + 0.3, abs=0.03)
        (ball,) = found.things
        assert ball.position
        assert ball.in_map == pytest.approx(
            (5.5 - ball.position[1], 1.5 + ball.position[0], ball.position[2])
        )


async def test_detections_of_an_unlocalized_robot_have_no_places_in_the_map():
    async with running() as robot:
        pose = PoseInMap(x=0.0, y=0.0, yaw=0.0, covariance=(0.01,) * 9, localized=False)
        robot.bus.publish(POSE, pose, basis=40)
        robot.publish_picture(basis=40)
        found = await robot.wait_for_detections(1)
        assert found.tags[0].in_map is None


async def test_broken_pictures_are_counted_and_the_next_one_is_used(caplog):
    async with running() as robot:
        whole = cv2.imencode(".jpg", TAG)[1].tobytes()
        small = cv2.imencode(".jpg", TAG[:64, :64])[1].tobytes()
        for number, bad in enumerate((b"\xff\xd8\xff", whole[:200], small, b"x" * 900), 1):
            robot.publish_picture(40, bad)
            await until(
                lambda: robot.recognition_bus.counters["broken_pictures"] == number,  # noqa: B023
                "a broken picture",
            )
            await robot.advance_s(1)
        assert robot.received == []
        faults = [one for one in caplog.records if one.levelno >= logging.WARNING]
        assert len(faults) == 1
        robot.publish_picture(40)
        assert (await robot.wait_for_detections(1)).tags


async def test_a_picture_of_another_size_than_in_the_robot_file_is_refused():
    async with running(replace(CAMERA, width=640, height=480)) as robot:
        robot.publish_picture(40)
        await until(lambda: robot.recognition_bus.counters["broken_pictures"] == 1, "a refusal")


async def test_pictures_beyond_the_rate_are_dropped():
    async with running() as robot:
        for tick in range(40, 240):  # 4 s at 50 Hz
            robot.publish_state(tick)
            robot.publish_picture(tick)
            await settle()
            await until(lambda: not robot.recognition._busy, "an idle worker")
            await robot.advance_s(0.02)
        assert 19 <= robot.net.pictures_seen <= 21


async def test_a_free_worker_takes_the_newest_picture():
    async with running() as robot:
        robot.net.go_on.clear()
        robot.publish_picture(basis=40)
        await until(lambda: robot.net.pictures_seen == 1, "work")
        for basis in (41, 42, 43):
            await robot.advance_s(1)
            robot.publish_picture(basis)
        await settle()
        robot.net.go_on.set()
        await robot.wait_for_detections(2)
        assert [one.basis for one in robot.received] == [40, 43]


async def test_cameras_take_turns():
    async with running(CAMERA, REAR) as robot:
        for _ in range(4):
            robot.publish_picture(40)
            robot.publish_picture(40, name="rear", depth=False)
            await until(lambda: not robot.recognition._busy, "an idle worker")
            await settle()
            await until(lambda: not robot.recognition._busy, "an idle worker")
            await robot.advance_s(0.2)
        await until(lambda: len(robot.received) == 8, "eight pictures")
        assert [one.camera for one in robot.received].count("rear") == 4
        assert all(thing.position is None for one in robot.received if one.camera == "rear"
                   for thing in one.things)  # fmt: skip


async def test_a_tag_of_an_unexpected_size_is_reported_once(caplog):
    async with running() as robot:
        robot.recognition._observer = Observer(robot.net, TagFinder(size=0.1))
        for count in range(1, 9):
            robot.publish_picture(40)
            await robot.wait_for_detections(count)
            await robot.advance_s(1)
        warnings = [one for one in caplog.records if one.levelno >= logging.WARNING]
        assert len(warnings) == 1
        assert "tag 7 measures 0.16 m" in warnings[0].message


async def test_a_picture_waits_for_its_depth_for_100_ms():
    async with running() as robot:
        robot.publish_picture(40, depth=False)
        await settle()
        assert robot.net.pictures_seen == 0
        await robot.advance_s(0.1)
        robot.publish_state(41)
        found = await robot.wait_for_detections(1)
        assert found.things[0].position is None


async def test_depth_of_another_exposure_is_not_used():
    async with running() as robot:
        robot.publish_picture(38)
        await robot.wait_for_detections(1)
        await robot.advance_s(1)
        robot.publish_picture(39, depth=False)
        await robot.advance_s(0.1)
        robot.publish_state(41)
        found = await robot.wait_for_detections(2)
        assert found.basis == 39
        assert found.things[0].position is None


async def test_a_hanging_net_is_no_progress_but_an_idle_one_is():
    async with running() as robot:
        progress = robot.recognition_bus.progress
        progress()
        assert progress()
        robot.net.go_on.clear()
        robot.publish_picture(40)
        await until(lambda: robot.net.pictures_seen == 1, "work")
        progress()
        await robot.advance_s(1)
        robot.publish_picture(41)
        await settle()
        assert not progress()
        robot.net.go_on.set()
        await robot.wait_for_detections(2)
        assert progress()


async def test_pictures_from_an_earlier_boot_are_ignored():
    async with running() as robot:
        about: dict[str, Any] = {"frame_id": "front", "width": 320, "height": 240}
        data = cv2.imencode(".jpg", TAG)[1].tobytes()
        robot.bus.time.boot = 3
        robot.bus.publish(IMAGE, Image(**about, encoding="jpeg", data=data), name="front")
        await settle()
        robot.publish_state(41)
        await settle()
        assert robot.net.pictures_seen == 0


async def test_no_work_starts_after_the_process_closed(caplog):
    async with running() as robot:
        robot.net.go_on.clear()
        robot.publish_picture(40)
        await until(lambda: robot.net.pictures_seen == 1, "work")
        await robot.advance_s(1)
        robot.publish_picture(41)
        await settle()
        robot.recognition.close()
        robot.net.go_on.set()
        await until(lambda: not robot.recognition._busy, "its end")
        await settle()
    assert robot.received == []
    assert robot.net.pictures_seen == 1
    assert caplog.records == []


async def test_an_error_of_the_net_ends_the_process():
    async with running() as robot:
        robot.net.find = lambda _: 1 / 0  # type: ignore[method-assign,return-value,assignment]
        robot.publish_picture(40)
        with pytest.raises(ZeroDivisionError):
            await asyncio.wait_for(robot.recognition.failed, 30)


def test_without_weights_only_tags_are_found_with_one_warning(caplog, monkeypatch):
    from gigabrain_zenoh.vision import nets

    monkeypatch.setattr(nets, "WEIGHTS", nets.WEIGHTS.with_name("none.onnx"))
    observer = make_observer(RecognitionConfig())
    assert len(caplog.records) == 1
    data = cv2.imencode(".jpg", TAG)[1].tobytes()
    picture = Image(frame_id="front", width=320, height=240, encoding="jpeg", data=data)
    found = observer.observe(CAMERA, picture, None)
    assert found.things == ()
    assert [tag.id for tag in found.tags] == [7]


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8"])
def test_raw_pictures_are_used_too(encoding):
    pixels = TAG if encoding == "mono8" else cv2.cvtColor(TAG, cv2.COLOR_GRAY2BGR)
    picture = Image(
        frame_id="front", width=320, height=240, encoding=encoding, data=pixels.tobytes()
    )
    found = Observer(BallNet(), TagFinder()).observe(CAMERA, picture, None)
    assert [tag.id for tag in found.tags] == [7]
    assert [thing.label for thing in found.things] == ["ball"]


def test_a_picture_of_another_camera_is_refused():
    picture = Image(frame_id="rear", width=320, height=240, encoding="mono8", data=TAG.tobytes())
    with pytest.raises(ValueError, match="rear"):
        Observer(BallNet(), TagFinder()).observe(CAMERA, picture, None)


async def test_the_classes_of_the_net_are_published_once_a_second():
    async with running() as robot:
        received: list[tuple[str, Labels]] = []
        robot.bus.subscribe(LABELS, lambda key, message: received.append((key, message)))
        for tick in (41, 90, 91, 140, 141):
            robot.publish_state(tick)
            await settle()
        assert [key for key, _ in received] == ["robot/labels/recognition"] * 2  # 40 was before
        labels = received[0][1].labels
        assert {"can", "person"} < set(labels)
        assert [message.tick for _, message in received] == [90, 140]


async def test_a_net_that_names_no_class_publishes_no_labels():
    """Otherwise decision would refuse the labels of any other recogniser."""
    async with running() as robot:
        received: list[Labels] = []
        robot.bus.subscribe(LABELS, lambda _key, message: received.append(message))
        robot.net.classes = ("",)
        robot.publish_state(90)
        await settle()
        assert received == []


def test_a_class_without_a_name_or_named_twice_is_published_once_or_never():
    net = BallNet()
    net.classes = ("can", "", "ball", "can")
    assert Observer(net, TagFinder()).labels == ("can", "ball")
    assert Observer(None, TagFinder()).labels == ()


async def test_pictures_of_a_camera_on_an_arm_are_ignored():
    arm = replace(CAMERA, name="wrist", link="hand", depth=False)
    async with running(CAMERA, arm) as robot:
        robot.publish_picture(basis=37, name="wrist", depth=False)
        robot.publish_picture(basis=38)
        assert (await robot.wait_for_detections(1)).camera == CAMERA.name


class BoxesNet(BallNet):
    """A net that finds given boxes, in the order of their confidence."""

    def __init__(self, *boxes: tuple[float, float, float, float]) -> None:
        super().__init__()
        self.boxes = np.array(boxes, np.float32)

    def find(self, picture: np.ndarray) -> Found:
        count = len(self.boxes)
        return Found(self.boxes, np.arange(count), np.linspace(0.9, 0.5, count, dtype=np.float32))


def observe(net: BallNet) -> Detections:
    data = cv2.imencode(".jpg", TAG)[1].tobytes()
    picture = Image(frame_id="front", width=320, height=240, encoding="jpeg", data=data)
    return Observer(net, TagFinder()).observe(CAMERA, picture, None)


def test_overlapping_boxes_keep_only_the_surest_class():
    found = observe(BoxesNet((20, 20, 60, 60), (22, 20, 61, 62), (40, 20, 80, 60)))
    assert [thing.label for thing in found.things] == ["cube", "cylinder"]


def test_the_plate_of_a_tag_is_no_thing_but_a_thing_before_it_is():
    (tag,) = observe(BoxesNet()).tags
    columns, rows = zip(*tag.corners, strict=True)
    plate = (min(columns) - 4, min(rows) - 4, max(columns) + 4, max(rows) + 4)
    before_the_tag = (min(columns), min(rows) + 20, min(columns) + 15, max(rows) + 30)
    found = observe(BoxesNet(plate, before_the_tag))
    assert [thing.label for thing in found.things] == ["ball"]


@pytest.mark.parametrize(("metres", "label"), [(0.8, "can"), (2.0, "robot")])
def test_a_thing_too_narrow_for_its_surest_class_gets_the_next_one(metres, label):
    class Net(BallNet):
        def find(self, picture: np.ndarray) -> Found:
            boxes = np.array([(150, 110, 175, 150)] * 2, np.float32)
            classes = np.array([CLASSES.index(one) for one in ("robot", "can")])
            return Found(boxes, classes, np.array((0.8, 0.5), np.float32))

    data = cv2.imencode(".jpg", TAG)[1].tobytes()
    picture = Image(frame_id="front", width=320, height=240, encoding="jpeg", data=data)
    pixels = np.full((240, 320), 1000 * metres + 500, np.uint16)
    pixels[110:150, 150:175] -= 500
    depth = DepthImage(frame_id="front", width=320, height=240, planes=pack_depth(pixels))
    (thing,) = Observer(Net(), TagFinder()).observe(CAMERA, picture, depth).things
    assert thing.label == label


@pytest.mark.parametrize(
    ("roll", "pitch"), [(0.1, 0.2), (1.5, 0.0), (-1.6, 0.2), (math.pi, 0.3), (0.0, 3.0)]
)
def test_the_net_gets_upright_pictures_for_any_mounting_of_the_camera(roll, pitch):
    camera = replace(CAMERA, roll=roll, pitch=pitch, yaw=0.0 if pitch < 2 else math.pi)
    model, pixels = CameraModel(camera), np.zeros((240, 320, 3), np.uint8)
    side, high = np.meshgrid(np.linspace(-0.05, 0.05, 90), np.linspace(0.0, 0.1, 90))
    for up, colour in ((0.0, (0, 0, 250)), (-0.1, (250, 0, 0))):  # red above blue
        ahead = np.full(side.size, 1.0)
        points = model.origin + np.column_stack((ahead, side.ravel(), high.ravel() + up))
        row, column, _ = model.project(points)
        pixels[row, column] = colour

    class Net(BallNet):
        def find(self, picture: np.ndarray) -> Found:
            red, blue = (np.argwhere(picture[..., one] > 200)[:, 0] for one in (0, 2))
            assert red.mean() < blue.mean() - 20
            rows, columns = np.nonzero(picture.any(axis=2))
            box = (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
            return Found(np.array([box], np.float32), np.array([1]), np.array([0.9], np.float32))

    picture = Image(frame_id="front", width=320, height=240, encoding="bgr8", data=pixels.tobytes())
    (thing,) = Observer(Net(), TagFinder()).observe(camera, picture, None).things
    rows, columns = np.nonzero(pixels.any(axis=2))
    assert thing.box == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)


def test_the_net_gets_rgb_pictures():
    received_pixels = []

    class Net(BallNet):
        def find(self, picture: np.ndarray) -> Found:
            received_pixels.append(picture[120, 160].tolist())
            return super().find(picture)

    red = np.full((240, 320, 3), (10, 20, 250), np.uint8)  # BGR
    picture = Image(frame_id="front", width=320, height=240, encoding="bgr8", data=red.tobytes())
    Observer(Net(), TagFinder()).observe(CAMERA, picture, None)
    assert received_pixels == [[250, 20, 10]]
