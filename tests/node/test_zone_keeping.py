"""Perception keeps zones and places with its map, and loads maps while it runs."""

import asyncio
import math
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
import pytest

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import MAP_LIST, MAP_LOAD, POSE, ZONES, ZONES_CHANGE, Topic
from gigabrain_schemas.zones import (
    MapListRequest,
    MapLoadRequest,
    Place,
    Zone,
    Zones,
    ZonesReply,
    ZonesRequest,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.mapping import map_file, zone_file
from gigabrain_zenoh.mapping.zone_file import ZoneFile
from gigabrain_zenoh.perception.zone_server import ZoneServer
from gigabrain_zenoh.testing.in_memory import Net
from tests.node.mapping_robot import Robot

T = TypeVar("T")
M = TypeVar("M", bound=Message)
LAB = Zone(name="lab", kind="keepout", points=((1.0, 1.0), (2.0, 1.0), (2.0, 2.0)))
KITCHEN = Place(name="kitchen", x=3.0, y=2.5, yaw=0.5)


async def wait_with_time(robot: Robot, reply: Awaitable[T]) -> T:
    task = asyncio.ensure_future(reply)
    async with asyncio.timeout(60):
        while not task.done():
            await robot.clock.advance(20_000_000)
            await asyncio.sleep(0.005)
    return task.result()


async def ask(robot: Robot, service, request: Message):  # type: ignore[no-untyped-def]
    bus = Bus(robot.network.transport(), robot.clock, "test")
    replies = await wait_with_time(robot, bus.ask(service, request, timeout_s=600.0))
    await bus.close()
    return replies[0]


def newest_message(robot: Robot, topic: Topic[M]) -> M:
    """Return the newest of all messages published on `topic`."""
    payload = next(data for key, data in reversed(robot.network.sent) if key == topic.key)
    return Codec(topic.type, topic.max_bytes).decode(payload)


async def newest_zones(robot: Robot) -> Zones:
    await robot.clock.advance(0)
    return newest_message(robot, ZONES)


def house_file() -> ZoneFile:
    """Return the zones saved beside the map `house`."""
    return zone_file.load(map_file.saved_map_path("house"))


@pytest.fixture(autouse=True)
def _own_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


async def test_zones_are_published_saved_with_the_map_and_loaded_with_it() -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20)
        assert (await newest_zones(robot)).zones == ()
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=LAB))).ok
        reply = await ask(robot, ZONES_CHANGE, ZonesRequest(place=KITCHEN))
        assert reply == ZonesReply(ok=True, text="added 'kitchen'; save the map to keep it")
        now = await newest_zones(robot)
        assert ([one.name for one in now.zones], now.map) == (["lab"], "")
        assert (await robot.save("house")).ok
        reply = await ask(robot, ZONES_CHANGE, ZonesRequest(remove="lab"))
        assert reply.text == "removed 'lab'; save the map to keep it"
        assert house_file() == ZoneFile(zones=(LAB,), places=(KITCHEN,))
    async with Robot(PerceptionConfig(mapping="localize", map="house")) as robot:
        robot.publish_body()
        robot.drive(3, still=True)
        now = await newest_zones(robot)
        assert (now.places, now.map, now.maps_loaded) == ((KITCHEN,), "house", 0)
        reply = await ask(robot, ZONES_CHANGE, ZonesRequest(remove="lab"))
        assert reply.text == "removed 'lab', kept with the map house"
    assert house_file() == ZoneFile(places=(KITCHEN,))


@pytest.mark.parametrize(
    ("zone", "why"),
    [
        (
            Zone(name="bow", kind="keepout", points=((0, 0), (1, 1), (1, 0), (0, 1))),
            "zone 'bow': its edges cross; draw a polygon whose edges do not cross",
        ),
        (
            Zone(name="lab", kind="keepout", points=((0, 0), (1, 1), (1, 0))),
            "'lab' exists already; replace it (--replace), or choose another name",
        ),
        (
            Zone(name="dot", kind="one_way", points=((1, 1), (1, 1)), lane_width=1.0),
            "zone 'dot': its points are all the same; a lane needs a direction",
        ),
    ],
)
async def test_invalid_zones_are_refused_and_change_nothing(zone: Zone, why: str) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20)
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=LAB, source="ann"))).ok
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=zone, source="bob"))).text == why
        reply = await ask(robot, ZONES_CHANGE, ZonesRequest(remove="lap"))
        assert reply.text == "no zone or place 'lap'; did you mean 'lab'? known: lab"
        assert [one.name for one in (await newest_zones(robot)).zones] == ["lab"]


