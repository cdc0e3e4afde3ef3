"""Tags: their places in the map are averaged, and known ones give pose hints."""

import math

import numpy as np
import pytest

from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.objects import Detections, TagDetection
from gigabrain_zenoh.geometry.se2 import compose, inverse
from gigabrain_zenoh.perception.object_memory import Glance
from gigabrain_zenoh.perception.tag_memory import TagMemory, face_yaw
from tests.unit.perception.test_object_memory import FRONT, NOTHING, WELL

CORNERS = ((100.0, 100.0), (120.0, 100.0), (120.0, 80.0), (100.0, 80.0))
WALL = np.array((3.0, 0.5, math.pi))  # place of the tag, which faces the robot


def tag(pose: Floats, place: Floats = WALL, number: int = 7) -> TagDetection:
    """Return a detection of a tag at `place` (3,) in the map, from `pose` (3,)."""
    x, y, yaw = compose(inverse(pose), place).tolist()
    return TagDetection(
        id=number, corners=CORNERS, size=0.16, position=(x, y, 0.4),
        orientation=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
    )  # fmt: skip


class Eye:
    def __init__(self) -> None:
        self.tags, self.pose, self.time_s, self.spread = TagMemory(), np.zeros(3), 0.0, WELL

    def look(self, *tags: TagDetection, pictures: int = 1) -> None:
        for _ in range(pictures):
            self.time_s += 0.1
            seen = Detections(camera="front", width=320, height=240, tags=tags)
            self.tags.look(
                Glance(
                    detections=seen,
                    camera=FRONT,
                    pose=self.pose,
                    spread=self.spread,
                    hits=NOTHING,
                    time_s=self.time_s,
                    unix_ns=1,
                )
            )


def test_a_tag_enters_the_map_with_its_averaged_pose() -> None:
    eye, random = Eye(), np.random.default_rng(2)
    for _ in range(40):
        off = random.normal(0, (0.04, 0.04, 0.08))
        eye.look(tag(eye.pose, WALL + off))
    (one,) = eye.tags.tags()
    assert (one.id, one.size) == (7, 0.16)
    assert (one.x, one.y, one.z) == pytest.approx((3.0, 0.5, 0.4), abs=0.03)
    assert math.cos(one.yaw - math.pi) > 0.998


def test_a_poorly_localized_robot_learns_no_tags() -> None:
    eye = Eye()
    eye.spread = np.diag((0.3, 0.3, 0.05)) ** 2
    eye.look(tag(eye.pose), pictures=20)
    assert eye.tags.tags() == ()


def test_a_known_tag_gives_a_pose_hint() -> None:
    eye = Eye()
    eye.look(tag(eye.pose), pictures=5)
    there = np.array((2.0, 1.2, -0.6))
    hint = eye.tags.hint([tag(there)])
    assert hint is not None
    assert hint.pose == pytest.approx(there, abs=0.01)
    deviations = np.sqrt(np.diag(hint.covariance))
    assert 0.05 < deviations[2] < 0.3
    assert eye.tags.hint([tag(there, number=8)]) is None


def test_a_moved_tag_is_learnt_again_after_some_seconds() -> None:
    eye, moved = Eye(), np.array((2.5, -1.0, 2.5))
    eye.look(tag(eye.pose), pictures=30)
    eye.look(tag(eye.pose, moved), pictures=25)
    assert eye.tags.tags()[0].x == pytest.approx(3.0, abs=0.01)
    eye.look(tag(eye.pose, moved), pictures=10)
    assert eye.tags.tags()[0].x == pytest.approx(2.5, abs=0.01)


def test_a_robot_that_was_carried_away_does_not_move_its_tags() -> None:
    eye = Eye()
    eye.look(tag(eye.pose), pictures=30)
    for _ in range(10):
        eye.look(tag(np.array((5.0, 5.0, 1.0))), pictures=5)  # its pose is still the origin
        eye.tags.doubt()  # as the scan shows
    assert eye.tags.tags()[0].x == pytest.approx(3.0, abs=0.01)


def test_a_tag_that_was_removed_is_forgotten_when_its_place_is_seen() -> None:
    eye = Eye()
    eye.pose = np.array((1.6, 0.5, 0.0))
    eye.look(tag(eye.pose), pictures=10)
    eye.pose = np.array((1.6, 0.5, math.pi))
    eye.look(pictures=50)
    assert len(eye.tags.tags()) == 1
    eye.pose = np.array((1.6, 0.5, 0.0))
    eye.look(pictures=10)
    assert eye.tags.tags() == ()


def test_a_tag_on_the_floor_and_one_without_an_orientation_have_no_face() -> None:
    lying = (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5))  # it faces upwards
    assert face_yaw(replace_orientation(lying)) is None
    assert face_yaw(replace_orientation((0.0, 0.0, 0.0, 0.0))) is not None  # treated as not rotated
    eye = Eye()
    eye.look(replace_orientation(lying), pictures=9)
    assert eye.tags.tags() == ()


def replace_orientation(orientation: tuple[float, float, float, float]) -> TagDetection:
    return TagDetection(
        id=1, corners=CORNERS, size=1e5, position=(1.0, 0.0, 0.3), orientation=orientation
    )


def test_memory_of_tags_is_bounded_and_keeps_confirmed_ones() -> None:
    eye = Eye()
    eye.look(tag(eye.pose), pictures=10)
    for k in range(20):
        eye.look(*(tag(eye.pose, number=1000 * k + i) for i in range(8, 72)), pictures=1)
    assert [one.id for one in eye.tags.tags()] == [7]
    far = TagDetection(
        id=5, corners=CORNERS, size=0.1, position=(1e5, -1e5, 1e5), orientation=(0, 0, 0, 1)
    )
    eye.look(far, pictures=9)
    assert [one.id for one in eye.tags.tags()] == [7]
