"""Hostile bytes on every key of a driving robot are dropped and counted, without other effect."""

import json
import math
import random
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.examples import EXAMPLES
from gigabrain_schemas.topics import (
    CMD_VEL,
    ENABLE,
    ESTOP,
    RELEASE,
    STATE,
    TOPICS,
    Service,
    Topic,
)
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.qa.faults.hostile import replaced
from gigabrain_zenoh.qa.probe import NODES, Probe, probing
from gigabrain_zenoh.testing.processes import AVOID, Home, endpoint_of, robot_of
from gigabrain_zenoh.testing.waiting import until
from tests.unit.schemas.plain import as_map, numbers, refuses

LISTENERS = {
    "robot/scan": ("perception", "safety"),
    "robot/state": ("decision", "control", "safety"),
    "robot/body": ("perception", "decision", "control", "safety"),
    "robot/world": ("decision", "safety"),
    "robot/intent": ("control", "safety"),
    "robot/teleop": ("control",),
    "robot/cmd_vel": ("driver", "safety"),
    "robot/safety": ("driver", "control"),
}
BAD: tuple[Any, ...] = (math.nan, math.inf, -math.inf, True, "0.3", None, [], {}, 1e300, -1)
MEGABYTE = 1 << 20


def hostile(topic: Topic[Any], chance: random.Random) -> list[bytes]:
    """Return payloads of every hostile kind; none is a valid message."""
    name = topic.type.__name__
    whole, good = as_map(name), msgspec.msgpack.encode(EXAMPLES[name])
    missing = [{k: v for k, v in whole.items() if k != field} for field in whole]
    wrong = [replaced(whole, path, bad) for path in numbers(name) for bad in BAD]
    maps = [*missing, {**whole, "linear_xx": 1.0}, *chance.sample(wrong, min(30, len(wrong)))]
    payloads = [
        b"", b"\xc1", b"\x00" * 64, b"{", b"[" * 5000, b'{"linear_x": NaN}', b"\xdf" + b"\xff" * 4,
        *(chance.randbytes(chance.randrange(1, 400)) for _ in range(20)),
        *(good[: chance.randrange(len(good))] for _ in range(10)),
        good + b"\x00", b"\x80" * (MEGABYTE + 1), good * (1 + topic.max_bytes // len(good)),
        *map(msgspec.msgpack.encode, maps),
        *map(msgspec.json.encode, maps),
    ]  # fmt: skip
    return [payload for payload in payloads if refuses(name, payload)]


@asynccontextmanager
async def stranger_at(endpoint: Endpoint) -> AsyncIterator[tuple[ZenohTransport, Bus]]:
    """Connect an unknown client, which follows the robot's clock."""
    transport = await ZenohTransport.open(endpoint)
    bus = Bus(transport, Clock(), "stranger")
    bus.latest(STATE)
    await until(lambda: bus.time.boot, "the robot's clock")
    yield transport, bus
    await bus.close()


@pytest.mark.slow
async def test_a_flood_on_every_key_is_dropped_and_counted_and_the_robot_drives_on(
    home: Home,
) -> None:
    path, chance = home.folder / "report.json", random.Random(7)
    # in lock-step time waits for the brain, so only the flood could stop the robot
    options = ("--headless", "--speed", "2", "--seconds", "30", "--report", str(path))
    demo = home.start(*AVOID, *options)
    endpoint = await robot_of(home, demo)
    async with probing(endpoint) as robot, stranger_at(endpoint) as (transport, _):
        await until(lambda: robot.state.gate.mode == "enabled", "driving")
        pids, enables = await robot.pids(), robot.state.gate.enables
        for topic in TOPICS:
            for number, payload in enumerate(hostile(topic, chance)):
                transport.publish(topic, topic.at("stranger"), payload, "")
                if number % 20 == 0:
                    await robot.ticks(1)
        await robot.ticks(100)  # until the next health of each process
        assert await robot.pids() == pids
        assert (robot.state.gate.mode, robot.state.gate.enables) == ("enabled", enables)
        for key, processes in LISTENERS.items():
            for process in processes:
                assert robot.health[process].rejected[key] > 0, (key, process)
        rejected = Counter(
            (record.process, record.data["key"])
            for record in robot.logs
            if record.event == "rejected"
        )
        assert {("driver", "robot/cmd_vel"), ("control", "robot/teleop")} <= rejected.keys()
        assert max(rejected.values()) == 1
    assert await demo.ended() == 0
    report = json.loads(path.read_bytes())
    assert report["rejected_messages"] > 500
    assert (report["contacts"], report["restarts"], report["verdict"]) == (0, 0, "ok")


@pytest.fixture(scope="module")
def deployment(shared_home: Home) -> Path:
    file = shared_home.deployment(world="arena", resume="auto")
    shared_home.start("up", str(file))
    return file


@pytest.fixture
async def robot(deployment: Path) -> AsyncIterator[Probe]:
    """The robot, which drives autonomously."""
    async with probing(endpoint_of(deployment)) as onlooker:
        await until(lambda: onlooker.state.gate.mode == "enabled", "driving")
        yield onlooker


@pytest.mark.parametrize("service", [ESTOP, RELEASE, ENABLE], ids=lambda service: service.key)
@pytest.mark.parametrize(
    "payload",
    [b"\xc1", b"{", b'{"take": 1, "source": "x"}', b'{"estop_generation": NaN}', b"\x80" * 70_000],
    ids=["no MessagePack", "half JSON", "a number for a boolean", "NaN", "70 kB"],
)
async def test_an_invalid_request_is_refused_with_a_reason(
    robot: Probe, deployment: Path, service: Service[Any, Any], payload: bytes
) -> None:
    async with stranger_at(endpoint_of(deployment)) as (transport, _):
        replies = await transport.query(service.key, payload, "", 5.0, service.priority)
    assert len(replies) == 1
    assert isinstance(replies[0], str)
    assert replies[0].startswith(f"not a valid {service.request.__name__}: ")
    await robot.ticks(10)
    await until(lambda: robot.state.gate.mode == "enabled", "it drives on")
    assert robot.state.gate.estop_generation == 0


async def test_a_stranger_cannot_drive_a_body_that_has_a_commander(
    robot: Probe, deployment: Path
) -> None:
    before = (await robot.truth())["ticks"]
    async with stranger_at(endpoint_of(deployment)) as (_, bus):
        for _ in range(50):  # full speed backwards, with the right boot and newest tick
            bus.publish(CMD_VEL, CmdVel(linear_x=-0.26, source="stranger"))
            await robot.ticks(1)
    slowest = min(s.velocity.linear_x for s in robot.states if s.tick > before)
    assert slowest > -0.02
    refused = "refused_commander"
    await until(lambda: robot.health["driver"].counters.get(refused, 0) >= 40, "the count")
    assert robot.state.gate.commander == "control"
    assert all(name in robot.health for name in NODES)