async def test_zones_beyond_the_limit_of_a_message_are_refused() -> None:
    ring = tuple(
        (round(9 * math.cos(a), 3), round(9 * math.sin(a), 3))
        for a in np.linspace(0, 2 * math.pi, 256, endpoint=False)
    )
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20)
        replies = [
            await ask(
                robot,
                ZONES_CHANGE,
                ZonesRequest(zone=Zone(name=f"z{i}", kind="keepout", points=ring)),
            )
            for i in range(34)
        ]
        assert [one.ok for one in replies] == [True] * 32 + [False] * 2
        assert "vertices in all zones; expected at most 8192" in replies[-1].text
        assert len((await newest_zones(robot)).zones) == 32


async def test_maps_are_listed_and_loaded_on_request(tmp_path: Path) -> None:
    async with Robot(PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))) as robot:
        robot.publish_body()
        robot.drive(40)
        await ask(robot, ZONES_CHANGE, ZonesRequest(place=KITCHEN))
        assert (await robot.save("house")).ok
        map_file.saved_map_path("broken").write_text("image: nowhere.pgm\n")
        zone_file.path_beside(map_file.saved_map_path("alone")).write_text("version: 1\n")
        listed = await ask(robot, MAP_LIST, MapListRequest())
        assert [(one.name, bool(one.problem), one.places) for one in listed.maps] == [
            ("broken", True, 0),
            ("house", False, 1),
        ]
        assert listed.present == "house"
        reply = await ask(robot, MAP_LOAD, MapLoadRequest(name="broken"))
        assert not reply.ok
        assert reply.text.startswith("not loaded: ")
        assert not (await ask(robot, MAP_LOAD, MapLoadRequest(name="nowhere"))).ok
        reply = await ask(robot, MAP_LOAD, MapLoadRequest(name="house"))
        assert reply.text == "loaded house; looking for the robot in it"
        robot.drive(1)
        assert not newest_message(robot, POSE).localized
        for _ in range(60):
            robot.drive(1, still=True)
            await robot.clock.advance(100_000_000)
            await asyncio.sleep(0.02)
            if newest_message(robot, POSE).localized:
                break
        assert newest_message(robot, POSE).localized
        now = await newest_zones(robot)
        assert (now.map, now.maps_loaded, now.places) == ("house", 1, (KITCHEN,))
        await robot.restart()  # loads the map again that was loaded on request
        await robot.ready()
        robot.publish_body()
        robot.drive(3, still=True)
        now = await newest_zones(robot)
        assert (now.map, now.maps_loaded, now.places) == ("house", 1, (KITCHEN,))


async def test_zones_move_with_the_keyframe_beside_them() -> None:
    net = Net()
    server = ZoneServer(net.one, "", lambda: 0)
    server.use_map("", "slam", ZoneFile(zones=(LAB,), places=(KITCHEN,)), loaded=False)
    poses = np.array(((0.0, 0.0, 0.0), (3.0, 2.0, 0.0)))
    server.follow(0, poses)
    assert server.present.zones == (LAB,)
    corrected = poses + np.array(((0.0, 0.0, 0.0), (0.5, 0.0, 0.1)))
    server.follow(1, corrected)
    place = server.present.places[0]
    assert place.yaw == pytest.approx(0.6)
    assert (place.x, place.y) == pytest.approx(
        (3.5 - 0.5 * math.sin(0.1), 2.0 + 0.5 * math.cos(0.1))
    )
    server.follow(2, poses)
    assert server.present.places[0].x == pytest.approx(3.0)
    server.follow(3, poses + 0.001)  # too little to publish
    assert server.present.places[0].x == pytest.approx(3.0)


