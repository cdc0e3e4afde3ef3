"""Times first starts, up to a robot that navigates: `python -m tests.qa.first_start`.

Each begins in an empty folder with empty caches: it installs, runs `gigabrain demo` outside the
checkout, and reads the times from its report. It fails if the robot does not move, makes no map or
touches something. Times are only printed.
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import App, Parameter
from rich.console import Console
from rich.table import Table

from tests.places import ROOT

Tool = Literal["pip", "uv"]
Way = Literal["make", "wheel", "sdist", "tool"]
EXTRAS = "[sim,nav,page]"
OWN = ("VIRTUAL_ENV", "PYTHON", "GIGABRAIN", "XDG")  # prefixes of variables that are left out
CACHES = ("XDG_CACHE_HOME", "XDG_STATE_HOME", "XDG_RUNTIME_DIR", "PIP_CACHE_DIR", "UV_CACHE_DIR")
EXPLORE_S = 10.0  # duration of exploring, at most
MAP_TIMEOUT_S = 240  # on a busy machine
ENDED = (0, 2, -signal.SIGINT)  # exit codes after Ctrl-C: of the command, and two of make
MINORS = range(11, 15)  # of Python 3
Command = tuple[str | Path, ...]

app = App(result_action="return_value")


@app.default
def main(
    *,
    tool: Annotated[tuple[Tool, ...], Parameter(consume_multiple=True)] = ("pip",),
    way: Annotated[tuple[Way, ...], Parameter(consume_multiple=True)] = ("wheel",),
    python: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
) -> int:
    """Time each tool with each way and each interpreter.

    Args:
        tool: What installs.
        way: `make demo` in a fresh clone, from the wheel, from the sdist, or for one command
            (`uvx`, `pipx run`).
        python: Interpreters; by default one of each supported version that is found.
    """
    table = Table("Python", "by", "from", "installed", "MB", "packages")
    for name in ("first state", "motion", "metre", "path", "verdict"):
        table.add_column(name)
    failed = 0
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))  # ends the robot too
    with tempfile.TemporaryDirectory(prefix="built-") as built:
        build = (sys.executable, "-m", "build", "--outdir", built, ROOT)
        subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
        for interpreter in python or interpreters():
            for one in way:
                for by in tool:
                    try:
                        row = first_start(interpreter, by, one, Path(built))
                    except subprocess.CalledProcessError as error:
                        row = (*("-",) * 7, str(error))
                    table.add_row(version_of(interpreter), by, one, *row)
                    failed += row[-1] != "ok"
    Console(width=120).print(table)
    return failed


def first_start(python: Path, tool: Tool, way: Way, built: Path) -> tuple[str, ...]:
    """Install and drive; return the cells of a row. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory(prefix="first-start-") as name:
        folder = Path(name)
        at = folder / "checkout" if way == "make" else folder
        environment = empty_environment(folder, tool)

        def run(*words: str | Path) -> float:
            began_s = time.monotonic()
            subprocess.run(list(map(str, words)), cwd=at, env=environment, check=True)
            return time.monotonic() - began_s

        def drive(*words: str | Path) -> None:
            """Drive until the robot explores by its map, then end it like Ctrl-C."""
            command = list(map(str, words))
            with subprocess.Popen(command, cwd=at, env=environment, start_new_session=True) as demo:
                try:
                    for _ in range(MAP_TIMEOUT_S):
                        with contextlib.suppress(subprocess.TimeoutExpired):
                            demo.wait(1.0)
                        if demo.returncode is not None or explores(folder):
                            break
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        demo.wait(EXPLORE_S)
                finally:
                    if demo.returncode is None:
                        os.killpg(demo.pid, signal.SIGINT)
            if demo.returncode not in ENDED:
                raise subprocess.CalledProcessError(demo.returncode, command)

        if way == "make":
            subprocess.run(("git", "clone", "--quiet", ROOT, at), check=True)
        report = folder / "report.json"
        options = ("--headless", "--report", str(report))
        (package,) = built.glob("*.tar.gz" if way == "sdist" else "*.whl")
        venv = at / ".venv"
        install, demo = commands(python, tool, way, f"{package}{EXTRAS}", venv)
        installed_s = sum(run(*words) for words in install)
        size, count = contents(venv) if install else ("", "")
        drive(*demo, *((f"ARGS={' '.join(options)}",) if way == "make" else options))
        found = json.loads(report.read_text())
        times = (found["start"][key] for key in ("state_s", "motion_s", "metre_s", "path_s"))
        since = ("-" if one is None else f"{installed_s + one:.1f} s" for one in times)
        verdict = found["verdict"] if found["start"]["path_s"] else "no path through its own map"
        return f"{installed_s:.1f} s", size, count, *since, verdict


