"""Perception with mapping: for each scan a world, then a pose, and at times a map."""

import asyncio
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Message
from gigabrain_schemas.body import LinkHealth
from gigabrain_schemas.brain import OccupancyGrid, PoseInMap
from gigabrain_schemas.examples import example
from gigabrain_schemas.safety import Health
from gigabrain_schemas.sensors import ImuData
from gigabrain_schemas.topics import HEALTH, MAP, POSE, SCAN, STATE, WORLD, ZONES, Topic
from gigabrain_zenoh.codec import Codec
from gigabrain_zenoh.config import loading as config
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.mapping import map_file, occupancy_grid
from gigabrain_zenoh.perception.mapper import chart_of
from gigabrain_zenoh.runtime.services import publish_health
from gigabrain_zenoh.testing.samples import scan, state
from tests.node.mapping_robot import Robot
from tests.unit.mapping.houses import HOUSE, Rooms, at, box, drawn

START = at(3.0, 2.0)


@pytest.fixture(autouse=True)
def own_maps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    return tmp_path / "gigabrain" / "maps"


async def test_each_scan_gives_a_world_and_then_a_pose_with_its_basis() -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(3)
        keys = [key for key, _ in robot.network.sent if key in (WORLD.key, POSE.key)]
        poses = robot.sent(POSE)
    assert keys == [WORLD.key, POSE.key] * 3
    assert [pose.basis for pose in poses] == [5, 10, 15]
    assert [pose.x for pose in poses] == pytest.approx([0.02, 0.04, 0.06], abs=0.01)
    assert all(pose.localized for pose in poses)
    assert len(poses[0].covariance) == 9


async def test_a_scan_that_arrives_before_its_state_waits_for_it() -> None:
    poses = []
    for scan_first in (False, True):
        async with Robot() as robot:
            robot.publish_body()
            robot.drive(1)
            robot.tick += 5
            first = robot.scan()
            state_of_scan = state(10, pose=(0.04, 0, 0))
            for send in (1, 0) if scan_first else (0, 1):
                robot.send(*((STATE, state_of_scan), (SCAN, first))[send])  # type: ignore[misc]
            poses.append([(pose.basis, pose.x, pose.y) for pose in robot.sent(POSE)])
    assert poses[0] == poses[1]
    assert [basis for basis, _, _ in poses[0]] == [5, 10]


