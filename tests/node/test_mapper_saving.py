"""The mapping node saves its map, localizes the robot in a saved one, and extends it."""

import asyncio
import functools
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gigabrain_schemas.objects import MapTag
from gigabrain_schemas.topics import MAP, MAP_SAVE, POSE, WORLD, ZONES_CHANGE
from gigabrain_schemas.zones import Zone, ZonesRequest
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.mapping import map_file, object_file, zone_file
from gigabrain_zenoh.mapping.object_file import ObjectFile
from gigabrain_zenoh.mapping.slam_map import MapSnapshot, SlamMap
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.recording.process_replay import with_requests
from gigabrain_zenoh.runtime.replay import record, replay
from tests.node.mapping_robot import SLAM, Robot
from tests.node.test_zone_keeping import ask


@pytest.fixture(autouse=True)
def own_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "gigabrain" / "maps"


async def test_a_map_is_saved_and_the_robot_is_localized_in_it(own_maps: Path) -> None:
    async with Robot() as robot:
        robot.publish_body()
        assert (await robot.save("early")).text.startswith("not saved: the robot is not localized")
        robot.drive(80)
        reply = await robot.save("house")
        assert reply.ok, reply.text
        assert reply.text.startswith(f"saved {own_maps}/house.yaml: ")
        assert "already" in (await robot.save("house")).text
        assert (await robot.save("house", replace=True)).ok
    found = PerceptionConfig(mapping="localize", map="house")
    async with Robot(found) as robot:
        robot.publish_body()
        for _ in range(40):
            robot.drive(1, still=True)
            await asyncio.sleep(0.005)
        pose, grid = robot.sent(POSE)[-1], map_file.load(own_maps / "house.yaml")
        reply = await robot.save("other")
    assert pose.localized
    assert (pose.x, pose.y) == pytest.approx((0.0, 0.0), abs=0.05)
    assert grid.resolution == 0.05
    assert reply.text == "not saved: perception only localizes in a saved map; set mapping: slam"


async def test_zones_are_saved_in_the_frame_of_the_saved_map(
    own_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A save waits for a loop closure in progress, which moves the map."""
    still = SlamMap.still

    def corrected(chart: SlamMap) -> MapSnapshot:
        chart._drawn = [pose + np.array((1.0, 0.0, 0.0)) for pose in chart._drawn]
        chart._renewals += 1
        return still(chart)

    monkeypatch.setattr(SlamMap, "still", corrected)
    lab = Zone(name="lab", kind="keepout", points=((1.0, 1.0), (2.0, 1.0), (2.0, 2.0)))
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(80)
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=lab))).ok
        assert (await robot.save("house")).ok
    (saved,) = zone_file.load(own_maps / "house.yaml").zones
    assert np.array(saved.points) == pytest.approx(np.array(lab.points) + np.array((1.0, 0.0)))


async def test_two_saves_at_once_do_not_mix_their_files(
    own_maps: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, writing, max_writing = map_file.save, [0], [0]

    def slow(*args: Any, **how: Any) -> None:
        writing[0] += 1
        max_writing[0] = max(max_writing[0], writing[0])
        time.sleep(0.05)
        real(*args, **how)
        writing[0] -= 1

    monkeypatch.setattr(map_file, "save", slow)
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(80)
        replies = await asyncio.gather(robot.save("house"), robot.save("house"))
    assert max_writing == [1]
    assert sorted(reply.ok for reply in replies) == [False, True]
    assert map_file.load_graph(own_maps / "house.yaml")["poses"].ndim == 2


async def test_a_map_is_drawn_in_another_thread_than_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real, threads = MapSnapshot.to_save, []

    def noted(still: MapSnapshot) -> Any:
        threads.append(threading.current_thread())
        return real(still)

    monkeypatch.setattr(MapSnapshot, "to_save", noted)
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(60)
        assert (await robot.save("house")).ok
    assert threads
    assert threading.current_thread() not in threads


async def test_a_replay_with_a_save_publishes_the_same_and_saves_nothing(
    own_maps: Path,
) -> None:
    async with Robot() as robot:
        events = record(robot.network, robot.clock)
        robot.publish_body()
        robot.drive(60)
        assert (await robot.save("house")).ok
        robot.drive(20)
    (own_maps / "house.yaml").unlink()
    own = (WORLD.key, POSE.key, MAP.key)
    received = with_requests([event for event in events if event[1] not in own])
    assert sum(key == MAP_SAVE.key for _, key, _ in received) == 1
    now = await replay(functools.partial(perception.run, SLAM), received, "perception")
    then = [(key, data) for _, key, data in events if key in own]
    assert [one for one in now if one[0] in own] == then
    assert len(then) > 160
    assert not (own_maps / "house.yaml").exists()


async def test_a_loaded_map_can_be_extended_and_saved_again(own_maps: Path) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(60)
        assert (await robot.save("house")).ok
    size = map_file.load(own_maps / "house.yaml").cells.size
    async with Robot(PerceptionConfig(mapping="slam", map="house")) as robot:
        robot.publish_body()
        for _ in range(40):
            robot.drive(1, still=True)
            await asyncio.sleep(0.005)
        assert robot.sent(POSE)[-1].localized
        assert (await robot.save("house")).ok  # may overwrite its own map
    assert map_file.load(own_maps / "house.yaml").cells.size >= size


async def test_without_cameras_objects_are_kept_with_their_own_map_only(own_maps: Path) -> None:
    path = own_maps / "house.yaml"
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(60)
        assert (await robot.save("house")).ok
        known = ObjectFile(tags=(MapTag(id=5, x=0, y=0, z=0.2, yaw=0, size=0.16),))
        object_file.save(path, known)
    async with Robot(PerceptionConfig(mapping="slam", map="house")) as robot:
        robot.publish_body()
        for _ in range(40):
            robot.drive(1, still=True)
            await asyncio.sleep(0.005)
        assert (await robot.save("house")).ok
    assert object_file.load(path) == known
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(60)
        assert (await robot.save("house", replace=True)).ok
    assert object_file.load(path) == ObjectFile()
