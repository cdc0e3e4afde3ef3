"""The step that searches for an object or tag: its commands and results."""

from collections.abc import Collection

import pytest

from gigabrain_schemas.base import Pose
from gigabrain_schemas.objects import MapObject, MapTag, ObjectMap
from gigabrain_zenoh.decision.known_objects import Sought, Wanted, named, sought
from gigabrain_zenoh.decision.tasks.mission_files import loads
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskQueue
from gigabrain_zenoh.errors import ConfigError
from tests.unit.decision.sites import Robot


def can(number: int, x: float, y: float = 0.0, label: str = "can") -> MapObject:
    return MapObject(id=number, label=label, x=x, y=y, z=0.06, size=(0.07, 0.12), confidence=0.9)


class Seeker(Robot):
    """A robot at the origin that knows some objects."""

    def __init__(self, saved: Saved | None = None) -> None:
        super().__init__()
        self.known = ObjectMap(recognizing=True)
        self.tasks = TaskQueue(self._read, self._start, saved or Saved(), self._seek)

    def knows(self, *objects: MapObject, tags: tuple[MapTag, ...] = ()) -> None:
        self.known = ObjectMap(objects=objects, tags=tags, recognizing=True)

    def wanted(self) -> tuple[str, str] | None:
        """Step once. Return the command's kind and its target's name, or None without a command."""
        self.step()
        if self.command is None:
            return None
        return self.command.kind, self.command.target.name if self.command.target else ""

    def _seek(self, wanted: Wanted, without: Collection[int], preferred: int | None) -> Sought:
        return sought(self.known, Pose(x=0.0, y=0.0, yaw=0.0), wanted, without, preferred)


def test_it_looks_for_an_object_and_drives_to_the_nearest_once_it_is_known() -> None:
    robot = Seeker()
    robot.tasks.add_find("can", "replace", "ann")
    assert robot.wanted() == ("look", "")
    assert robot.status.doing == "looking for a can"
    robot.knows(can(4, 5.0), can(9, 2.0), can(1, 0.1, label="ball"))
    assert robot.wanted() == ("approach", "can 9")
    assert robot.status.doing == "going to can 9"
    robot.knows(can(4, 0.5), can(9, 2.04))  # it keeps its target
    number = robot.command.number if robot.command else 0
    assert robot.wanted() == ("approach", "can 9")
    assert robot.command
    assert robot.command.number == number
    robot.knows(can(9, 2.4))  # it was pushed
    assert robot.wanted() == ("approach", "can 9")
    assert robot.command.number > number
    robot.reached()
    assert robot.last == ("succeeded", "it is there")
    assert (robot.status.done[0].kind, robot.status.done[0].label) == ("goal", "find a can")


def test_an_object_lost_on_the_way_is_sought_at_its_last_place() -> None:
    robot = Seeker()
    robot.tasks.add_find("can", "replace", "ann")
    assert robot.wanted() == ("look", "")
    seek = robot.command.seek if robot.command else 0
    robot.knows(can(1, 2.0))
    assert robot.wanted() == ("approach", "can 1")
    robot.knows()
    assert robot.wanted() == ("approach", "can 1")
    robot.reached()
    assert robot.wanted() == ("look", "")
    assert robot.command
    assert robot.command.seek == seek  # the same search continues
    robot.knows(can(2, 2.1))
    assert robot.wanted() == ("approach", "can 2")
    robot.knows()
    assert robot.wanted() == ("look", "")  # it drove there once
    robot.knows(can(3, 3.0))
    assert robot.wanted() == ("approach", "can 3")
    robot.knows()
    robot.failed("no free and reachable place in front of can 3")
    assert robot.wanted() == ("look", "")


def test_a_tag_lost_before_the_arrival_is_not_found() -> None:
    robot = Seeker()
    robot.carry_out("do: [{find: {tag: 0}}]")
    robot.knows(tags=(MapTag(id=0, x=2.0, y=0.0, z=0.4, yaw=3.0, size=0.16),))
    assert robot.wanted() == ("approach", "tag 0")
    robot.knows()
    robot.reached()
    assert robot.wanted() == ("look", "")


