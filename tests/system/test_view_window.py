"""The live window of a simulation, on a display without a screen."""

import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gigabrain_schemas.sim import SimRequest, Thing
from gigabrain_schemas.topics import SIM_CHANGE
from gigabrain_zenoh.launch.deployment import ROBOT
from gigabrain_zenoh.qa.probe import probing
from gigabrain_zenoh.testing.processes import GIGABRAIN, Home, endpoint_of
from gigabrain_zenoh.testing.waiting import until

pytest.importorskip("glfw", reason="there is no GLFW here")
XVFB = shutil.which("Xvfb")
needs_xvfb = pytest.mark.skipif(XVFB is None, reason="there is no Xvfb here")
MAX_HEADER_BYTES = 4096  # at most, before the pixels of an XWD file


class Display:
    """An X server that has its picture in a file."""

    def __init__(self, folder: Path) -> None:
        assert XVFB
        read, write = os.pipe()
        self._server = subprocess.Popen(
            [XVFB, "-displayfd", str(write), "-screen", "0", "900x600x24", "-nolisten", "tcp",
             "-fbdir", str(folder)],
            pass_fds=(write,), stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(write)
        with os.fdopen(read) as number:
            self.name = f":{number.readline().strip()}"
        self._file = folder / "Xvfb_screen0"

    def colours(self) -> int:
        """Return the number of colours on the screen."""
        pixels = np.frombuffer(self._file.read_bytes()[MAX_HEADER_BYTES:][: 4 * 900 * 590], "<u4")
        return len(np.unique(pixels))

    def close(self) -> None:
        self._server.terminate()
        self._server.wait(10)


@pytest.fixture
def display(tmp_path: Path) -> Iterator[Display]:
    made = Display(tmp_path)
    yield made
    made.close()


def view(home: Home, endpoint: str, display: str = "") -> subprocess.Popen[str]:
    environment = {key: value for key, value in home.environment.items() if "DISPLAY" not in key}
    if display:
        environment["DISPLAY"] = display
    return subprocess.Popen(
        [*GIGABRAIN, "view", "--connect", endpoint],
        env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip


@needs_xvfb
@pytest.mark.slow
async def test_a_window_shows_the_simulation_without_delaying_it(
    shared_home: Home, display: Display
) -> None:
    hosts = {"robot": list(ROBOT)}
    file = shared_home.deployment(resume="auto", hosts=hosts, world="arena")
    robot = shared_home.start("up", str(file))
    try:
        endpoint = endpoint_of(file)
        async with probing(endpoint) as seen:
            await until(lambda: len(seen.states) > 10, "the robot runs")
            window = view(shared_home, endpoint.connect[0], display.name)
            await until(lambda: display.colours() > 500, "the window is drawn")
            box = SimRequest(do="add", thing=Thing(x=2.8, y=-2.8, size=(0.2, 0.2, 0.5)))
            assert (await seen.bus.ask(SIM_CHANGE, box, timeout_s=5.0))[0].ok
            window.send_signal(signal.SIGSTOP)  # a hanging window delays nothing
            before = len(seen.states)
            await until(lambda: len(seen.states) > before + 100, "the robot goes on")
            window.send_signal(signal.SIGCONT)
            window.send_signal(signal.SIGINT)
            window.communicate(timeout=60)
            assert window.returncode in (0, 130)
    finally:
        robot.close()


def test_the_error_without_a_display_names_the_remedy(shared_home: Home) -> None:
    ended = view(shared_home, "tcp/127.0.0.1:1")
    out, _ = ended.communicate(timeout=60)
    assert ended.returncode == 2
    assert len(out.strip().splitlines()) == 1
    assert "no display here; use the 3-D view of the operator page" in out
