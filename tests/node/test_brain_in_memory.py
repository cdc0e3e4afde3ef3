"""A whole robot, in memory and in fake time: it drives, and a silent process stops it."""

import itertools
from pathlib import Path

import msgspec
import pytest

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import EnableRequest, EstopRequest, GateReply, ReleaseRequest
from gigabrain_schemas.topics import CMD_VEL, ENABLE, ESTOP, RELEASE
from gigabrain_zenoh.testing.in_memory import RobotInMemory, ticks_until, travelled

# process, ticks until the body brakes, and the longest way until it stands still [m]
SILENCES = [
    ("perception", 13, 0.15),
    ("decision", 6, 0.10),
    ("control", 6, 0.10),
    ("safety", 8, 0.10),
]


async def driving(robot: RobotInMemory) -> None:
    """Wait until the robot drives at full speed."""
    await robot.go(100)
    assert robot.mode == "enabled"
    assert robot.body.speeds[-1] == pytest.approx(0.26)


async def release(robot: RobotInMemory, generation: int) -> GateReply:
    request = ReleaseRequest(estop_generation=generation, source="test")
    return (await robot.operator.ask(RELEASE, request))[0]


async def enable(robot: RobotInMemory) -> GateReply:
    return (await robot.operator.ask(ENABLE, EnableRequest(source="control")))[0]


async def press(robot: RobotInMemory) -> GateReply:
    return (await robot.operator.ask(ESTOP, EstopRequest(source="test")))[0]


def assert_stops(speeds: list[float], ticks: int, metres: float) -> None:
    """Assert that it brakes in time and on a ramp, stays at rest, and stops within `metres`."""
    assert ticks_until(speeds, lambda v: v < 0.259) - 1 <= ticks
    rest_tick = ticks_until(speeds, lambda v: v == 0.0)
    assert rest_tick - 1 <= ticks + 13  # 0.26 m/s at 1 m/s²
    assert set(speeds[rest_tick:]) <= {0.0}
    assert travelled(speeds) <= metres
    assert max(a - b for a, b in itertools.pairwise(speeds)) < 0.0201