@pytest.mark.parametrize("loaded", [False, True])
async def test_a_zones_file_is_unchanged_while_its_map_is_extended(
    loaded: bool,
) -> None:
    saved = ZoneFile(zones=(LAB,))
    zone_file.save(map_file.saved_map_path("house"), saved)
    net = Net()
    server = ZoneServer(net.one, "", lambda: 0)
    server.use_map("house" if loaded else "", "slam", saved, loaded=loaded)
    if not loaded:
        server.saved_as("house")
    poses = np.array(((0.0, 0.0, 0.0), (1.0, 1.0, 0.0)))
    server.follow(0, poses)
    server.follow(1, poses + np.array((0.6, 0.0, 0.0)))  # as after a loop closure
    replies = await net.two.ask(ZONES_CHANGE, ZonesRequest(place=KITCHEN))
    assert [one.text for one in replies] == ["added 'kitchen'; save the map to keep it"]
    assert server.present.zones[0].points[0] == pytest.approx((1.6, 1.0))
    assert house_file() == saved


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("version: 2\n", "house.zones.yaml:1: version"),
        ("zones: [{name: a, kind: wall, points: [[0,0],[1,0],[1,1]]}]", "kind"),
        ("zones: [{name: a, kind: keepout, points: [[0,0],[.nan,0],[1,1]]}]", "finite"),
        ("zones: [{name: a, kind: keepout, points: [[0,0],[1,1],[1,0],[0,1]]}]", "edges cross"),
        ("places: [{name: ../a, x: 0, y: 0}]", "name"),
        ("places: [{name: a, x: 0, y: 0}, {name: a, x: 0, y: 0}]", "two zones or places"),
        ("\0\xff", "house.zones.yaml"),
        ("x" * 300_000, "house.zones.yaml"),
    ],
)
def test_an_invalid_zones_file_is_refused_in_one_line(text: str, why: str) -> None:
    path = map_file.saved_map_path("house")
    path.parent.mkdir(parents=True)
    zone_file.path_beside(path).write_text(text)
    with pytest.raises(zone_file.ConfigError, match=why) as caught:
        zone_file.load(path)
    assert "\n" not in str(caught.value)


def test_written_zones_are_read_back_unchanged() -> None:
    zones = ZoneFile(
        zones=(
            LAB,
            Zone(
                name="no",
                kind="speed",
                points=((-1e5, 0.0), (1.0, 1e5), (0.5, 0.25)),
                max_speed=0.1,
            ),
            Zone(name="1e3", kind="one_way", points=((0.0, 1.0), (2.0, 3.0)), lane_width=1.25),
        ),
        places=(KITCHEN, Place(name="Küche 2", x=0.0, y=-1.0)),
    )  # fmt: skip
    path = map_file.saved_map_path("house")
    zone_file.save(path, zones)
    assert zone_file.load(path) == zones


