"""The decision node searches for objects and tags, and drives to them."""

import math
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import Camera
from gigabrain_schemas.objects import Labels, MapObject, MapTag, ObjectMap
from gigabrain_schemas.tasks import GoalRequest, MissionRequest
from gigabrain_schemas.topics import GOAL, LABELS, MISSION, OBJECT_MAP, ZONES
from gigabrain_schemas.zones import Place, Zones
from gigabrain_zenoh.testing.samples import ARMED, WAFFLE, WRIST
from tests.node.plane import CELL, Plane, drawn

FLAT = drawn(
    """
################################
#..............#...............#
#..............#...............#
#..............#...............#
#..............#...............#
#..............................#
#..............................#
#..............#...............#
#..............#...............#
#..............#...............#
#..............#...............#
################################
"""
)  # 8 x 3 m with two rooms
CAMERA = Camera(name="front", width=320, height=240, field_of_view=1.047, depth=True)
SIGHT_M, HALF_VIEW = 2.5, 0.45


class CameraPlane(Plane):
    """A body with a camera; it publishes the objects in its view, as perception does."""

    def __init__(self, *things: MapObject, tags: tuple[MapTag, ...] = (), **more: Any) -> None:
        super().__init__(FLAT, **more)
        self.description = replace(WAFFLE, cameras=(CAMERA,))
        self.things, self.tags = list(things), list(tags)
        self.found: dict[int, MapObject] = {}
        self.recognizing, self.knows_tags = True, True
        self.labels: dict[str, tuple[str, ...]] = {}  # of each process that publishes its own

    async def _tick(self) -> None:
        for one in self.things:
            if self._sees(one.x, one.y):
                self.found[one.id] = one
        for number in [one for one in self.found if not self._is_present(one)]:
            gone = self.found[number]
            if self._sees(gone.x, gone.y):
                del self.found[number]
        await super()._tick()
        if self.tick % 50 == 7:
            message = ObjectMap(
                objects=tuple(self.found.values()), recognizing=self.recognizing,
                tags=tuple(self.tags) if self.knows_tags else (),
                boot=self.boot, tick=self.tick, basis=self.tick,
            )  # fmt: skip
            self.bench.send(OBJECT_MAP, message)
            for process, labels in self.labels.items():
                own = Labels(labels=labels, boot=self.boot, tick=self.tick)
                self.bench.send(LABELS, own, name=process)

    def _is_present(self, number: int) -> bool:
        return any(one.id == number for one in self.things)

    def _sees(self, x: float, y: float) -> bool:
        distance = math.hypot(x - self.x, y - self.y)
        turn = math.remainder(math.atan2(y - self.y, x - self.x) - self.yaw, math.tau)
        steps = [k / 40 for k in range(40)]
        way = [(self.x + s * (x - self.x), self.y + s * (y - self.y)) for s in steps]
        clear = all(self.cells[int(b / CELL), int(a / CELL)] != 100 for a, b in way)
        return distance < SIGHT_M and abs(turn) < HALF_VIEW and clear

    def distance_and_bearing(self, x: float, y: float) -> tuple[float, float]:
        turn = math.remainder(math.atan2(y - self.y, x - self.x) - self.yaw, math.tau)
        return math.hypot(x - self.x, y - self.y), abs(turn)


def map_object(number: int, x: float, y: float, label: str = "can") -> MapObject:
    return MapObject(id=number, label=label, x=x, y=y, z=0.06, size=(0.07, 0.12), confidence=0.9)


async def test_it_drives_to_a_known_can_and_faces_it() -> None:
    async with CameraPlane(map_object(3, 2.8, 1.2)) as plane:
        await plane.go(2.0)
        reply = await plane.ask(GOAL, GoalRequest(object="can"))
        assert reply.text == "goal-1: can 3 is at (2.80, 1.20)"
        await plane.until("succeeded", seconds=60)
        distance, turn = plane.distance_and_bearing(2.8, 1.2)
        assert 0.25 < distance < 0.5
        assert turn < 0.25
        assert plane.status.done[0].reason.endswith("in front of can 3")


async def test_it_searches_the_next_room_for_a_can() -> None:
    async with CameraPlane(map_object(3, 7.2, 0.6)) as plane:
        await plane.go(0.5)
        reply = await plane.ask(GOAL, GoalRequest(object="can"))
        assert reply.text == "goal-1: a can is not known yet; looking for it"
        await plane.until("succeeded", seconds=240)
        assert plane.distance_and_bearing(7.2, 0.6)[0] < 0.6


@pytest.mark.slow
async def test_a_search_fails_after_looking_everywhere() -> None:
    async with CameraPlane(map_object(3, 2.8, 1.2, "ball")) as plane:
        await plane.go(0.5)
        request = MissionRequest(mission="do: [{find: can}]")
        assert (await plane.ask(MISSION, request)).ok
        await plane.until("failed", seconds=400)
        reason = "a can was not found: everything reachable was seen"
        assert plane.status.done[0].reason == reason
        assert plane.travelled > 3.0


