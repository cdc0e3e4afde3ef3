"""The map outlives perception: it is saved every few seconds, and the next process continues it."""

import asyncio
import functools
import logging
import random
import threading
import time
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.brain import OccupancyGrid
from gigabrain_schemas.topics import MAP, MAP_LOAD, POSE, SCAN, STATE, WORLD, ZONES_CHANGE
from gigabrain_schemas.zones import MapLoadRequest, ZonesRequest
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.mapping import autosave, localizer
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.recording.process_replay import with_requests
from gigabrain_zenoh.runtime.replay import record, replay
from gigabrain_zenoh.testing.samples import state
from tests.node.mapping_robot import Robot
from tests.node.test_zone_keeping import LAB, ask, newest_zones

SCANS_IN_5_S = 50
Usage = namedtuple("Usage", "total used free")


class DrivingRobot(Robot):
    """A robot that drives north at 0.2 m/s, or stands still where it is."""

    def __init__(self, folder: Path | str) -> None:
        super().__init__(PerceptionConfig(mapping="slam", state_dir=str(folder)))
        self.north_m = 0.0

    def drive(self, scans: int, *, still: bool = False) -> None:
        for _ in range(scans):
            for _ in range(5):
                self.tick += 1
                self.north_m += 0.0 if still else 0.004
                self.send(STATE, state(self.tick, pose=(self.north_m, 0, 0), boot=self.boot))
            self.send(SCAN, self.scan(y=self.north_m))

    async def drive_until_saved(self, saves: int = 2) -> None:
        """Drive until so many saves are on disk; a busy machine may write them late."""
        async with asyncio.timeout(60):
            while self.report("saves") < saves:
                self.drive(1)
                await asyncio.sleep(0.002)

    async def stand(self, scans: int = SCANS_IN_5_S) -> list[bool]:
        """Stand for `scans` scans; return for each whether the robot is localized."""
        self.sent(POSE)
        for _ in range(scans):
            self.drive(1, still=True)
            await asyncio.sleep(0.005)  # searches run in a thread
        poses = self.sent(POSE)
        assert not poses[-1].localized or abs(poses[-1].x - self.north_m) < 0.06
        return [pose.localized for pose in poses]

    async def restart_perception(self) -> None:
        """End perception and start it again."""
        await self.restart()
        await self.ready()
        self.publish_body()

    def report(self, name: str) -> float:
        return float(self.bus.report()[name] or 0)

    def grid(self) -> OccupancyGrid:
        """Return the newest map."""
        return next(map_of(data) for key, data in reversed(self.network.sent) if key == MAP.key)

    def known_area(self) -> float:
        """Return the known area of the newest map [m²]."""
        self.drive(11, still=True)
        grid = self.grid()
        return float(np.count_nonzero(np.frombuffer(grid.cells, np.int8) >= 0)) * 0.0025


def map_of(data: bytes) -> OccupancyGrid:
    return msgspec.msgpack.decode(data, type=OccupancyGrid)


def files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)


async def test_restarted_perception_has_the_map_and_localizes_the_robot_within_5_s(
    tmp_path: Path,
) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        before = robot.known_area()
        await robot.restart_perception()
        assert all(await robot.stand())  # from the first scan
        assert robot.known_area() > 0.98 * before
        before = robot.known_area()
        robot.drive(20)
        assert robot.known_area() > before  # the map continues to grow


async def test_a_robot_that_moved_while_perception_was_down_is_localized(tmp_path: Path) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        robot.north_m += 0.6
        await robot.restart_perception()
        assert all(await robot.stand())


def cut_in_half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def emptied(_: bytes) -> bytes:
    return b""


