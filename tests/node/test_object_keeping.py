"""Perception keeps recognised objects with the map, and localizes the robot by tags."""

import asyncio
import functools
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera
from gigabrain_schemas.objects import (
    Detection,
    Detections,
    ObjectMap,
    ObjectsRequest,
    TagDetection,
)
from gigabrain_schemas.requests import PoseRequest
from gigabrain_schemas.topics import (
    BODY,
    DETECTIONS,
    MAP,
    OBJECT_MAP,
    OBJECTS_CHANGE,
    POSE,
    POSE_SET,
    SCAN,
    STATE,
    WORLD,
)
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.geometry.se2 import compose, inverse
from gigabrain_zenoh.mapping import map_file, object_file
from gigabrain_zenoh.mapping.object_file import ObjectFile
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.recording.process_replay import with_requests
from gigabrain_zenoh.runtime.replay import record, replay
from gigabrain_zenoh.testing.samples import ARMED, WAFFLE, WRIST, body, scan, state
from tests.node.mapping_robot import SLAM, Robot
from tests.node.test_zone_keeping import ask, newest_message
from tests.unit.mapping.houses import CORRIDOR, HOUSE, NICHE, Rooms, at, drawn

FRONT = Camera(
    name="front", width=320, height=240, rate_hz=10, field_of_view=1.047, depth=True, x=0.06, z=0.1
)
CORNERS = ((100.0, 100.0), (120.0, 100.0), (120.0, 80.0), (100.0, 80.0))
CAN = (1.5, 0.2, 0.06)  # [m] in the body's frame


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


class CameraRobot(Robot):
    """A robot with a camera that stands in a house or elsewhere; the test makes its detections."""

    def __init__(self, config: PerceptionConfig = SLAM, walls=HOUSE, pose: Floats | None = None):  # type: ignore[no-untyped-def]
        super().__init__(config)
        self.rooms = Rooms(walls)
        self.pose = at(3.0, 2.0, 90) if pose is None else pose  # the true one
        self.odometry = np.zeros(3)
        self.seq, self.camera = 0, "front"

    def publish_body(self) -> None:
        self.send(BODY, body(replace(WAFFLE, cameras=(FRONT,)), boot=self.boot))

    def publish_scans(
        self, scans: int = 1, *things: Detection, tags: tuple[TagDetection, ...] = ()
    ) -> None:
        for _ in range(scans):
            for _ in range(5):
                self.tick += 1
                x, y, yaw = self.odometry.tolist()
                self.send(STATE, state(self.tick, pose=(x, y, yaw), boot=self.boot))
            if things or tags:
                self.publish_detections(*things, tags=tags)
            self.send(SCAN, scan(self.rooms.ranges(self.pose), self.tick, boot=self.boot))

    def publish_detections(self, *things: Detection, tags: tuple[TagDetection, ...] = ()) -> None:
        self.seq += 1
        picture = Detections(
            camera=self.camera, width=320, height=240, things=things, tags=tags,
            boot=self.boot, tick=self.tick, basis=self.tick, seq=self.seq, stamp_ns=self.seq,
        )  # fmt: skip
        self.send(DETECTIONS, picture)

    async def look_and_search(self, scans: int, *things: Detection, tags=()) -> list[bool]:  # type: ignore[no-untyped-def]
        """Look for `scans` scans; return for each whether the robot was localized."""
        self.sent(POSE)
        for _ in range(scans):
            self.publish_scans(1, *things, tags=tags)
            await asyncio.sleep(0.005)  # searches run in a thread
        return [pose.localized for pose in self.sent(POSE)]

    def object_map(self) -> ObjectMap:
        return newest_message(self, OBJECT_MAP)


def can(x: float = CAN[0], y: float = CAN[1], label: str = "can") -> Detection:
    return Detection(
        label=label, confidence=0.9, box=(100, 100, 130, 140), position=(x, y, 0.06),
        size=(0.07, 0.12),
    )  # fmt: skip


