"""A robot driven by Open-RMF: a client with its adapter's libraries, after its source."""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Ros2Config
from gigabrain_zenoh.gateway.gateway import serve
from gigabrain_zenoh.ros2.memory import MemoryNetwork
from gigabrain_zenoh.ros2.types import Types
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing import samples
from gigabrain_zenoh.testing.processes import Home, endpoint_of, repeat
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.foreign import PROGRAMS, built, free_fleet
from tests.system.keys import site

SILENT = ("no answer", "Timeout")
UNKNOWN, SUCCEEDED, CANCELED, ABORTED = 0, 4, 5, 6
ACTIVE = (1, 2, 3)  # accepted, executing, canceling
CONFIG: dict[str, Any] = {"mode": "client", "scouting": {"multicast": {"enabled": False}}}


class Adapter:
    """The client, in a separate process."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self._process = process

    async def call(self, *line: Any) -> Any:
        """Send a call; return its answer."""
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.write(json.dumps(line).encode() + b"\n")
        return json.loads(await self._process.stdout.readline())

    async def poll(self, name: str, done: Callable[[Any], bool]) -> Any:
        """Repeat a call until `done` accepts its answer; return the answer."""
        async with asyncio.timeout(120):
            while True:
                if done(found := await self.call(name)):
                    return found
                await asyncio.sleep(0.05)

    async def next(self, name: str) -> Any:
        """Repeat a call until it has an answer; return it."""
        return await self.poll(name, lambda found: found is not None)

    async def end(self) -> Any:
        """Wait for the end of the present goal; return its status."""
        return await self.poll("status", lambda found: found not in ACTIVE)


@pytest.fixture(scope="module")
def interpreter() -> Path:
    return built(free_fleet)


@contextlib.asynccontextmanager
async def adapter(
    interpreter: Path, folder: Path, config: dict[str, Any]
) -> AsyncIterator[Adapter]:
    """Yield a client for the robot `red`."""
    file = folder / "open_rmf.json5"
    file.write_text(json.dumps(CONFIG | config))
    process = await asyncio.create_subprocess_exec(
        str(interpreter), str(PROGRAMS / "open_rmf.py"), "red", str(file),
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin
    try:
        yield Adapter(process)
    finally:
        process.stdin.close()
        try:
            await asyncio.wait_for(process.wait(), 10)
        except TimeoutError:
            process.kill()


async def refused(rmf: Adapter) -> None:
    """Send malformed requests to each service; check the error texts."""
    for name in ("send_goal", "get_result", "cancel_goal"):
        for payload in ("", "00010000ff", "0001000001" + "00" * 70_000):
            assert await rmf.call("garbage", name, payload) not in ("", "no answer")


async def sent(rmf: Adapter, begin: list[float], x: float, y: float) -> None:
    """Send a goal at (x, y) relative to the start, again while there is no map."""
    while True:
        assert await rmf.call("navigate", begin[0] + x, begin[1] + y) is True
        while (status := await rmf.call("status")) in ACTIVE:
            if (told := await rmf.call("feedback")) and told[-1]:
                return
        assert status == ABORTED


@pytest.mark.slow
async def test_open_rmf_sends_follows_and_cancels_goals_and_reads_battery_and_pose(
    home: Home, interpreter: Path, tmp_path: Path
) -> None:
    file = home.deployment(
        body="turtlebot3_burger",
        world="arena",
        namespace="red",
        resume="auto",
        ros2={"free_fleet": True},
        perception={"mapping": "slam"},
        decision={"behaviour": "navigate"},
    )
    home.start("up", str(file))
    endpoint, states, healths = endpoint_of(file), list[RobotState](), list[Health]()
    async with (
        asyncio.timeout(400),
        connect(endpoint, "test", timeout_s=None) as bus,
        adapter(interpreter, tmp_path, {"connect": {"endpoints": list(endpoint.connect)}}) as rmf,
    ):
        bus.subscribe(STATE, lambda _, state: states.append(state))
        bus.subscribe(HEALTH, lambda _, health: healths.append(health), name="ros2")
        begin = await rmf.next("pose")
        assert 0.0 < await rmf.next("battery") <= 1.0
        await until(lambda: states and states[-1].gate.mode == "enabled", "it may drive")

        await refused(rmf)
        await until(lambda: healths and healths[-1].counters.get("free_fleet_refused") == 9)
        assert await rmf.call("stop") == 0  # with no goal to cancel
        assert abs(states[-1].velocity.linear_x) < 0.01

        await sent(rmf, begin, 0.6, 0.0)
        frame, distance, _, _ = await rmf.call("feedback")
        assert frame == "map"
        assert 0.0 < distance < 2.0
        await until(lambda: states[-1].velocity.linear_x > 0.05, "it drives")
        assert await rmf.call("stop") == 0
        assert await rmf.end() == CANCELED
        await until(lambda: abs(states[-1].velocity.linear_x) < 0.01, "it stands")
        await sent(rmf, begin, 0.4, 0.0)
        assert await rmf.end() == SUCCEEDED
        assert await rmf.call("stop") == 0
        end = await rmf.call("pose")
        assert end[:2] == pytest.approx([begin[0] + 0.4, begin[1]], abs=0.3)

        await sent(rmf, begin, 0.0, 0.0)
        (before,) = home.processes("ros2")
        os.kill(before, signal.SIGKILL)
        assert await rmf.poll("status", lambda found: found not in (*ACTIVE, *SILENT)) == UNKNOWN
        await sent(rmf, begin, 0.4, 0.0)
        assert await rmf.end() == SUCCEEDED


async def test_with_keys_the_identity_of_a_dispatcher_is_enough(
    fleet: Path, interpreter: Path, tmp_path: Path
) -> None:
    types, config = Types(), Ros2Config(free_fleet=True)
    async with site(fleet) as net:
        robot = Bus(await net.client("robot@red", "red"), Clock(), "driver")
        robot.time.boot = samples.BOOT
        gateway = Bus(await net.client("process.ros2@red", "red"), Clock(), "ros2")
        ready = asyncio.Event()
        ros = MemoryNetwork(types).transport()
        running = asyncio.ensure_future(serve(config, gateway, ros, types, ready.set))
        keys = fleet / "dispatcher"
        tls = {
            "enable_mtls": True,
            "root_ca_certificate": str(keys / "ca.crt"),
            "connect_certificate": str(keys / "identity.crt"),
            "connect_private_key": str(keys / "identity.key"),
        }
        at = net.address.replace("tcp/", "tls/")
        where = {"connect": {"endpoints": [at]}, "transport": {"link": {"tls": tls}}}
        async with adapter(interpreter, tmp_path, where) as rmf:
            await ready.wait()
            charge: list[float] = []

            def send() -> None:
                robot.time.tick += 1
                robot.publish(STATE, samples.state(robot.time.tick, battery=75.0))

            async def read() -> None:
                charge.append(await rmf.next("battery"))

            reading = asyncio.ensure_future(read())
            await repeat(send, lambda: charge)
            await reading
            assert charge == [0.75]
            assert await rmf.call("navigate", 1.0, 0.0) is True
            assert await rmf.end() == ABORTED  # there is no server of goals
            assert await rmf.call("stop") == 0
        running.cancel()
        await asyncio.wait((running,))