async def test_a_map_started_later_has_the_same_origin() -> None:
    poses = []
    for start_tick in (0, 100):  # when perception starts
        async with Robot() as robot:
            robot.publish_body()
            robot.tick = start_tick
            robot.drive(22 - start_tick // 5)
            poses.append(robot.sent(POSE)[-1])
    old, new = poses
    assert (new.x, new.y, new.yaw) == pytest.approx((old.x, old.y, old.yaw), abs=0.02)
    assert old.x == pytest.approx(0.44, abs=0.02)


async def test_a_changed_map_is_published_once_a_second() -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(30)
        maps = robot.sent(MAP)
    assert [occupancy_grid.basis for occupancy_grid in maps] == [5, 55, 105]
    last: OccupancyGrid = maps[-1]
    assert last.resolution == 0.05
    cells = np.frombuffer(last.cells, np.int8).reshape(last.height, last.width)
    column, row = int((0.5 - last.origin_x) / 0.05), int((0.0 - last.origin_y) / 0.05)
    assert 0 <= cells[row, column] < 20  # free: the robot passed it


@pytest.mark.parametrize("topic", [MAP, ZONES])
async def test_a_foreign_map_or_zones_are_replaced_at_the_next_scan(topic: Topic[Message]) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(3)
        own = robot.sent(topic)
        robot.send(topic, replace(example(topic.type), boot=robot.boot, tick=robot.tick))
        robot.drive(1)
        again = robot.sent(topic)
        robot.drive(1)
        assert robot.sent(topic) == []
    assert len(own) == 1
    assert [one.basis for one in again] == [20]
    header = {"stamp_ns": 0, "seq": 0, "tick": 0, "basis": 0}
    assert replace(again[0], **header) == replace(own[0], **header)


async def test_bad_scans_are_skipped_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(2)
        good = robot.scan()
        for _ in range(3):
            robot.send(SCAN, scan(np.full(200, 2.0), robot.tick))  # wrong length
        robot.send(SCAN, replace(good, basis=good.basis + 1000))  # from the future
        robot.drive(2)
        assert robot.bus.counters["scans_left_out"] == 4
        poses: list[PoseInMap] = robot.sent(POSE)
    assert [pose.basis for pose in poses] == [5, 10, 15, 20]
    logged = [record.message for record in caplog.records if "not mapped" in record.message]
    assert logged == [
        "scan not mapped: the scan has 200 beams, the body's lidar 360",
        "scan not mapped: its tick 1010 is in the future at tick 15",
    ]


@pytest.mark.parametrize(("early", "warnings"), [(1, 0), (2, 1)])
async def test_one_scan_before_its_odometry_is_skipped_silently(
    early: int, warnings: int, caplog: pytest.LogCaptureFixture
) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.tick += 5
        robot.send(STATE, state(robot.tick + 1, pose=(0.0, 0.0, 0.0)))
        for _ in range(early):
            robot.send(SCAN, robot.scan())
        robot.drive(2)
        assert robot.bus.counters["scans_left_out"] == early
    assert len([r for r in caplog.records if "no odometry for its tick" in r.message]) == warnings


async def test_a_jump_of_the_odometry_is_reported_and_the_robot_relocalized(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20)
        robot.tick += 5
        robot.send(STATE, state(robot.tick, pose=(9.0, 9.0, 0)))
        robot.send(SCAN, robot.scan())
        assert not robot.sent(POSE)[-1].localized
        base = robot.tick
        for _ in range(40):
            robot.tick += 5
            robot.send(STATE, state(robot.tick, pose=(9.0, 9.0, 0)))
            robot.send(SCAN, scan(robot.rooms.ranges(at(3, 2 + 0.004 * base, 90)), robot.tick))
            await asyncio.sleep(0.005)  # the search runs in a thread
        pose = robot.sent(POSE)[-1]
    assert pose.localized
    assert pose.x == pytest.approx(0.004 * (base - 5), abs=0.04)
    assert "not localized: the odometry has jumped" in caplog.messages


async def test_the_last_turn_rate_of_a_lost_body_does_not_turn_its_pose() -> None:
    turning = ImuData(
        orientation=(0, 0, 0, 1), angular_velocity=(0, 0, 1.0), linear_acceleration=(0, 0, 9.8)
    )
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(10, still=True)
        lost = replace(state(), boot=robot.boot, imu=turning, link=LinkHealth(connected=False))
        for _ in range(80):  # the driver repeats what it knows
            robot.tick += 1
            robot.send(STATE, replace(lost, tick=robot.tick))
        robot.drive(5, still=True)
        poses = robot.sent(POSE)
    assert all(pose.localized for pose in poses)
    assert [pose.yaw for pose in poses] == pytest.approx([0.0] * 15, abs=0.01)


async def test_after_a_restart_of_the_driver_the_map_stays_and_the_robot_is_localized() -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20, still=True)
        before = robot.sent(MAP)[-1]
        robot.boot, robot.tick = 8, 0
        robot.publish_body()
        robot.drive(1, still=True)
        assert not robot.sent(POSE)[-1].localized
        for _ in range(40):
            robot.drive(1, still=True)
            await asyncio.sleep(0.005)
        maps = robot.sent(MAP)
        robot.drive(1, still=True)
        pose = robot.sent(POSE)[-1]
    assert maps[0].boot == 8
    assert (maps[0].width, maps[0].origin_x) == (before.width, before.origin_x)
    assert pose.localized
    assert (pose.x, pose.y) == pytest.approx((0.0, 0.0), abs=0.05)