def tag(pose: Floats, place: Floats, number: int = 7) -> TagDetection:
    """Return a tag at `place` (3,) as a robot at `pose` (3,) sees it."""
    x, y, yaw = compose(inverse(pose), place).tolist()
    return TagDetection(
        id=number, corners=CORNERS, size=0.16, position=(x, y, 0.4),
        orientation=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
    )  # fmt: skip


async def test_objects_are_published_saved_with_the_map_and_loaded_with_it() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(5)
        assert robot.object_map() == replace(robot.object_map(), objects=(), recognizing=False)
        robot.publish_scans(20, can(), tags=(tag(at(0, 0), at(2.0, 0.3, 180)),))
        now = robot.object_map()
        assert [(one.label, one.id) for one in now.objects] == [("can", 1)]
        assert (now.objects[0].x, now.objects[0].y) == pytest.approx(CAN[:2], abs=0.03)
        assert [(one.id, one.size) for one in now.tags] == [(7, 0.16)]
        assert (now.recognizing, now.map, now.boot) == (True, "", 7)
        assert (await robot.save("house")).ok
        robot.publish_scans(20)
        assert robot.object_map().map == "house"
    saved = object_file.load(map_file.saved_map_path("house"))
    assert [one.label for one in saved.objects] == ["can"]
    async with CameraRobot(PerceptionConfig(mapping="localize", map="house")) as robot:
        robot.publish_body()
        robot.publish_scans(3)
        now = robot.object_map()
        assert ([one.label for one in now.objects], now.map) == (["can"], "house")
        assert [one.id for one in now.tags] == [7]


async def test_a_robot_without_cameras_keeps_no_objects() -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20)
        assert DETECTIONS.at() not in robot.bus.listens
        assert not any(key == OBJECT_MAP.key for key, _ in robot.network.sent)
        assert (await robot.save("house")).ok
    assert not object_file.path_beside(map_file.saved_map_path("house")).exists()


async def test_detections_of_a_camera_on_an_arm_are_ignored() -> None:
    async with CameraRobot() as robot:
        robot.send(BODY, body(replace(ARMED, cameras=(FRONT, WRIST)), boot=robot.boot))
        robot.publish_scans(20, can())
        robot.camera = "wrist"
        there = tag(at(0, 0), at(2.0, 0.3, 180))
        robot.publish_scans(
            20, replace(can(1.2, -0.4, "box"), box=(200, 100, 240, 140)), tags=(there,)
        )
        (one,), tags = robot.object_map().objects, robot.object_map().tags
        assert (one.label, one.seen, tags) == ("can", 20, ())
        assert not robot.bus.counters["detections_left_out"]


async def test_objects_are_published_on_change_and_every_two_seconds() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(50)
        ticks = [one.tick for one in robot.sent(OBJECT_MAP)]
        assert ticks == [10, 110, 210]
        robot.publish_scans(20, can())
        ticks = [one.tick for one in robot.sent(OBJECT_MAP)]
        assert 2 <= len(ticks) <= 4
        assert min(b - a for a, b in itertools.pairwise(ticks)) >= 30


async def test_foreign_objects_are_replaced_at_the_next_scan() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(20, can())
        assert robot.sent(OBJECT_MAP)
        robot.send(OBJECT_MAP, ObjectMap(boot=robot.boot, tick=robot.tick))
        robot.publish_scans(1)
        assert [[one.label for one in sent.objects] for sent in robot.sent(OBJECT_MAP)] == [["can"]]
        robot.publish_scans(1)
        assert robot.sent(OBJECT_MAP) == []


async def test_a_can_no_longer_seen_is_forgotten_and_a_ball_out_of_view_is_kept() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(20, can(), can(-1.0, 0.0, "ball"))
        assert len(robot.object_map().objects) == 2
        robot.publish_scans(20, replace(can(1.2, -0.4, "box"), box=(200, 100, 240, 140)))
        assert sorted(one.label for one in robot.object_map().objects) == ["ball", "box"]


