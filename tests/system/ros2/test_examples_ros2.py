"""`examples/ros2`: in each language a program reads scans, and stops the robot."""

import asyncio
import contextlib
import os
import subprocess
from collections.abc import AsyncIterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, free_port
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT
from tests.ros2.foreign import built, rclnodejs
from tests.ros2.judge import Judge

EXAMPLES = ROOT / "examples/ros2"
PICO = os.environ.get("ZENOH_PICO", "")  # folder of a built zenoh-pico, which is in no registry
TIMEOUT_S = 400.0
NOTHING_IS_NEAR, ALL_IS_NEAR = "0.001", "100"  # [m]


@contextlib.asynccontextmanager
async def driving(home: Home, router: str, **ros2: Any) -> AsyncIterator[Any]:
    """Run a robot with the gateway, and let it drive; yield its newest state."""
    file = home.deployment(body="mock", resume="auto", router=router, ros2=ros2)
    home.start("up", str(file))
    session = connect(Endpoint(connect=(router,)), "test", timeout_s=None)
    async with asyncio.timeout(TIMEOUT_S), session as bus:
        latest = bus.latest(STATE)
        await until(lambda: latest.newest and latest.newest.gate.mode == "enabled", "it drives")
        yield latest


@contextlib.asynccontextmanager
async def started(
    command: tuple[str, ...], environment: Mapping[str, str]
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a program until the end of the context."""
    process = await asyncio.create_subprocess_exec(
        *command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE
    )
    try:
        yield process
    finally:
        if process.returncode is None:
            process.kill()
        await process.communicate()


async def stops(latest: Any, command: tuple[str, ...], environment: Mapping[str, str]) -> None:
    """Check that a program stops the robot only if something is near."""
    async with started((*command, NOTHING_IS_NEAR), environment) as watching:
        assert watching.stdout
        lines = [await watching.stdout.readline() for _ in range(2)]  # of eleven scans
        assert [line for line in lines if b" beams, the nearest " not in line] == []
    assert latest.newest.gate.estop_generation == 0
    async with started((*command, ALL_IS_NEAR), environment) as pressing:
        said, _ = await pressing.communicate()
    assert said.splitlines()[-1].startswith(b"e-stop: stopped and latched; e-stop number ")
    assert pressing.returncode == 0
    await until(lambda: latest.newest.gate.mode == "latched", "it is latched")
    assert latest.newest.gate.estop_generation >= 1


def over_dds(judge: Judge) -> dict[str, Any]:
    return {"transport": "dds", "domain": judge.domain, "localhost": True}


def free_address() -> str:
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.mark.slow
async def test_a_node_in_rclpy_stops_the_robot(home: Home, judge: Judge, ros2: Path) -> None:
    async with driving(home, free_address(), **over_dds(judge)) as latest:
        await stops(latest, (str(ros2), str(EXAMPLES / "stop.py")), judge.environment())


@pytest.mark.slow
async def test_a_node_in_javascript_stops_the_robot(
    home: Home, judge: Judge, ros2: Path, tmp_path: Path
) -> None:
    client = built(lambda: rclnodejs(ros2))
    program = tmp_path / "stop.mjs"
    program.write_text((EXAMPLES / "stop.mjs").read_text())
    (tmp_path / "node_modules").symlink_to(client.modules)
    environment = judge.environment() | client.environment
    async with driving(home, free_address(), **over_dds(judge)) as latest:
        await stops(latest, ("node", str(program)), environment)


@pytest.mark.skipif(not PICO, reason="zenoh-pico is not here: set ZENOH_PICO to its folder")
async def test_a_program_in_c_stops_the_robot(home: Home, tmp_path: Path) -> None:
    program, router = str(tmp_path / "stop"), free_address()
    includes = [f"-I{PICO}/include", f"-I{PICO}/build/include"]
    flags = ("-std=c11", "-D_GNU_SOURCE", "-DZENOH_LINUX", "-Wall", "-Wextra", "-Werror")
    source, library = str(EXAMPLES / "stop.c"), f"{PICO}/build/lib/libzenohpico.a"
    command = ("cc", *flags, *includes, source, library, "-lpthread", "-lrt", "-o", program)
    await asyncio.to_thread(subprocess.run, command, check=True)
    async with driving(home, router) as latest:
        await stops(latest, (program, router), os.environ)
