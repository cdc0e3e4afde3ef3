"""The map outlives perception: saved every few seconds, and gone on with by the next process."""

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
from tests.node.test_zone_keeping import LAB, ask, newest

SCANS_IN_5_S = 50
Usage = namedtuple("Usage", "total used free")


class Walking(Robot):
    """The robot drives north at 0.2 m/s, unless it is told to stand, which it does where it is."""

    def __init__(self, folder: Path | str) -> None:
        super().__init__(PerceptionConfig(mapping="slam", state_dir=str(folder)))
        self.away = 0.0

    def drive(self, scans: int, *, still: bool = False) -> None:
        for _ in range(scans):
            for _ in range(5):
                self.tick += 1
                self.away += 0.0 if still else 0.004
                self.send(STATE, state(self.tick, pose=(self.away, 0, 0), boot=self.boot))
            self.send(SCAN, self.scan(y=self.away))

    async def drive_until_saved(self, saves: int = 2) -> None:
        """On until so many saves are on disk: what a busy machine writes late, it writes later."""
        async with asyncio.timeout(60):
            while self.report("saves") < saves:
                self.drive(1)
                await asyncio.sleep(0.002)

    async def look(self, scans: int = SCANS_IN_5_S) -> list[bool]:
        """Stand for so many scans; whether it is localized at each."""
        self.sent(POSE)
        for _ in range(scans):
            self.drive(1, still=True)
            await asyncio.sleep(0.005)  # searches run beside
        poses = self.sent(POSE)
        assert not poses[-1].localized or abs(poses[-1].x - self.away) < 0.06
        return [pose.localized for pose in poses]

    async def die(self) -> None:
        """Perception ends and is started again."""
        await self.restart()
        await self.ready()
        self.say()

    def report(self, name: str) -> float:
        return float(self.bus.report()[name] or 0)

    def grid(self) -> OccupancyGrid:
        """The newest map."""
        return next(map_of(data) for key, data in reversed(self.network.sent) if key == MAP.key)

    def known(self) -> float:
        """The area of the newest map [m²]."""
        self.drive(11, still=True)
        grid = self.grid()
        return float(np.count_nonzero(np.frombuffer(grid.cells, np.int8) >= 0)) * 0.0025


def map_of(data: bytes) -> OccupancyGrid:
    return msgspec.msgpack.decode(data, type=OccupancyGrid)


def files(folder: Path) -> list[Path]:
    return sorted(folder.iterdir(), key=lambda path: path.stat().st_mtime_ns)


async def test_after_a_death_the_map_is_there_and_the_robot_found_within_5_s(
    tmp_path: Path,
) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        before = robot.known()
        await robot.die()
        assert all(await robot.look())  # from the first scan on
        assert robot.known() > 0.98 * before
        before = robot.known()
        robot.drive(20)
        assert robot.known() > before  # and it grows on


async def test_a_robot_that_was_driven_on_while_nobody_mapped_is_found(tmp_path: Path) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        robot.away += 0.6
        await robot.die()
        assert all(await robot.look())


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def empty(_: bytes) -> bytes:
    return b""


