"""Things near an arm over several pictures: medians, moved things and missing things."""

import math

import pytest

from gigabrain_schemas.base import Pose
from gigabrain_schemas.objects import SeenSolid
from gigabrain_zenoh.geometry.pose import ORIGIN
from gigabrain_zenoh.perception.solid_memory import KEPT_S, MAX_MISSES, MAX_SOLIDS, SolidMemory
from gigabrain_zenoh.vision.solid_fit import SolidFit


def box(x: float, y: float, yaw: float = 0.0, long: float = 0.03) -> SolidFit:
    return SolidFit("box", (long, 0.02, 0.03), (x, y, 0.015), yaw, 0.0)


def can(x: float, y: float) -> SolidFit:
    return SolidFit("cylinder", (0.033, 0.115), (x, y, 0.0575), 0.0, 0.0)


def looked(memory: SolidMemory, *fits: SolidFit, tick: int = 1, gone: bool = False) -> None:
    memory.look(fits, ORIGIN, tick, lambda _: gone)


def only(memory: SolidMemory, pose: Pose = ORIGIN, tick: int = 1) -> SeenSolid:
    (one,) = memory.solids(pose, tick)
    return one


def test_a_thing_is_confirmed_by_its_second_picture_and_has_the_median_fit() -> None:
    memory = SolidMemory()
    looked(memory, box(0.200, 0.1), tick=1)
    assert memory.solids(ORIGIN, 1) == ()
    for tick, x in enumerate((0.202, 0.215, 0.201, 0.203), start=2):
        looked(memory, box(x, 0.1), tick=tick)
    assert only(memory).position == pytest.approx((0.202, 0.1, 0.015))
    assert only(memory).seen == 5
    assert only(memory, tick=55).age == pytest.approx(1.0)


def test_two_things_side_by_side_keep_their_ids() -> None:
    memory = SolidMemory()
    for tick, first in enumerate((box(0.2, 0.0), box(0.201, 0.0), box(0.199, 0.0)), start=1):
        looked(memory, *((first, can(0.2, 0.06)) if tick % 2 else (can(0.2, 0.06), first)))
    near, far = memory.solids(ORIGIN, 3)
    assert (near.id, near.shape, far.id, far.shape) == (2, "box", 3, "cylinder")


def test_a_thing_that_was_moved_gets_its_new_position() -> None:
    memory = SolidMemory()
    for tick in range(1, 6):
        looked(memory, can(0.2, 0.0), tick=tick)
    looked(memory, can(0.226, 0.0), tick=6)
    assert only(memory).position[0] == pytest.approx(0.226)
    assert only(memory).id == 2


def test_a_thing_that_is_seen_through_is_forgotten_and_a_hidden_one_is_kept() -> None:
    memory = SolidMemory()
    for tick in (1, 2):
        looked(memory, can(0.2, 0.0), tick=tick)
    for tick in range(3, 30):
        looked(memory, tick=tick)
    assert only(memory).age == 0.0
    for tick in range(30, 30 + MAX_MISSES):
        looked(memory, tick=tick, gone=True)
    assert memory.solids(ORIGIN, 40) == ()


@pytest.mark.long
def test_old_things_are_forgotten_and_their_number_is_bounded() -> None:
    memory = SolidMemory()
    for tick in (1, 2):
        looked(memory, *(can(0.1 * k, 1.0) for k in range(MAX_SOLIDS + 20)), tick=tick)
    assert len(memory.solids(ORIGIN, 2)) == MAX_SOLIDS
    looked(memory, tick=3 + round(KEPT_S * 50))
    assert memory.solids(ORIGIN, 3) == ()


def test_things_are_published_in_the_frame_of_a_body_that_drove_on() -> None:
    memory = SolidMemory()
    before, there = Pose(x=1.0, y=2.0, yaw=math.pi / 2), Pose(x=1.0, y=2.2, yaw=math.pi)
    for tick in (1, 2):
        memory.look([box(0.3, 0.1, yaw=0.2)], before, tick, lambda _: False)
    seen = only(memory, there)
    assert seen.position == pytest.approx((0.1, -0.1, 0.015))
    assert math.remainder(seen.yaw - (0.2 - math.pi / 2), math.pi / 2) == pytest.approx(0.0)


def test_yaws_of_a_box_a_quarter_turn_apart_are_the_same() -> None:
    memory = SolidMemory()
    for tick, yaw in enumerate((0.78, -0.79, 0.77, -0.78), start=1):
        looked(memory, box(0.2, 0.0, yaw, long=0.02), tick=tick)
    off = math.remainder(only(memory).yaw - math.pi / 4, math.pi / 2)
    assert abs(off) < 0.02


def test_the_label_is_the_class_with_the_most_recent_confidence() -> None:
    memory = SolidMemory()
    for tick in (1, 2):
        looked(memory, can(0.3, 0.0), box(0.5, 0.2), tick=tick)
    for label, confidence, pictures in (("cube", 1.0, 90), ("can", 0.9, 25), ("cylinder", 0.5, 35)):
        for _ in range(pictures):
            memory.name(label, confidence, (0.32, 0.01), 0.6, ORIGIN)
    memory.name("cube", 1.0, (0.9, 0.9), 0.6, ORIGIN)  # nothing is tracked there
    near, far = memory.solids(ORIGIN, 2)
    assert (near.label, far.label) == ("can", "")


def test_a_class_seen_from_farther_away_outlasts_many_near_pictures() -> None:
    memory = SolidMemory()
    for tick in (1, 2):
        looked(memory, can(0.3, 0.0), tick=tick)
    memory.name("cube", 1.0, (0.3, 0.0), 0.2, ORIGIN)
    assert only(memory).label == "cube"  # it was only seen from near so far
    for _ in range(6):
        memory.name("can", 0.6, (0.3, 0.0), 0.6, ORIGIN)
    for _ in range(200):
        memory.name("cylinder", 1.0, (0.3, 0.0), 0.2, ORIGIN)
    assert only(memory).label == "can"


def test_a_new_track_gets_classes_recognised_before_it_could_be_fitted() -> None:
    memory = SolidMemory()
    memory.name("can", 0.8, (0.9, 0.0), 0.75, ORIGIN)
    memory.name("box", 0.8, (0.9, 0.3), 0.75, ORIGIN)
    nearer = Pose(x=0.5, y=0.0, yaw=0.0)
    for tick in (1, 2):
        memory.look([can(0.4, 0.02)], nearer, tick, lambda _: False)
    memory.name("cylinder", 1.0, (0.4, 0.02), 0.25, nearer)
    assert only(memory, nearer).label == "can"


def test_a_class_without_a_fit_gives_no_thing() -> None:
    memory = SolidMemory()
    memory.name("can", 0.9, (0.3, 0.0), 0.6, ORIGIN)
    assert memory.solids(ORIGIN, 1) == ()


def test_ids_are_not_reused_after_a_restart_of_perception() -> None:
    before, after = SolidMemory(), SolidMemory()
    for tick in (100, 105):
        looked(before, can(0.2, 0.0), box(0.3, 0.1), tick=tick)
    for tick in (500, 505):
        looked(after, box(0.3, 0.1), tick=tick)
    assert only(after).id not in {one.id for one in before.solids(ORIGIN, 105)}
