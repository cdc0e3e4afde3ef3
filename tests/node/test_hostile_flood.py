"""Hostile payloads on every key of a whole robot in memory do not change its speed."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import CMD_VEL, ENABLE, ESTOP, RELEASE, TOPICS, Service
from gigabrain_zenoh.config.settings import Resume
from gigabrain_zenoh.qa.faults.hostile import codec_of, hostile_payloads, hostile_values
from gigabrain_zenoh.testing.in_memory import RobotInMemory

TICKS = 200
PER_TICK = 100  # 20000 payloads in total


async def speeds(folder: Path, resume: Resume, per_tick: int) -> list[float]:
    """Return the body's speed in each tick [m/s], with `per_tick` payloads delivered before it."""
    payloads = flood(seed=3)
    async with RobotInMemory(folder, resume=resume) as robot:
        for _ in range(TICKS):
            for key, payload in itertools.islice(payloads, per_tick):
                robot.network.deliver(key, payload)
            await robot.go(1)
        return robot.body.speeds


def flood(seed: int) -> Iterator[tuple[str, bytes]]:
    """Yield endless payloads: one for each key in turn, and one for CMD_VEL before each."""
    endless = [(topic.at("x"), hostile_payloads(topic.type, seed)) for topic in TOPICS]
    commands = hostile_payloads(CmdVel, seed + 1)
    while True:
        for key, payloads in endless:
            yield CMD_VEL.key, next(commands)
            yield key, next(payloads)


async def test_hostile_payloads_do_not_change_the_speed_of_a_driving_robot(tmp_path: Path) -> None:
    calm = await speeds(tmp_path / "calm", "auto", 0)
    assert max(calm) > 0.25
    assert await speeds(tmp_path / "flooded", "auto", PER_TICK) == calm


async def test_hostile_payloads_do_not_move_a_robot_that_is_not_enabled(tmp_path: Path) -> None:
    assert set(await speeds(tmp_path, "manual", PER_TICK)) == {0.0}


async def test_valid_commands_without_the_boot_of_the_robot_are_refused(tmp_path: Path) -> None:
    """Values such as -0.0, an empty name or 1.5 m/s decode, but echo no tick of this robot.

    Those in the name of control make safety see control as silent, so it stops the robot.
    """
    values, valid = hostile_values(CmdVel, 5), 0
    async with RobotInMemory(tmp_path, resume="auto") as robot:
        await robot.go(100)
        assert robot.body.speeds[-1] == pytest.approx(0.26)
        for _ in range(100):
            for value in itertools.islice(values, 50):
                payload = msgspec.msgpack.encode(value)
                valid += is_valid(payload)
                robot.network.deliver(CMD_VEL.key, payload)
            await robot.go(1)
        assert valid > 500
        assert robot.counters["refused_boot"] == valid
        assert robot.state
        assert (robot.state.pose.y, robot.state.pose.yaw) == (0.0, 0.0)
        assert min(robot.body.speeds) == 0.0
        assert max(robot.body.speeds) == pytest.approx(0.26)


def is_valid(payload: bytes) -> bool:
    try:
        codec_of(CmdVel).decode(payload)
    except ValueError:
        return False
    return True


@pytest.mark.parametrize("service", [ESTOP, RELEASE, ENABLE], ids=lambda service: service.key)
async def test_hostile_requests_are_refused_with_a_reason(
    tmp_path: Path, service: Service[Any, Any]
) -> None:
    async with RobotInMemory(tmp_path, resume="manual") as robot:
        await robot.go(30)
        stranger = robot.network.transport()
        for payload in itertools.islice(hostile_payloads(service.request, 7), 500):
            if not payload:  # an empty request is valid: all defaults
                continue
            replies = await stranger.query(service.key, payload, "", 60.0, service.priority)
            assert replies
            assert all(isinstance(reply, str) and "not a valid" in reply for reply in replies)
        await robot.go(1)
        assert robot.mode == "latched"
        assert robot.state
        assert robot.state.gate.estop_generation == 0