async def test_objects_and_tags_are_forgotten_on_request() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(
            20, can(), can(1.0, -0.3, "ball"), tags=(tag(at(0, 0), at(2.0, 0.3, 180)),)
        )
        reply = await ask(robot, OBJECTS_CHANGE, ObjectsRequest(ids=(1,), source="ann"))
        assert (reply.ok, reply.text) == (True, "forgot object 1")
        assert [one.label for one in robot.object_map().objects] == ["ball"]
        reply = await ask(robot, OBJECTS_CHANGE, ObjectsRequest(ids=(1,), tags=(9,)))
        assert reply.text == "no object 1, no tag 9; `gigabrain objects` lists what is known"
        reply = await ask(robot, OBJECTS_CHANGE, ObjectsRequest(everything=True))
        assert reply.text == "forgot 1 objects and 1 tags"
        assert robot.object_map().objects == ()


async def test_objects_outlive_perception_with_the_map(tmp_path: Path) -> None:
    config = PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))
    async with CameraRobot(config) as robot:
        robot.publish_body()
        async with asyncio.timeout(60):
            while (robot.bus.report().get("saves") or 0) < 1:  # type: ignore[operator]
                robot.publish_scans(1, can())
                await asyncio.sleep(0.002)
        robot.publish_scans(260, can())
        await asyncio.sleep(0.1)
        await robot.restart()
        await robot.ready()
        robot.publish_body()
        robot.publish_scans(5)
        assert [one.label for one in robot.object_map().objects] == ["can"]
        robot.boot, robot.tick = 8, 0  # after a restart of the driver the objects stay
        robot.publish_body()
        await robot.look_and_search(60)
        assert [one.label for one in robot.object_map().objects] == ["can"]


async def test_objects_found_in_a_saved_map_are_saved_beside_it() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(20)
        assert (await robot.save("house")).ok
    async with CameraRobot(PerceptionConfig(mapping="localize", map="house")) as robot:
        robot.publish_body()
        await robot.look_and_search(40)
        robot.publish_scans(20, can())
        assert [one.label for one in robot.object_map().objects] == ["can"]
    saved = object_file.load(map_file.saved_map_path("house"))
    assert [one.label for one in saved.objects] == ["can"]