async def test_a_robot_lost_for_10_s_is_reported_with_the_command_that_helps(
    caplog: pytest.LogCaptureFixture,
) -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20, still=True)
        robot.boot, robot.tick = 8, 0  # the driver restarts, and the body is elsewhere
        robot.rooms = Rooms(box(-1, -1, 6, 12))
        robot.publish_body()
        robot.drive(99, still=True)
        early_problems = robot.bus.problems
        robot.drive(11, still=True)
        assert not robot.sent(POSE)[-1].localized
        late_problems = robot.bus.problems
        robot.rooms = Rooms(HOUSE)
        for _ in range(60):
            robot.drive(1, still=True)
            await asyncio.sleep(0.005)
        assert robot.sent(POSE)[-1].localized
        assert robot.bus.problems == early_problems == ()
    assert [problem.code for problem in late_problems] == ["not_localized"]
    assert "`gigabrain pose X Y`" in late_problems[0].remedy
    assert caplog.messages.count(f"{late_problems[0].text}: {late_problems[0].remedy}") == 1


async def test_a_full_map_is_logged_once_and_reported_in_the_health(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(occupancy_grid, "MAX_CELLS", 100)
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(30)
        problems = robot.bus.problems
        health = asyncio.ensure_future(publish_health(robot.bus))
        await asyncio.sleep(0)
        health.cancel()
        health_payloads = [data for key, data in robot.network.sent if key == HEALTH.at("node")]
    assert [problem.code for problem in problems] == ["map_full"]
    assert problems[0].text == "the map is full: 140 m long; what lies beyond is left out"
    assert Codec(Health, HEALTH.max_bytes).decode(health_payloads[-1]).problems == problems
    assert caplog.messages.count(f"{problems[0].text}: map a large site in parts") == 1


def test_a_map_without_mapping_is_refused_with_its_line() -> None:
    with pytest.raises(
        ConfigError, match="f:2: map: needs mapping; set `mapping` to slam or localize"
    ):
        config.loads("sectors: 8\nmap: house\n", PerceptionConfig, "f")
    assert config.loads('mapping: "off"', PerceptionConfig, "f") == PerceptionConfig()


def test_a_missing_empty_or_unnamed_map_is_refused_at_the_start(own_maps: Path) -> None:
    with pytest.raises(ConfigError, match="expected a saved map, as mapping is 'localize'"):
        chart_of(PerceptionConfig(mapping="localize"))
    with pytest.raises(ConfigError, match=r"gone\.yaml: no such file"):
        chart_of(PerceptionConfig(mapping="localize", map="gone"))
    own_maps.mkdir(parents=True)
    (own_maps / "blank.pgm").write_bytes(b"P5\n9 9\n255\n" + bytes([205]) * 81)
    (own_maps / "blank.yaml").write_text("image: blank.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n")
    with pytest.raises(ConfigError, match=r"blank\.yaml: the map is empty: 0\.00 m² of it"):
        chart_of(PerceptionConfig(mapping="localize", map="blank"))
    np.savez(own_maps / "blank.graph.npz", front=np.zeros(3))
    with pytest.raises(ConfigError, match=r"blank\.graph\.npz: no pose graph: it has no 'li"):
        chart_of(PerceptionConfig(mapping="slam", map="blank"))
    with pytest.raises(ConfigError, match="the map's pose graph"):
        chart_of(PerceptionConfig(mapping="slam", map="gone"))
    map_file.save(own_maps / "bare.yaml", drawn(Rooms(HOUSE), START), {"poses": np.zeros((1, 3))})
    with pytest.raises(ConfigError, match="no pose graph: "):
        chart_of(PerceptionConfig(mapping="slam", map="bare"))


async def test_an_unchanged_map_is_published_again_every_two_seconds() -> None:
    async with Robot() as robot:
        robot.publish_body()
        robot.drive(20)
        assert (await robot.save("house")).ok
    async with Robot(PerceptionConfig(mapping="localize", map="house")) as robot:
        robot.publish_body()
        robot.drive(45, still=True)
        maps = robot.sent(MAP)
    assert [occupancy_grid.basis for occupancy_grid in maps] == [5, 105, 205]
    assert len({occupancy_grid.cells for occupancy_grid in maps}) == 1