async def test_it_enables_itself_and_drives_straight_ahead(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        speeds = await robot.go(200)
        assert robot.state
        pose = robot.state.pose
    assert pose.x == pytest.approx(travelled(speeds), abs=0.006)
    assert pose.x > 0.5
    assert (pose.y, pose.yaw) == (0.0, 0.0)
    gains = [b - a for a, b in itertools.pairwise(speeds)]
    assert max(gains) == pytest.approx(0.02)  # 1 m/s²
    assert min(gains) >= 0.0
    assert speeds[-1] == pytest.approx(0.26)


@pytest.mark.parametrize(("name", "ticks", "metres"), SILENCES)
async def test_a_dead_process_stops_the_body_until_its_restart(
    name: str, ticks: int, metres: float, tmp_path: Path
) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        await robot.kill(name)
        assert_stops(await robot.go(100), ticks, metres)
        assert robot.mode == "idle"
        robot.start(name)
        await robot.go(100)
        assert robot.body.speeds[-1] == pytest.approx(0.26)
        assert robot.counters["stale_commands_executed"] == 0


@pytest.mark.parametrize(("name", "ticks", "metres"), SILENCES)
async def test_a_frozen_process_stops_the_body_and_thawed_moves_nothing(
    name: str, ticks: int, metres: float, tmp_path: Path
) -> None:
    async with RobotInMemory(tmp_path, resume="manual") as robot:
        await robot.go(50)
        await release(robot, 0)
        await enable(robot)
        await driving(robot)
        robot.freeze(name)
        assert_stops(await robot.go(250), ticks, metres)
        robot.thaw(name)
        assert set(await robot.go(100)) == {0.0}  # all missed messages arrive at once
        assert robot.mode == "idle"
        assert robot.counters["stale_commands_executed"] == 0
        assert (await enable(robot)).ok
        await driving(robot)


async def test_with_manual_resume_it_moves_only_when_released_and_enabled(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path, resume="manual") as robot:
        assert set(await robot.go(100)) == {0.0}
        assert (robot.mode, robot.causes) == ("latched", ["boot"])
        assert not (await enable(robot)).ok
        assert (await release(robot, 0)).ok
        assert set(await robot.go(100)) == {0.0}
        assert robot.mode == "idle"
        assert (await enable(robot)).ok
        assert (await robot.go(3))[0] == 0.0
        await driving(robot)


async def test_an_estop_stops_in_the_same_tick_and_stays_latched(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        reply = await press(robot)
        assert (reply.ok, reply.gate.mode, reply.gate.estop_generation) == (True, "latched", 1)
        assert set(await robot.go(200)) == {0.0}
        assert (robot.mode, robot.causes) == ("latched", ["estop"])
        assert not (await enable(robot)).ok
        assert not (await release(robot, 0)).ok  # generation 0 is older than the e-stop
        assert (await release(robot, 1)).ok
        assert set(await robot.go(100)) == {0.0}  # it does not resume by itself
        assert (await enable(robot)).ok
        await driving(robot)


async def test_an_estop_survives_a_restart_of_the_driver(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        await press(robot)
        await robot.kill("driver")
        robot.start_driver()
        assert set(await robot.go(200)) == {0.0}
        assert (robot.mode, robot.causes) == ("latched", ["estop"])
        assert (await release(robot, 1)).ok


async def test_after_a_restart_of_the_driver_the_brain_drives_again(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        assert robot.state
        boot = robot.state.boot
        await robot.kill("driver")
        robot.start_driver()
        await driving(robot)
        assert robot.state.boot != boot
        assert robot.counters["stale_commands_executed"] == 0


async def test_replayed_commands_move_nothing(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path, resume="manual") as robot:
        await robot.go(50)
        await release(robot, 0)
        await enable(robot)
        await driving(robot)
        await press(robot)
        await robot.go(30)
        await release(robot, 1)
        await robot.kill("control")
        recorded = [payload for key, payload in robot.network.sent if key == CMD_VEL.key]
        assert len(recorded) > 150
        for payload in recorded:
            robot.network.deliver(CMD_VEL.key, payload)
        assert set(await robot.go(50)) == {0.0}
        assert (await enable(robot)).ok is False
        assert robot.counters["refused_old"] > 100


async def test_the_count_of_estops_survives_a_restart(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        await press(robot)
        assert (await press(robot)).gate.estop_generation == 2
        await robot.kill("driver")
        robot.start_driver()
        await robot.go(50)
        assert not (await release(robot, 1)).ok  # generation 1 is not the newest e-stop
        assert (await release(robot, 2)).ok


async def test_a_nan_speed_stops_the_body_at_once(tmp_path: Path) -> None:
    async with RobotInMemory(tmp_path, resume="manual") as robot:
        await robot.go(50)
        await release(robot, 0)
        await enable(robot)
        await driving(robot)
        assert robot.state
        wrong = CmdVel(linear_x=float("nan"), source="control", boot=robot.state.boot)
        robot.network.deliver(CMD_VEL.key, msgspec.msgpack.encode(wrong))
        assert await robot.go(1) == [0.0]
        assert (robot.mode, robot.causes) == ("stopping", ["nan"])
        assert set(await robot.go(50)) == {0.0}
        assert robot.mode == "idle"


async def test_garbage_on_every_key_leaves_the_drive_alone(tmp_path: Path) -> None:
    garbage = (
        b"",
        b"\xc1",
        b"\xff" * 100,
        b"{}",
        b"[]",
        b"null",
        b'{"linear_x": true}',
        b"x" * 2**21,
    )
    async with RobotInMemory(tmp_path) as robot:
        await driving(robot)
        keys = {key for key, _ in robot.network.sent}
        assert len(keys) == 8
        for payload in garbage:
            for key in keys:
                robot.network.deliver(key, payload)
            assert await robot.go(5) == pytest.approx([0.26] * 5)
        assert robot.mode == "enabled"
