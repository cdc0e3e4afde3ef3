"""Remembered things compared with the true ones."""

import math
from pathlib import Path

import pytest

from gigabrain_drivers.sim.world_file import read_world
from gigabrain_schemas.base import Pose
from gigabrain_schemas.objects import MapObject
from gigabrain_zenoh.geometry.pose import compose, inverse
from gigabrain_zenoh.qa.bench.objects import CLASSES, HALF_M, THINGS, draw, judged, write

FRAME = Pose(x=1.0, y=-0.5, yaw=0.7)  # pose of the map in the world


def remembered(label: str, x: float, y: float) -> MapObject:
    """Return the map's object for a thing at a place in the world [m]."""
    at = compose(inverse(FRAME), Pose(x=x, y=y, yaw=0.0))
    return MapObject(id=1, label=label, x=at.x, y=at.y, z=0.1, size=(0.1, 0.1), confidence=0.9)


def test_a_thing_counts_only_with_its_class_and_place() -> None:
    placed, _ = draw(3)
    one, other = placed[0], placed[1]
    found, errors, false = judged(
        placed,
        [
            remembered(one.look.label, one.x + 0.03, one.y),
            remembered(one.look.label, one.x, one.y + 0.2),  # twice
            remembered("can", other.x, other.y),
            remembered(other.look.label, other.x + 0.31, other.y),
        ],
        FRAME,
    )
    assert found == (True, *[False] * (THINGS - 1))
    assert errors == (pytest.approx(0.03),)
    assert false == (one.look.label, "can", other.look.label)


@pytest.mark.parametrize("seed", range(4))
def test_worlds_can_be_loaded_and_have_room_to_drive(seed: int, tmp_path: Path) -> None:
    placed, course = draw(seed)
    assert {one.look.label for one in placed} == set(CLASSES)
    for x, y in course.goals:
        assert max(abs(x), abs(y)) < HALF_M - 0.4
        assert all(math.hypot(x - one.x, y - one.y) > 0.45 for one in placed)
    world = read_world(write(course, placed, tmp_path))
    assert (world.start.x, world.start.y) == (course.start.x, course.start.y)