async def test_it_drives_to_a_tag_and_faces_it() -> None:
    tag = MapTag(id=7, x=7.7, y=2.0, z=0.4, yaw=math.pi, size=0.16)
    async with CameraPlane(tags=(tag,)) as plane:
        await plane.go(2.0)
        assert (await plane.ask(GOAL, GoalRequest(tag=7))).ok
        await plane.until("succeeded", seconds=120)
        assert plane.x == pytest.approx(7.7 - 0.345, abs=0.1)
        assert plane.y == pytest.approx(2.0, abs=0.1)
        assert plane.distance_and_bearing(7.7, 2.0)[1] < 0.25


async def test_a_can_moved_during_the_drive_is_searched_elsewhere() -> None:
    async with CameraPlane(map_object(3, 2.8, 1.2)) as plane:
        await plane.go(2.0)
        await plane.ask(GOAL, GoalRequest(object="can"))
        await plane.go(2.0)
        plane.things = [map_object(4, 1.0, 2.5)]
        await plane.until("succeeded", seconds=120)
        assert plane.status.done[0].reason.endswith("in front of can 4")


async def test_it_stands_with_a_reason_without_recognition() -> None:
    async with CameraPlane(map_object(3, 2.8, 1.2)) as plane:
        plane.recognizing = False
        plane.things = []
        await plane.go(2.0)
        assert (await plane.ask(GOAL, GoalRequest(object="can"))).ok
        await plane.go(5.0)
        assert plane.travelled < 0.01
        assert "recognition" in plane.status.doing


async def test_a_search_without_cameras_is_refused_in_one_line() -> None:
    async with Plane(FLAT) as plane:
        await plane.go(0.5)
        for request in (GoalRequest(object="can"), GoalRequest(tag=7)):
            reply = await plane.ask(GOAL, request)
            assert not reply.ok
            assert reply.text.startswith("the robot has no cameras; ")
        reply = await plane.ask(MISSION, MissionRequest(mission="do: [{goto: {tag: 7}}]"))
        assert reply.text.startswith("the robot has no cameras; ")
        assert OBJECT_MAP.key not in plane.bench.bus.listens


async def test_a_search_with_only_a_camera_on_the_arm_is_refused() -> None:
    async with CameraPlane() as plane:
        plane.description = replace(ARMED, cameras=(WRIST,))
        await plane.go(0.5)
        reply = await plane.ask(GOAL, GoalRequest(object="can"))
        assert not reply.ok
        assert reply.text.startswith("the robot has a camera on its arm only; ")


async def test_an_object_name_given_as_place_is_refused_with_the_right_command() -> None:
    async with CameraPlane(map_object(3, 2.8, 1.2)) as plane:
        await plane.go(2.0)
        reply = await plane.ask(GOAL, GoalRequest(place="can"))
        assert reply.text == ("no place is called 'can'; an object is: gigabrain goto --object can")
        zones = Zones(places=(Place(name="can", x=2.0, y=2.0),), boot=plane.boot, tick=plane.tick)
        plane.bench.send(ZONES, zones)
        assert (await plane.ask(GOAL, GoalRequest(place="can"))).ok


@pytest.mark.parametrize(
    "request_",
    [
        GoalRequest(object="cann"),
        MissionRequest(mission="do: [{fallback: [{find: ball}, {find: cann}]}]"),
        MissionRequest(mission="things: {it: {label: cann}}\ndo: [{find: ball}]"),
    ],
)
async def test_a_label_that_nothing_recognises_is_refused_with_the_nearest(
    request_: GoalRequest | MissionRequest,
) -> None:
    async with CameraPlane() as plane:
        plane.labels = {"recognition": ("can", "ball"), "mine": ("cup",)}
        await plane.go(2.0)
        service = GOAL if isinstance(request_, GoalRequest) else MISSION
        reply = await plane.ask(service, request_)
        assert not reply.ok
        assert reply.text == "no label 'cann'; did you mean 'can'? known: ball, can, cup"
        assert plane.status.current is None


async def test_a_label_that_only_another_process_recognises_is_sought() -> None:
    async with CameraPlane() as plane:
        plane.labels = {"recognition": ("can", "ball"), "mine": ("cup",)}
        await plane.go(2.0)
        reply = await plane.ask(GOAL, GoalRequest(object="cup"))
        assert reply.text == "goal-1: a cup is not known yet; looking for it"


async def test_a_remembered_thing_is_found_though_its_label_is_no_longer_recognised() -> None:
    async with CameraPlane(map_object(3, 2.8, 1.2, "shoe")) as plane:
        plane.labels = {"recognition": ("can", "ball")}
        await plane.go(2.0)
        reply = await plane.ask(GOAL, GoalRequest(object="shoe"))
        assert reply.text == "goal-1: shoe 3 is at (2.80, 1.20)"


async def test_any_label_is_sought_once_the_recogniser_has_been_silent_for_five_seconds() -> None:
    async with CameraPlane() as plane:
        plane.labels = {"recognition": ("can", "ball")}
        await plane.go(2.0)
        assert not (await plane.ask(GOAL, GoalRequest(object="cann"))).ok
        plane.labels = {}
        await plane.go(6.0)
        assert (await plane.ask(GOAL, GoalRequest(object="cann"))).ok


async def test_a_body_without_cameras_does_not_listen_for_labels() -> None:
    async with Plane(FLAT) as plane:
        await plane.go(0.5)
        assert LABELS.at("*") not in plane.bench.bus.listens
