"""Recognised things become objects in the map; missing ones are forgotten."""

import math

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.body import Camera
from gigabrain_schemas.objects import Detection, Detections, MapObject, MapTag, ObjectMap
from gigabrain_schemas.topics import OBJECT_MAP
from gigabrain_zenoh import codec
from gigabrain_zenoh.geometry.se2 import inverse, transform
from gigabrain_zenoh.mapping import object_file
from gigabrain_zenoh.mapping.object_file import ObjectFile
from gigabrain_zenoh.perception.object_memory import Anchor, Glance, ObjectMemory, carried

FRONT = Camera(
    name="front", width=320, height=240, rate_hz=10, field_of_view=1.047, depth=True,
    x=0.06, z=0.1,
)  # fmt: skip
NOTHING: Floats = np.empty((0, 2))
WELL = np.diag((0.01, 0.01, 0.005)) ** 2
CAN = (2.0, 0.3, 0.06)


class Eye:
    """A robot that recognises things with noise."""

    def __init__(self, seed: int = 3, noise: float = 0.0) -> None:
        self.memory, self.pose, self.time_s = ObjectMemory(), np.zeros(3), 0.0
        self.hits = NOTHING
        self._random, self._noise = np.random.default_rng(seed), noise

    def look(self, *things: tuple[str, tuple[float, float, float]], pictures: int = 1) -> None:
        for _ in range(pictures):
            self.time_s += 0.1
            self.memory.look(self.glance(*things))

    def glance(self, *things: tuple[str, tuple[float, float, float]]) -> Glance:
        found = []
        for label, place in things:
            x, y = transform(inverse(self.pose), np.array((place[:2],)))[0].tolist()
            off = self._random.normal(0, self._noise, 3) if self._noise else np.zeros(3)
            found.append(
                Detection(
                    label=label,
                    confidence=0.8,
                    box=(150, 110, 170, 130),
                    position=(x + off[0], y + off[1], place[2] + off[2]),
                    size=(0.07, 0.12),
                )
            )
        return Glance(
            detections=Detections(camera="front", width=320, height=240, things=tuple(found)),
            camera=FRONT, pose=self.pose, spread=WELL, hits=self.hits, time_s=self.time_s,
            unix_ns=1,
        )  # fmt: skip

    @property
    def labels(self) -> list[str]:
        return [one.label for one in self.memory.objects()]


@pytest.mark.long
@pytest.mark.parametrize("noise", [0.03, 0.05])
@pytest.mark.parametrize("distance", [0.8, 2.0])
def test_after_ten_pictures_an_object_is_within_5_cm(noise: float, distance: float) -> None:
    errors = []
    for seed in range(60):
        eye = Eye(seed, noise)
        place = (distance, 0.1, 0.06)
        eye.look(("can", place), pictures=10)
        (one,) = eye.memory.objects()
        errors.append(math.hypot(one.x - place[0], one.y - place[1]))
        eye.look(("can", place), pictures=100)
        (one,) = eye.memory.objects()
        assert math.hypot(one.x - place[0], one.y - place[1]) < 0.05
    assert np.percentile(errors, 95) < 0.05


def test_the_class_is_the_one_seen_from_farther_away() -> None:
    eye = Eye()
    eye.look(("can", (0.7, 0.0, 0.06)), pictures=10)
    eye.pose = np.array((0.4, 0.0, 0.0))
    eye.look(("cylinder", (0.7, 0.0, 0.06)), pictures=100)
    assert eye.labels == ["can"]


def test_a_single_glimpse_is_no_object() -> None:
    eye = Eye()
    eye.look(("can", CAN), pictures=2)
    assert eye.labels == []
    eye.look(pictures=22)
    eye.look(("can", CAN), pictures=2)
    assert eye.labels == []
    eye.look(("can", CAN), pictures=1)
    assert eye.labels == ["can"]