@pytest.mark.parametrize(
    "content",
    [
        b"\x00\xff" * 100,
        b"[" * 100_000,
        b'{"version": 1, "objects": [{"id": 1}]}',
        b'{"version": 9}',
        b'{"version": 1, "objects": [], "tags": [], "more": 1}',
        json.dumps({"version": 1, "tags": [
            {"id": 1, "x": 0, "y": 0, "z": 0, "yaw": 0, "size": 0.1}] * 2}).encode(),
        b'{"version": 1, "objects": [' + b"1," * 200_000,
        b'{"version": 1, "tags": [{"id": 1, "x": NaN, "y": 0, "z": 0, "yaw": 0, "size": 0.1}]}',
    ],
)  # fmt: skip
async def test_a_hostile_objects_file_is_refused_in_one_line_and_not_overwritten(
    content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(20)
        assert (await robot.save("house")).ok
    path = object_file.path_beside(map_file.saved_map_path("house"))
    path.write_bytes(content)
    async with CameraRobot(PerceptionConfig(mapping="localize", map="house")) as robot:
        robot.publish_body()
        await robot.look_and_search(40)
        robot.publish_scans(20, can())
        assert [one.label for one in robot.object_map().objects] == ["can"]
        assert [one.code for one in robot.bus.problems] == ["objects_unsaved"]
    assert path.read_bytes() == content
    warnings = [one for one in caplog.messages if "objects.json" in one]
    assert len(warnings) == 1
    assert "\n" not in warnings[0]


async def test_floods_and_invalid_detections_do_not_harm_the_known_objects() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(20, can())
        crowd = tuple(can(0.5 + 0.01 * k, 0.3, f"thing{k}") for k in range(128))
        for _ in range(20):
            for _ in range(20):
                robot.publish_detections(*crowd)
            robot.publish_scans(1)
        robot.send(DETECTIONS, Detections(camera="back", width=90, height=90, boot=7, basis=1))
        future = Detections(camera="front", width=90, height=90, boot=7, basis=2**37)
        robot.send(DETECTIONS, future)
        robot.send(DETECTIONS, Detections(camera="front", width=90, height=90, boot=6, basis=5))
        robot.publish_scans(5)
        assert robot.bus.counters["detections_left_out"] > 200
        assert len(robot.object_map().objects) <= 256
        assert "can" in [one.label for one in robot.object_map().objects]


async def test_detections_repeated_from_one_picture_add_no_object() -> None:
    async with CameraRobot() as robot:
        robot.publish_body()
        robot.publish_scans(5)
        tick = robot.tick
        for _ in range(20):
            robot.publish_scans(1)
            robot.tick, now = tick, robot.tick
            robot.publish_detections(can())
            robot.tick = now
        robot.publish_scans(5)
        assert robot.object_map().objects == ()


CORRIDOR_WALLS = [*CORRIDOR, *NICHE]
TAG_PLACE = at(3.2, 0.7, 180)


def save_corridor(name: str = "corridor") -> None:
    """Save a map that looks the same from both ends, with a tag near its left end."""
    saved = drawn(Rooms(CORRIDOR_WALLS), *(at(x, y) for x in range(1, 16) for y in (0.7, 2.3)))
    path = map_file.saved_map_path(name)
    map_file.save(path, saved, {})
    from gigabrain_schemas.objects import MapTag

    x, y, yaw = TAG_PLACE.tolist()
    tags = (MapTag(id=7, x=x, y=y, z=0.4, yaw=yaw, size=0.16),)
    object_file.save(path, ObjectFile(tags=tags))


CORRIDOR_MAP = PerceptionConfig(mapping="localize", map="corridor")


async def localize(robot: CameraRobot) -> None:
    """Publish the true pose as an operator does, and wait until the robot is localized."""
    robot.publish_body()
    robot.publish_scans(2)
    x, y, yaw = robot.pose.tolist()
    assert (await ask(robot, POSE_SET, PoseRequest(x=x, y=y, yaw=yaw))).ok
    assert (await robot.look_and_search(10))[-1]


LEFT, RIGHT = at(1.5, 0.7), at(14.5, 2.3, 180)


async def test_a_tag_localizes_a_robot_between_two_alike_places_within_a_second() -> None:
    save_corridor()
    async with CameraRobot(CORRIDOR_MAP, CORRIDOR_WALLS, LEFT) as robot:
        robot.publish_body()
        assert not any(await robot.look_and_search(40))  # both ends look the same
        found = await robot.look_and_search(10, tags=(tag(robot.pose, TAG_PLACE),))
        assert found[-1]
        assert found.index(True) <= 5
        pose = newest_message(robot, POSE)
        assert (pose.x, pose.y, pose.yaw) == pytest.approx(tuple(LEFT), abs=0.05)


async def test_after_a_restart_of_the_driver_a_tag_localizes_a_moved_robot() -> None:
    save_corridor()
    async with CameraRobot(CORRIDOR_MAP, CORRIDOR_WALLS, LEFT) as robot:
        robot.publish_body()
        await robot.look_and_search(20, tags=(tag(robot.pose, TAG_PLACE),))
        robot.boot, robot.tick = 8, 0
        robot.publish_body()
        robot.pose = at(2.4, 0.7, 20)  # carried there meanwhile
        assert not any(await robot.look_and_search(40))
        found = await robot.look_and_search(10, tags=(tag(robot.pose, TAG_PLACE),))
        assert found[-1]
        pose = newest_message(robot, POSE)
        assert (pose.x, pose.y, pose.yaw) == pytest.approx(tuple(robot.pose), abs=0.05)


async def test_a_tag_localizes_a_kidnapped_robot_within_a_second() -> None:
    save_corridor()
    async with CameraRobot(CORRIDOR_MAP, CORRIDOR_WALLS, at(7.5, 0.8)) as robot:
        await localize(robot)
        robot.pose = LEFT  # without odometry
        found = await robot.look_and_search(10, tags=(tag(robot.pose, TAG_PLACE),))
        assert found[-1]
        pose = newest_message(robot, POSE)
        assert (pose.x, pose.y, pose.yaw) == pytest.approx(tuple(LEFT), abs=0.05)
        assert [one.x for one in robot.object_map().tags] == [pytest.approx(TAG_PLACE[0], abs=0.02)]


async def test_a_moved_tag_does_not_move_a_localized_robot_and_gets_its_new_place() -> None:
    save_corridor()
    async with CameraRobot(CORRIDOR_MAP, CORRIDOR_WALLS, at(7.0, 0.8)) as robot:
        await localize(robot)
        moved = at(9.0, 0.9, 180)
        found = await robot.look_and_search(60, tags=(tag(robot.pose, moved),))
        assert all(found)
        pose = newest_message(robot, POSE)
        assert (pose.x, pose.y) == pytest.approx((7.0, 0.8), abs=0.03)
        assert [one.x for one in robot.object_map().tags] == [pytest.approx(9.0, abs=0.03)]


async def test_an_operator_can_set_the_pose() -> None:
    save_corridor()
    async with CameraRobot(CORRIDOR_MAP, CORRIDOR_WALLS, RIGHT) as robot:
        robot.publish_body()
        assert not any(await robot.look_and_search(40))
        reply = await ask(robot, POSE_SET, PoseRequest(x=14.3, y=2.2, yaw=math.pi, source="ann"))
        assert (reply.ok, reply.text) == (True, "looking for the robot round (14.30, 2.20)")
        found = await robot.look_and_search(6)
        assert found[-1]
        pose = newest_message(robot, POSE)
        assert (pose.x, pose.y) == pytest.approx((14.5, 2.3), abs=0.05)


async def test_a_wrong_pose_from_an_operator_does_not_move_a_localized_robot() -> None:
    save_corridor()
    async with CameraRobot(CORRIDOR_MAP, CORRIDOR_WALLS, at(7.5, 0.8)) as robot:
        robot.publish_body()
        reply = await ask(robot, POSE_SET, PoseRequest(x=1e5, y=-1e5))
        assert reply.text == "no map and no scan yet; try again in a moment"
        await localize(robot)
        assert (await ask(robot, POSE_SET, PoseRequest(x=1e5, y=-1e5, yaw=1e6))).ok
        assert (await robot.look_and_search(60))[-1]
        pose = newest_message(robot, POSE)
        assert (pose.x, pose.y) == pytest.approx((7.5, 0.8), abs=0.1)


async def test_a_replay_publishes_the_same_objects(tmp_path: Path) -> None:
    config = PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))
    keys = (OBJECT_MAP.key, POSE.key, MAP.key, WORLD.key)
    async with CameraRobot(config) as robot:
        events = record(robot.network, robot.clock)
        robot.publish_body()
        robot.publish_scans(20, can(), tags=(tag(at(0, 0), at(2.0, 0.3, 180)),))
        await ask(robot, OBJECTS_CHANGE, ObjectsRequest(ids=(1,)))
        robot.publish_scans(20, can())
        await ask(robot, POSE_SET, PoseRequest(x=0.1, y=0.0, yaw=0.1))
        robot.publish_scans(20, can(1.0, 0.0))
        recorded = list(robot.network.sent)
    received = with_requests([event for event in events if event[1] not in keys])
    now = await replay(functools.partial(perception.run, config), received, "node")
    assert objects_of(now) == objects_of(recorded)
    assert len(objects_of(recorded)) > 3


def objects_of(sent: list[tuple[str, bytes]]) -> list[ObjectMap]:
    codec = Codec(ObjectMap, OBJECT_MAP.max_bytes)
    found = [codec.decode(data) for key, data in sent if key == OBJECT_MAP.key]
    return [replace(one, stamp_ns=0) for one in found]