def flipped(data: bytes) -> bytes:
    """One bit in each 10 kB."""
    chance, spoilt = random.Random(1), bytearray(data)
    for _ in range(0, len(data), 10_000):
        spoilt[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return bytes(spoilt)


@pytest.mark.parametrize("damage", [cut, empty, flipped])
async def test_a_damaged_save_is_refused_and_the_one_before_it_is_taken(
    damage: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        newest = files(tmp_path)[-1]
        newest.write_bytes(damage(newest.read_bytes()))
        await robot.die()
        assert (await robot.look())[-1]
        await robot.drive_until_saved(saves=1)
    told = [line for line in caplog.messages if line.startswith("a saved map is refused: ")]
    assert len(told) == 1
    assert str(newest) in told[0]
    assert newest == files(tmp_path)[-1]  # and it is replaced first


async def test_without_a_whole_save_a_new_map_begins(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        for path in files(tmp_path):
            path.write_bytes(cut(path.read_bytes()))
        await robot.die()
        assert (await robot.look(1))[0]
    assert len([line for line in caplog.messages if "is refused" in line]) == 2


async def test_the_map_of_another_start_of_the_driver_is_left_alone(tmp_path: Path) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        before = robot.known()
        robot.boot, robot.tick, robot.away = 8, 0, 0.0
        await robot.die()
        assert (await robot.look(1))[0]  # nobody looks for it in the old map
        assert robot.known() < before


async def test_a_death_after_a_new_start_of_the_driver_loses_nothing_either(
    tmp_path: Path,
) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        before, saves = robot.known(), robot.report("saves")
        robot.boot, robot.tick = 8, 0
        robot.say()
        await robot.look()
        while robot.report("saves") <= saves + 1:  # the first may be of a lost robot
            await robot.look(1)
        await robot.die()
        assert all(await robot.look())  # from the first scan on
        assert robot.known() > 0.98 * before


async def test_a_robot_that_is_lost_when_perception_dies_is_still_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        saves = robot.report("saves")
        with monkeypatch.context() as patch:
            patch.setattr(localizer, "search", lambda *_: [])  # finds nothing yet
            robot.boot, robot.tick = 8, 0
            robot.say()
            while robot.report("saves") <= saves:
                assert not any(await robot.look(1))
        await robot.die()
        looked = await robot.look()
    assert not looked[0]
    assert looked[-1]


def test_a_robot_that_is_lost_or_found_elsewhere_is_saved_as_it_is(tmp_path: Path) -> None:
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


async def test_saving_changes_nothing_that_is_said(tmp_path: Path) -> None:
    said = []
    for folder in ("", tmp_path):
        async with Walking(folder) as robot:
            robot.say()
            for _ in range(100):
                robot.drive(1)
                await asyncio.sleep(0)
            said.append([data for key, data in robot.network.sent if key == POSE.key])
            said.append([data for key, data in robot.network.sent if key == MAP.key])
    assert said[0] == said[2]
    assert said[1] == said[3]


async def test_a_replay_neither_reads_nor_writes(tmp_path: Path) -> None:
    async with Walking(tmp_path) as robot:
        events = record(robot.network, robot.clock)
        robot.say()
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
async def test_a_robot_that_stands_writes_no_more(tmp_path: Path) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
        await robot.drive_until_saved()
        await robot.look(100)
        saves = robot.report("saves")
        await robot.look(200)
        assert robot.report("saves") == saves


async def test_two_maps_and_the_zones_are_all_that_the_disk_holds(tmp_path: Path) -> None:
    async with Walking(tmp_path / "state") as robot:
        robot.say()
        await robot.drive_until_saved(saves=4)
        await robot.look(50)
    names = {path.name for path in (tmp_path / "state").iterdir()}
    assert names == {"map_0.npz", "map_1.npz", "zones.json"}


async def test_a_disk_that_fills_up_is_reported_once_and_mapping_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    async with Walking(tmp_path) as robot:
        robot.say()
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
    told = [r for r in caplog.records if r.levelno == logging.WARNING and "not saved" in r.message]
    assert len(told) == 1


async def test_a_disk_that_hangs_is_reported_after_30_s_and_holds_nobody_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hangs, real = threading.Event(), autosave.make_folder

    def hang(folder: Path) -> None:
        hangs.wait(60)
        real(folder)

    monkeypatch.setattr(autosave, "make_folder", hang)
    async with Walking(tmp_path) as robot:
        robot.say()
        robot.drive(320, still=True)
        problems = robot.bus.problems
        hangs.set()
        await robot.drive_until_saved(saves=1)
        robot.drive(11)
        assert robot.bus.problems == ()
    assert [problem.code for problem in problems] == ["map_unsaved"]
    assert "map_0.npz: the disk does not take it" in problems[0].text


async def test_a_map_is_loaded_to_grow_on_where_the_state_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    no_folder = tmp_path / "file"
    no_folder.touch()
    async with Walking(no_folder) as robot:
        robot.say()
        robot.drive(40)
        assert (await robot.save("house")).ok
        reply = await ask(robot, MAP_LOAD, MapLoadRequest(name="house", mapping="slam"))
        assert (reply.ok, reply.text) == (True, "loaded house; looking for the robot in it")
        robot.drive(1)
        told = [one.text for one in robot.bus.problems if one.code == "map_unsaved"]
    assert len(told) == 1
    assert told[0].endswith(f"{no_folder}/map_0.npz: Not a directory")


async def test_a_disk_that_takes_no_save_at_all_is_tried_every_4_s_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []

    def refuse(folder: Path) -> None:
        tries.append(folder)
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(autosave, "make_folder", refuse)
    async with Walking(tmp_path) as robot:
        robot.say()
        async with asyncio.timeout(60):
            while not robot.bus.problems:  # which are told once a second
                robot.drive(1)
                await asyncio.sleep(0.002)
        for _ in range(20):
            robot.drive(1)
            await asyncio.sleep(0.002)
    assert len(tries) == 1


@pytest.mark.parametrize("loaded", [False, True])
async def test_zones_outlive_perception_where_the_growing_map_cannot_be_saved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, loaded: bool
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    async with Robot() as robot:
        robot.say()
        robot.drive(40)
        assert (await robot.save("house")).ok
    monkeypatch.setattr(autosave, "KEEP_FREE_BYTES", 10**18)
    config = PerceptionConfig(mapping="slam", state_dir=str(tmp_path / "robot"))
    async with Robot(config if loaded else replace(config, map="house")) as robot:
        robot.say()
        robot.drive(3, still=True)
        if loaded:
            assert (await ask(robot, MAP_LOAD, MapLoadRequest(name="house", mapping="slam"))).ok
        assert (await ask(robot, ZONES_CHANGE, ZonesRequest(zone=LAB))).ok
        for _ in range(2):
            await robot.restart()
            await robot.ready()
            robot.say()
            robot.drive(3, still=True)
            now = await newest(robot)
            assert ([one.name for one in now.zones], now.map) == (["lab"], "house")
            assert now.maps_loaded == loaded