def test_a_thing_in_one_of_ten_pictures_is_an_object() -> None:
    eye = Eye()
    for _ in range(3):
        assert eye.labels == []
        eye.look(pictures=9)
        eye.look(("can", (2.4, 0.1, 0.06)))
    assert eye.labels == ["can"]


def test_an_object_that_was_taken_away_is_forgotten_when_its_place_is_seen() -> None:
    eye = Eye()
    eye.look(("can", CAN), pictures=20)
    eye.look(pictures=3)
    assert eye.labels == ["can"]  # not at once: a network misses things
    eye.look(pictures=5)
    assert eye.labels == []


@pytest.mark.parametrize(
    ("pose", "hits"),
    [
        ((0.0, 0.0, math.pi), NOTHING),  # behind the robot
        ((-3.0, 0.0, 0.0), NOTHING),  # far away
        ((0.0, 0.0, 0.0), np.array(((1.0, 0.15), (1.0, 0.16)))),  # a person stands in front of it
        ((1.85, 0.3, 0.0), NOTHING),  # below the picture
    ],
)
def test_an_object_that_cannot_be_seen_is_kept(
    pose: tuple[float, float, float], hits: Floats
) -> None:
    eye = Eye()
    eye.look(("can", CAN), pictures=20)
    eye.pose, eye.hits = np.array(pose), hits
    eye.look(pictures=300)
    assert eye.labels == ["can"]


def test_an_object_behind_another_one_in_the_picture_is_kept() -> None:
    eye = Eye()
    behind, before = (2.2, 0.0, 0.06), (1.0, 0.0, 0.06)
    eye.look(("can", behind), pictures=20)
    eye.look(("box", before), pictures=30)  # its box covers the middle of the picture
    assert sorted(eye.labels) == ["box", "can"]


def test_while_the_robot_turns_fast_nothing_is_forgotten() -> None:
    eye = Eye()
    eye.look(("can", CAN), pictures=20)
    for _ in range(30):
        eye.time_s += 0.1
        glance = eye.glance()
        eye.memory.look(Glance(**{**glance.__dict__, "steady": False}))
    assert eye.labels == ["can"]


def test_people_and_robots_are_tracked_and_soon_forgotten() -> None:
    eye = Eye()
    for k in range(15):
        eye.look(("person", (1.5 + 0.08 * k, 0.0, 0.9)))
    (one,) = eye.memory.objects()
    assert one.x == pytest.approx(1.5 + 0.08 * 14, abs=0.1)
    eye.pose = np.array((0.0, 0.0, math.pi))
    eye.look(pictures=35)
    assert eye.labels == []
    assert eye.memory.anchored() == []


def test_two_things_side_by_side_are_two_and_one_thing_is_one() -> None:
    eye = Eye(noise=0.04)
    for _ in range(60):
        eye.look(("can", CAN), ("can", (2.0, 0.6, 0.06)), ("ball", (1.5, -0.3, 0.05)))
    assert sorted(eye.labels) == ["ball", "can", "can"]


def test_a_can_that_is_sometimes_recognised_as_a_cylinder_is_a_can() -> None:
    eye = Eye(noise=0.02)
    for k in range(30):
        eye.look(("cylinder" if k % 3 == 1 else "can", CAN))
    assert eye.labels == ["can"]


def test_a_thing_that_was_pushed_is_found_at_its_new_place() -> None:
    eye = Eye(noise=0.02)
    eye.look(("can", CAN), pictures=30)
    eye.look(("can", (2.0, 0.45, 0.06)), pictures=60)
    (one,) = eye.memory.objects()
    assert (one.x, one.y) == pytest.approx((2.0, 0.45), abs=0.05)


