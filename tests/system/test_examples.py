"""Each program and notebook of `examples/` runs beside a simulated robot."""

import ast
import asyncio
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import nbformat
import pytest
from nbclient import NotebookClient

from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.testing.processes import (
    CommandProcess,
    Home,
    free_endpoint,
    robot_of,
    router_process,
)
from tests.places import ROOT

EXAMPLES = ROOT / "examples"
LONGEST_S = 300.0


class Example(NamedTuple):
    """The arguments of a program, a part of its output, and the files that it writes."""

    arguments: tuple[str, ...] = ()  # ENDPOINT and DRIVE are replaced by the robot's
    prints: str = ""
    makes: tuple[str, ...] = ()


PROGRAMS = {
    "battery_watch": Example(prints="%"),
    "draw_map": Example(makes=("map.png",)),
    "estop": Example(prints="refused: "),
    "follow_task": Example(prints="going to (0.40, -0.30)"),
    "go_to": Example(prints="succeeded"),
    "look_round": Example(makes=("points.npy",)),
    "mission": Example(prints="going to here"),
    "no_package": Example(("ENDPOINT",), prints="tick "),
    "patrol": Example(prints="start: succeeded"),
    "pause_when_near": Example(prints="is cancelled"),
    "plot_speed": Example(makes=("speed.png",)),
    "read_recording": Example(("DRIVE",), prints="states over"),
    "save_scans": Example(prints="scans.npy: 20 scans", makes=("scans.npy", "angles.npy")),
    "square": Example(prints="side 4: "),
    "wall_follower": Example(prints="ahead "),
    "who_drives": Example(prints="drives: my-script"),
}
NOTEBOOKS = ("first_look", "recording")


def test_every_example_is_tested() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {*PROGRAMS}
    assert {path.stem for path in EXAMPLES.glob("*.ipynb")} == {*NOTEBOOKS}
    tests = "".join(path.read_text() for path in (ROOT / "tests").rglob("*.py"))
    folders = [path.name for path in EXAMPLES.iterdir() if path.is_dir() and path.name[0] != "_"]
    assert [name for name in folders if f"examples/{name}" not in tests] == []


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_is_short_and_has_a_docstring(name: str) -> None:
    source = (EXAMPLES / f"{name}.py").read_text()
    assert source.count("\n") < 60
    assert (ast.get_docstring(ast.parse(source)) or "").split("\n")[0][-1] in ".:"


def test_the_index_has_the_docstring_of_each_program() -> None:
    index = (EXAMPLES / "README.md").read_text()
    docstrings = {
        name: (ast.get_docstring(ast.parse((EXAMPLES / f"{name}.py").read_text())) or "")
        for name in PROGRAMS
    }
    rows = {f"| `{name}.py` | {text.splitlines()[0]} |" for name, text in docstrings.items()}
    assert rows - set(index.splitlines()) == set()


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_stored_without_outputs(name: str) -> None:
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [(cell["outputs"], cell["execution_count"]) for cell in code] == [([], None)] * len(code)


@pytest.mark.parametrize(
    ("program", "arguments", "line"),
    [
        ("no_package.py", (), "python no_package.py tcp/127.0.0.1:7447"),
        ("own_process/drive.py", (), "python drive.py tcp/127.0.0.1:7447 [SECONDS]"),
        ("read_recording.py", (), "python read_recording.py drive.mcap"),
        ("go_to.py", ("kitchen",), "python go_to.py [X Y]"),
    ],
)
def test_wrong_arguments_print_the_usage(
    program: str, arguments: tuple[str, ...], line: str
) -> None:
    done = run(program, *arguments)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"usage: {line}\n")


@pytest.mark.parametrize(
    ("program", "arguments", "line"),
    [
        ("no_package.py", (), "nothing on robot/state; is the driver running?"),
        (
            "own_process/drive.py",
            ("0.1",),
            "no intents: nothing on robot/state; is the driver running?",
        ),
    ],
)
def test_a_program_without_this_package_reports_a_silent_robot(
    program: str, arguments: tuple[str, ...], line: str
) -> None:
    endpoint = free_endpoint()
    with router_process(endpoint):
        done = run(program, endpoint, *arguments)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", f"{line}\n")


def run(program: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a program to its end and return it."""
    command = (sys.executable, str(EXAMPLES / program), *arguments)
    return subprocess.run(command, capture_output=True, text=True, timeout=LONGEST_S)


class Robot(NamedTuple):
    """A robot that maps and drives, with its recording."""

    home: Home
    endpoint: Endpoint
    drive: Path

    @property
    def environment(self) -> dict[str, str]:
        scripts = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        return self.home.environment | {"PATH": scripts}


@pytest.fixture(scope="module")
def robot(shared_home: Home) -> Iterator[Robot]:
    drive = shared_home.folder / "drive.mcap"
    demo = shared_home.start("demo", "--headless", "--no-page", "--record", str(drive))
    yield Robot(shared_home, asyncio.run(ready(shared_home, demo)), drive)
    demo.close()


async def ready(home: Home, demo: CommandProcess) -> Endpoint:
    """Wait until the robot may drive and has a map; return its endpoint."""
    endpoint = await robot_of(home, demo)
    for _ in range(60):
        shown = await home.run("topic", "echo", "state", "-n", "1", "--fields", "gate.mode")
        drawn = await home.run("topic", "echo", "map", "-n", "1", "--within", "5")
        if "enabled" in shown.out and drawn.out:
            return endpoint
    raise TimeoutError("the robot does not drive")


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_runs_beside_a_robot(name: str, robot: Robot, tmp_path: Path) -> None:
    example = PROGRAMS[name]
    drive = shutil.copy(robot.drive, tmp_path) if "DRIVE" in example.arguments else ""
    places = {"ENDPOINT": robot.endpoint.connect[0], "DRIVE": str(drive)}
    done = subprocess.run(
        (sys.executable, EXAMPLES / f"{name}.py", *(places[one] for one in example.arguments)),
        cwd=tmp_path,
        env=robot.environment,
        capture_output=True,
        text=True,
        timeout=LONGEST_S,
    )
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    assert example.prints in done.stdout
    assert [made for made in example.makes if not (tmp_path / made).stat().st_size] == []


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_beside_a_robot(
    name: str, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for key, value in robot.environment.items():
        monkeypatch.setenv(key, value)
    notebook = nbformat.read(EXAMPLES / f"{name}.ipynb", as_version=4)
    client = NotebookClient(
        notebook, timeout=LONGEST_S, resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    outputs = [cell.outputs for cell in notebook.cells if cell.cell_type == "code"]
    assert [index for index, shown in enumerate(outputs[1:]) if not shown] == []