def flip_bits(data: bytes) -> bytes:
    """Flip one bit in each 10 kB."""
    chance, spoilt = random.Random(1), bytearray(data)
    for _ in range(0, len(data), 10_000):
        spoilt[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


@pytest.mark.parametrize("damage", [cut_in_half, emptied, flip_bits])
async def test_a_damaged_save_is_refused_and_the_previous_one_is_loaded(
    damage: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        newest = files(tmp_path)[-1]
        newest.write_bytes(damage(newest.read_bytes()))
        await robot.restart_perception()
        assert (await robot.stand())[-1]
        await robot.drive_until_saved(saves=1)
    warnings = [line for line in caplog.messages if line.startswith("a saved map is refused: ")]
    assert len(warnings) == 1
    assert str(newest) in warnings[0]
    assert newest == files(tmp_path)[-1]  # the damaged one is replaced first


async def test_without_an_intact_save_a_new_map_begins(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        for path in files(tmp_path):
            path.write_bytes(cut_in_half(path.read_bytes()))
        await robot.restart_perception()
        assert (await robot.stand(1))[0]
    assert len([line for line in caplog.messages if "is refused" in line]) == 2


async def test_a_map_from_another_start_of_the_driver_is_not_loaded(tmp_path: Path) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        before = robot.known_area()
        robot.boot, robot.tick, robot.north_m = 8, 0, 0.0
        await robot.restart_perception()
        assert (await robot.stand(1))[0]  # the old map is not searched
        assert robot.known_area() < before


async def test_a_map_survives_restarts_of_driver_and_perception(
    tmp_path: Path,
) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        before, saves = robot.known_area(), robot.report("saves")
        robot.boot, robot.tick = 8, 0
        robot.publish_body()
        await robot.stand()
        while robot.report("saves") <= saves + 1:  # the first save may be of a lost robot
            await robot.stand(1)
        await robot.restart_perception()
        assert all(await robot.stand())  # from the first scan
        assert robot.known_area() > 0.98 * before


async def test_a_lost_robot_is_still_lost_after_a_restart_of_perception(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        saves = robot.report("saves")
        with monkeypatch.context() as patch:
            patch.setattr(localizer, "search", lambda *_: [])  # finds nothing yet
            robot.boot, robot.tick = 8, 0
            robot.publish_body()
            while robot.report("saves") <= saves:
                assert not any(await robot.stand(1))
        await robot.restart_perception()
        looked = await robot.stand()
    assert not looked[0]
    assert looked[-1]


def test_a_save_is_made_when_the_robot_gets_lost_or_is_found_elsewhere(tmp_path: Path) -> None:
    saved, saves, tick = autosave.Autosave(tmp_path), [], 0
    for x, lost in ((0.0, False), (0.0, True), (5.0, False), (5.0, False)):
        still: Any = SimpleNamespace(
            pose=np.array((x, 0.0, 0.0)), lost=lost, changes=(1, 0, 1), freeze=dict
        )
        saved.save(7, tick, np.zeros(3), still)
        while not saved.due(7, tick := tick + 1000):
            time.sleep(0.002)
        saves.append(saved.saves)
    saved.close()
    assert saves == [1, 2, 3, 3]


async def test_saving_does_not_change_the_published_messages(tmp_path: Path) -> None:
    published = []
    for folder in ("", tmp_path):
        async with DrivingRobot(folder) as robot:
            robot.publish_body()
            for _ in range(100):
                robot.drive(1)
                await asyncio.sleep(0)
            published.append([data for key, data in robot.network.sent if key == POSE.key])
            published.append([data for key, data in robot.network.sent if key == MAP.key])
    assert published[0] == published[2]
    assert published[1] == published[3]


async def test_a_replay_neither_loads_nor_saves_maps(tmp_path: Path) -> None:
    async with DrivingRobot(tmp_path) as robot:
        events = record(robot.network, robot.clock)
        robot.publish_body()
        robot.drive(60)
    then = [(key, data) for _, key, data in events if key in (WORLD.key, POSE.key)]
    before = [path.read_bytes() for path in files(tmp_path)]
    received = with_requests(
        [event for event in events if event[1] in (STATE.key, SCAN.key, "robot/body")]
    )
    config = PerceptionConfig(mapping="slam", state_dir=str(tmp_path))
    now = await replay(functools.partial(perception.run, config), received, "perception")
    assert [one for one in now if one[0] in (WORLD.key, POSE.key)] == then
    assert [path.read_bytes() for path in files(tmp_path)] == before


@pytest.mark.slow
async def test_a_standing_robot_saves_no_more_maps(tmp_path: Path) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved()
        await robot.stand(100)
        saves = robot.report("saves")
        await robot.stand(200)
        assert robot.report("saves") == saves


async def test_only_two_maps_and_the_zones_are_on_disk(tmp_path: Path) -> None:
    async with DrivingRobot(tmp_path / "state") as robot:
        robot.publish_body()
        await robot.drive_until_saved(saves=4)
        await robot.stand(50)
    names = {path.name for path in (tmp_path / "state").iterdir()}
    assert names == {"map_0.npz", "map_1.npz", "zones.json"}


async def test_a_full_disk_is_reported_once_and_mapping_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        await robot.drive_until_saved(saves=1)
        full = Usage(10**9, 10**9, 10**8)
        monkeypatch.setattr(autosave.shutil, "disk_usage", lambda _: full)
        for _ in range(100):
            robot.drive(1)
            await asyncio.sleep(0.005)
        problems = robot.bus.problems
        monkeypatch.undo()
        await robot.drive_until_saved(saves=2)
        robot.drive(11)
        assert robot.bus.problems == ()
    assert [problem.code for problem in problems] == ["map_unsaved"]
    assert f"{tmp_path}/map_1.npz: less than 20" in problems[0].text
    warnings = [
        r for r in caplog.records if r.levelno == logging.WARNING and "not saved" in r.message
    ]
    assert len(warnings) == 1


async def test_a_hanging_disk_is_reported_after_30_s_and_delays_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, real = threading.Event(), autosave.make_folder

    def hang(folder: Path) -> None:
        hangs.wait(60)
        real(folder)

    monkeypatch.setattr(autosave, "make_folder", hang)
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        robot.drive(320, still=True)
        problems = robot.bus.problems
        hangs.set()
        await robot.drive_until_saved(saves=1)
        robot.drive(11)
        assert robot.bus.problems == ()
    assert [problem.code for problem in problems] == ["map_unsaved"]
    assert "map_0.npz: saving takes too long" in problems[0].text


async def test_a_map_can_be_loaded_and_extended_without_a_state_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    no_folder = tmp_path / "file"
    no_folder.touch()
    async with DrivingRobot(no_folder) as robot:
        robot.publish_body()
        robot.drive(40)
        assert (await robot.save("house")).ok
        reply = await ask(robot, MAP_LOAD, MapLoadRequest(name="house", mapping="slam"))
        assert (reply.ok, reply.text) == (True, "loaded house; looking for the robot in it")
        robot.drive(1)
        told = [one.text for one in robot.bus.problems if one.code == "map_unsaved"]
    assert len(told) == 1
    assert told[0].endswith(f"{no_folder}/map_0.npz: Not a directory")


async def test_a_read_only_disk_is_tried_only_every_4_s(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []

    def refuse(folder: Path) -> None:
        tries.append(folder)
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(autosave, "make_folder", refuse)
    async with DrivingRobot(tmp_path) as robot:
        robot.publish_body()
        async with asyncio.timeout(60):
            while not robot.bus.problems:  # they are published once a second
                robot.drive(1)
                await asyncio.sleep(0.002)
        for _ in range(20):
            robot.drive(1)
            await asyncio.sleep(0.002)
    assert len(tries) == 1


@pytest.mark.parametrize("loaded", [False, True])
async def test_zones_outlive_perception_although_the_map_cannot_be_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loaded: bool
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(40)
        assert (await robot.save("house")).ok
    monkeypatch.setattr(autosave, "KEEP_FREE_BYTES", 10**18)
    config = PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))
    async with Robot(config if loaded else replace(config, map="house")) as robot:
        robot.publish_body()
        robot.drive(3, still=True)
        if loaded:
            assert (await ask(robot, MAP_LOAD, MapLoadRequest(name="house", mapping="slam"))).ok
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=LAB))).ok
        for _ in range(2):
            await robot.restart()
            await robot.ready()
            robot.publish_body()
            robot.drive(3, still=True)
            now = await newest_zones(robot)
            assert ([one.name for one in now.zones], now.map) == (["lab"], "house")
            assert now.maps_loaded == loaded
