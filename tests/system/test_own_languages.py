"""`examples/own_process`: users' programs without this package, in three languages."""

import asyncio
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from gigabrain_schemas.topics import STATE
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.testing.processes import Home, free_port, listens
from gigabrain_zenoh.testing.waiting import until
from tests.places import ROOT

EXAMPLES = ROOT / "examples/own_process"
NODE = shutil.which("node")
PICO = os.environ.get("ZENOH_PICO", "")  # folder of a built zenoh-pico, which no registry has


class Robot(NamedTuple):
    """A robot without a decision process."""

    router: str
    page: str


@pytest.fixture
async def robot(home: Home) -> Robot:
    port, router = free_port(), f"tcp/127.0.0.1:{free_port()}"
    file = shutil.copy(EXAMPLES / "robot.yaml", home.folder)
    home.start("up", str(file), "--set", f"router={router}", "--set", f"page.port={port}")
    await until(lambda: listens(port), "the page is served")
    return Robot(router, f"http://127.0.0.1:{port}")


def run(*command: str) -> str:
    ran = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.mark.slow
async def test_a_decision_process_in_plain_python_drives(robot: Robot) -> None:
    speeds: list[float] = []
    async with connect(Endpoint(connect=(robot.router,)), "test", timeout_s=None) as bus:
        bus.subscribe(STATE, lambda _key, state: speeds.append(state.velocity.linear_x))
        program = str(EXAMPLES / "drive.py")
        output = await asyncio.to_thread(run, sys.executable, program, robot.router, "8")
    assert "intents, the last one: " in output
    assert max(speeds) == pytest.approx(0.1, abs=0.02)


@pytest.mark.skipif(NODE is None, reason="there is no Node here")
@pytest.mark.slow
async def test_javascript_reads_the_robot_through_the_page(robot: Robot) -> None:
    assert NODE
    flags = () if "function" in run(NODE, "-p", "typeof WebSocket") else WEBSOCKET_FLAG
    program = str(EXAMPLES / "watch_page.mjs")
    output = await asyncio.to_thread(run, NODE, *flags, program, robot.page)
    assert "tick " in output
    assert "beams, the nearest " in output


WEBSOCKET_FLAG = ("--experimental-websocket",)  # Node 20


@pytest.mark.skipif(not PICO, reason="zenoh-pico is not here: set ZENOH_PICO to its folder")
async def test_c_reads_the_robot_and_presses_the_e_stop(robot: Robot, tmp_path: Path) -> None:
    program = tmp_path / "watch"
    pico = Path(PICO)
    includes = [f"-I{pico / 'include'}", f"-I{pico / 'build/include'}"]
    library = str(pico / "build/lib/libzenohpico.a")
    source = str(EXAMPLES / "watch.c")
    flags = ("-std=c11", "-D_GNU_SOURCE", "-DZENOH_LINUX", "-Wall", "-Werror")
    run("cc", *flags, *includes, source, library, "-lpthread", "-lrt", "-o", str(program))
    async with connect(Endpoint(connect=(robot.router,)), "test", timeout_s=None) as bus:
        states = bus.latest(STATE)
        output = await asyncio.to_thread(run, str(program), robot.router, "estop")
        await until(lambda: states.newest and states.newest.gate.mode == "latched", "it is latched")
    assert "e-stop sent" in output