def test_objects_move_with_the_keyframes_of_their_map() -> None:
    eye = Eye()
    eye.look(("can", CAN), pictures=5)
    poses = np.array(((0.0, 0.0, 0.0), (1.5, 0.0, 0.0)))
    eye.memory.follow(poses)
    poses = np.array(
        ((0.0, 0.0, 0.0), (1.5, 0.5, math.pi / 2))
    )  # a loop closure turns it to the left
    eye.memory.follow(poses)
    (one,) = eye.memory.objects()
    assert (one.x, one.y) == pytest.approx((1.5 - 0.3, 0.5 + 0.5), abs=0.01)
    assert eye.memory.anchored()[0][1].keyframe == 1  # type: ignore[union-attr]


def test_a_position_turns_with_its_keyframe() -> None:
    tag = np.array((1.0, 0.0, 0.5, 3.0))
    moved, anchor = carried(tag, Anchor(0, np.zeros(3)), np.array(((0.0, 0.0, 0.3),)))
    assert moved[3] == pytest.approx(3.3 - math.tau)
    assert anchor is not None
    same, _ = carried(moved, anchor, np.array(((0.0, 0.0, 0.3),)))
    assert same is moved


def test_a_restored_memory_continues_with_the_same_ids() -> None:
    eye = Eye()
    eye.look(("can", CAN), ("box", (1.0, 0.0, 0.1)), pictures=20)
    other = Eye()
    other.memory.restore(eye.memory.anchored())
    assert other.memory.objects() == eye.memory.objects()
    other.look(("ball", (1.2, -0.3, 0.05)), pictures=5)
    assert [one.id for one in other.memory.objects()] == [1, 2, 3]
    assert other.memory.forget([2, 9]) == [2]
    assert other.labels == ["can", "ball"]


@pytest.mark.slow
def test_memory_is_bounded_and_keeps_confirmed_objects() -> None:
    eye = Eye()
    eye.look(("can", CAN), pictures=20)
    random = np.random.default_rng(1)
    for k in range(100):
        eye.time_s += 0.01
        things = tuple(
            Detection(
                label=f"thing {k} {i}" * 3,
                confidence=float(random.random()),
                box=(0, 0, 320, 240),
                size=(1e5, 1e5),
                position=tuple(random.uniform(-1, 1, 3) * 10 ** random.uniform(-2, 5)),
            )
            for i in range(128)
        )
        glance = eye.glance()
        crowded = Detections(camera="front", width=320, height=240, things=things)
        eye.memory.look(Glance(**{**glance.__dict__, "detections": crowded}))
    assert "can" in eye.labels
    assert len(eye.memory.objects()) <= 256
    assert all(abs(one.x) < 9 and max(one.size) <= 5 for one in eye.memory.objects())


def test_a_detection_without_a_position_is_no_object() -> None:
    eye = Eye()
    blind = Detection(label="can", confidence=1.0, box=(0, 0, 9, 9))
    for _ in range(9):
        glance = eye.glance()
        unplaced = Detections(camera="front", width=320, height=240, things=(blind,))
        eye.memory.look(Glance(**{**glance.__dict__, "detections": unplaced}))
    assert eye.labels == []


def test_the_maximum_of_objects_and_tags_fits_into_a_message_and_a_file() -> None:
    things = tuple(
        MapObject(
            id=2**63 - 1 - k,
            label='"' * 64 if k % 2 else "\u00e4" * 48,
            x=-1e5 + 0.001,
            y=1e5 - 0.001,
            z=0.123,
            size=(1.234, 5.678),
            confidence=0.982,
            seen=2**62,
            last_seen_ns=2**62,
        )
        for k in range(256)
    )
    tags = tuple(
        MapTag(
            id=10**6 - k,
            x=-1e5 + 0.001,
            y=1e5 - 0.001,
            z=0.123,
            yaw=3.1415,
            size=0.1234,
            seen=2**62,
            last_seen_ns=2**62,
        )
        for k in range(256)
    )
    message = ObjectMap(objects=things, tags=tags, map="m" * 64, recognizing=True)
    assert len(codec.encode(message)) < OBJECT_MAP.max_bytes
    assert len(object_file.encoded(ObjectFile(objects=things, tags=tags))) < object_file.MAX_BYTES