CORNERS = ((0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (2.0003, 1.0003), (0.0, 1.0))


@pytest.mark.parametrize(
    ("zone", "why"),
    [
        (Zone(name="lab", kind="keepout", points=CORNERS), "its edges cross"),
        (
            Zone(name="lab", kind="one_way", lane_width=1, points=((0, 0), (0.0004, 0))),
            "its points are all the same",
        ),
    ],
)
async def test_a_zone_invalid_after_rounding_is_refused(zone: Zone, why: str) -> None:
    net = Net()
    ZoneServer(net.one, "", lambda: 0)
    reply = (await net.two.ask(ZONES_CHANGE, ZonesRequest(zone=zone)))[0]
    assert reply.text.startswith(f"zone 'lab': {why}")


async def test_a_narrow_zone_moved_with_the_map_can_be_read_back() -> None:
    slit = ((0, 0), (3, 0), (3, 3), (0, 3), (0, 0.001), (1, 0.001), (1, 2), (2, 2), (2, 0.001))
    lane = Zone(name="lane", kind="one_way", lane_width=1, points=((0, 0), (0.001, 0)))
    net = Net()
    server = ZoneServer(net.one, "", lambda: 0)
    for zone in (Zone(name="slit", kind="keepout", points=slit), lane):
        assert (await net.two.ask(ZONES_CHANGE, ZonesRequest(zone=zone)))[0].ok
    server.follow(0, np.zeros((1, 3)))
    server.follow(1, np.array(((0.0003, 0.0004, 1.3),)))
    path = map_file.saved_map_path("house")
    zone_file.save(path, server.present)
    assert [one.name for one in zone_file.load(path).zones] == ["slit", "lane"]


async def test_zones_of_an_unsaved_map_outlive_perception(tmp_path: Path) -> None:
    async with Robot(PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))) as robot:
        robot.publish_body()
        robot.drive(60)
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=LAB))).ok
        for _ in range(40):
            robot.drive(10)
            await robot.clock.advance(100_000_000)
            await asyncio.sleep(0.05)
            if list((tmp_path / "robot").glob("map_*.npz")):
                break
        await robot.restart()
        await robot.ready()
        robot.publish_body()
        robot.drive(3)
        assert (await newest_zones(robot)).zones == (LAB,)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(b" " * 5_000_000),
        Path.mkdir,
        os.mkfifo,
        lambda path: path.write_bytes(b"{"),
    ],
)
async def test_a_damaged_zones_state_is_skipped_with_one_warning(
    damage: Callable[[Path], object], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    damage(tmp_path / "zones.json")
    assert ZoneServer(Net().one, str(tmp_path), lambda: 0).restore(7) is None
    assert len(caplog.messages) == 1
    assert str(tmp_path / "zones.json") in caplog.messages[0]


async def test_zones_are_written_later_if_the_folder_becomes_writable(tmp_path: Path) -> None:
    folder, net = tmp_path / "full", Net()
    folder.write_text("no folder can be made here")
    server = ZoneServer(net.one, str(folder), lambda: 0)
    server.set_boot(7)
    await net.two.ask(ZONES_CHANGE, ZonesRequest(zone=LAB))
    await server.finish_writing()
    assert server.problems()
    folder.unlink()
    server.publish(500)
    await server.finish_writing()
    assert not server.problems()
    kept = ZoneServer(Net().one, str(folder), lambda: 0).restore(7)
    assert kept
    assert [one.zone for one in kept.items] == [LAB]


@pytest.mark.parametrize("mapping", ["localize", "slam"])
async def test_a_loaded_map_that_is_deleted_does_not_end_perception(
    mapping: Literal["localize", "slam"], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Robot(PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))) as robot:
        robot.publish_body()
        robot.drive(40)
        await ask(robot, ZONES_CHANGE, ZonesRequest(place=KITCHEN))
        assert (await robot.save("house")).ok
        assert (await ask(robot, MAP_LOAD, MapLoadRequest(name="house", mapping=mapping))).ok
        map_file.saved_map_path("house").unlink()
        for _ in range(2):
            await robot.restart()
            await robot.ready()
            robot.publish_body()
            robot.drive(3)
            now = await newest_zones(robot)
            assert (now.map, now.places) == ("", ())
            assert newest_message(robot, POSE).localized
    warnings = [
        line for line in caplog.messages if line.startswith("map 'house' is not loaded again")
    ]
    assert len(warnings) == 1
    assert "house.yaml: no such file" in warnings[0]


async def test_an_extended_map_outlives_its_deleted_file(tmp_path: Path) -> None:
    async with Robot(PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))) as robot:
        robot.publish_body()
        robot.drive(40)
        await ask(robot, ZONES_CHANGE, ZonesRequest(place=KITCHEN))
        assert (await robot.save("house")).ok
        assert (await ask(robot, MAP_LOAD, MapLoadRequest(name="house", mapping="slam"))).ok
        async with asyncio.timeout(60):
            while not robot.bus.report().get("saves"):
                robot.drive(1, still=True)
                await asyncio.sleep(0.002)
        map_file.saved_map_path("house").unlink()
        await robot.restart()
        await robot.ready()
        robot.publish_body()
        robot.drive(3, still=True)
        now = await newest_zones(robot)
        assert (now.map, now.maps_loaded, now.places) == ("house", 1, (KITCHEN,))