def explores(folder: Path) -> bool:
    """Return whether a robot explores by its own map, by a log in `folder`."""
    logs = folder.glob("xdg_state_home/**/decision.jsonl")
    return any('"exploring: ' in log.read_text() for log in logs)


def commands(
    python: Path, tool: Tool, way: Way, package: str, venv: Path
) -> tuple[list[Command], Command]:
    """Return the commands that install, and the one that starts the demo."""
    if way == "make":
        return [("make", f"PYTHON={python}", ".venv/.demo")], ("make", "demo")
    if way == "tool":
        runner = ("uvx", "--from") if tool == "uv" else (python, "-m", "pipx", "run", "--spec")
        return [], (*runner, package, "gigabrain", "demo")
    demo = (venv / "bin/gigabrain", "demo")
    if tool == "uv":
        install = ("uv", "pip", "install", "--quiet", "--python", venv / "bin/python", package)
        return [("uv", "venv", "--quiet", "--python", python, venv), install], demo
    install = (venv / "bin/python", "-m", "pip", "install", "--quiet", package)
    return [(python, "-m", "venv", venv), install], demo


def empty_environment(folder: Path, tool: Tool) -> dict[str, str]:
    """Return an environment with its own caches; uv is only found if it is the tool."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(OWN)}
    tools = folder / "tools"
    tools.mkdir()
    if tool == "uv":
        for name in ("uv", "uvx"):
            (tools / name).symlink_to(place_of(name))
    others = [one for one in kept["PATH"].split(os.pathsep) if not (Path(one) / "uv").exists()]
    caches = {name: str(folder / name.lower()) for name in CACHES}
    (folder / "xdg_runtime_dir").mkdir(mode=0o700)
    return kept | caches | {"PATH": os.pathsep.join((str(tools), *others))}


def place_of(name: str) -> str:
    """Return the path of a program, on PATH or beside this Python. Raises SystemExit."""
    beside = str(Path(sys.executable).parent)
    return shutil.which(name) or shutil.which(name, path=beside) or sys.exit(f"no {name} here")


def interpreters() -> Iterator[Path]:
    """Yield an interpreter of each supported version that this machine has."""
    managed = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    for minor in MINORS:
        on_path = shutil.which(f"python3.{minor}")
        found = [Path(on_path)] if on_path else []
        for python in (*found, *sorted(managed.glob(f"3.{minor}.*/bin/python3"))):
            if version_of(python).startswith(f"3.{minor}."):
                yield python
                break


def version_of(python: Path) -> str:
    """Return an interpreter's version; an empty text if it does not run."""
    answer = subprocess.run((python, "--version"), capture_output=True, text=True)
    return answer.stdout.removeprefix("Python").strip()


def contents(venv: Path) -> tuple[str, str]:
    """Return the size of an environment [MB], and its number of packages without pip's."""
    size = sum(path.lstat().st_size for path in venv.rglob("*") if not path.is_dir())
    packages = {path.name.partition("-")[0] for path in venv.rglob("*.dist-info")}
    return f"{size / 1e6:.0f}", str(len(packages - {"pip", "setuptools"}))


if __name__ == "__main__":
    sys.exit(app())