def test_an_object_that_is_seen_again_on_the_way_is_found() -> None:
    robot = Seeker()
    robot.tasks.add_find("can", "replace", "ann")
    robot.knows(can(1, 2.0))
    assert robot.wanted() == ("approach", "can 1")
    robot.knows()
    assert robot.wanted() == ("approach", "can 1")
    robot.knows(can(2, 2.05))
    assert robot.wanted() == ("approach", "can 2")
    robot.reached()
    assert robot.last == ("succeeded", "it is there")


def test_it_fails_with_a_reason_once_everything_was_looked_at() -> None:
    robot = Seeker()
    robot.carry_out("do: [{find: umbrella}]")
    assert robot.wanted() == ("look", "")
    robot.failed("everything reachable was seen")
    assert robot.last == (
        "failed",
        "an umbrella was not found: everything reachable was seen",
    )


def test_of_two_things_the_one_that_can_be_reached_will_do() -> None:
    robot = Seeker()
    robot.carry_out("do: [{find: can}]")
    robot.knows(can(1, 1.0), can(2, 2.0))
    assert robot.wanted() == ("approach", "can 1")
    robot.failed("no free and reachable place in front of can 1")
    assert robot.wanted() == ("approach", "can 2")
    robot.failed("no free and reachable place in front of can 2")
    assert robot.wanted() == ("look", "")
    robot.failed("everything reachable was seen")
    assert robot.last[1] == (
        "no free and reachable place in front of can 1; "
        "no free and reachable place in front of can 2; "
        "a can was not found: everything reachable was seen"
    )


def test_it_waits_with_a_reason_while_recognition_does_not_run() -> None:
    robot = Seeker()
    robot.tasks.add_find("can", "replace", "ann")
    robot.known = ObjectMap()
    assert robot.wanted() is None
    assert "recognition" in robot.status.doing
    robot.known = ObjectMap(objects=(can(1, 1.0),))  # it still drives to known objects
    assert robot.wanted() == ("approach", "can 1")


def test_missions_name_tags_as_places_also_at_a_charger() -> None:
    robot = Seeker()
    robot.carry_out(
        "do: [{battery_below: {percentage: 20, goto: {tag: 7}, do: [{goto: {tag: 3}}]}}]"
    )
    tags = tuple(MapTag(id=n, x=float(n), y=0.0, z=0.4, yaw=3.0, size=0.16) for n in (3, 7))
    robot.knows(tags=tags)
    assert robot.wanted() == ("approach", "tag 3")
    assert robot.command
    assert robot.command.target
    assert robot.command.target.yaw == 3.0
    robot.charge = 10.0
    assert robot.wanted() == ("approach", "tag 7")


def test_a_search_continues_after_a_restart_of_decision() -> None:
    robot = Seeker()
    robot.carry_out("do: [{goto: a}, {find: can}]")
    robot.step()
    robot.reached()
    again = Seeker(robot.tasks.saved)
    assert again.wanted() == ("look", "")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("do: [{find: ''}]", "length >= 1"),
        ("do: [{find: {tag: -1}}]", ">= 0"),
        ("do: [{find: [1, 2]}]", "got a list of 2"),
        ("do: [{goto: {tag: seven}}]", "got 'seven'"),
        ("do: [{goto: {tag: 7, more: 1}}]", "unknown field"),
    ],
)
def test_an_impossible_search_is_refused(text: str, why: str) -> None:
    with pytest.raises(ConfigError, match="m:1: ") as refused:
        loads(text, "m")
    assert why in str(refused.value)
    assert "\n" not in str(refused.value)


def test_texts_name_the_wanted_object() -> None:
    assert [named(one) for one in ("can", "umbrella", "Apple", 7)] == [
        "a can", "an umbrella", "an Apple", "tag 7",
    ]  # fmt: skip
