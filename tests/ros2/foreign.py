"""Independent implementations of ROS 2's protocols, each in an environment of its own.

`zenoh-ros2-sdk` is a node of `rmw_zenoh`, and `pamoja-ros2` makes its keys. The codec of Foxglove
and Lichtblick reads CDR in JavaScript. `rclnodejs` makes JavaScript nodes of an installed ROS 2.
Open-RMF's adapter free_fleet has its own versions of Zenoh and of a codec.
"""

import contextlib
import fcntl
import os
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import pytest

from tests.places import ROOT
from tests.ros2.environment import NotBuilt

FOLDER = Path(os.environ.get("GIGABRAIN_ROS2_CLIENTS", ROOT / ".qa/ros2_clients"))
PYTHON = ("zenoh-ros2-sdk==0.1.8", "pamoja-ros2==0.2.0", "eclipse-zenoh>=1.10")
FREE_FLEET = ("pycdr2==1.0.0", "eclipse-zenoh==1.5.0")  # as in open-rmf/free_fleet at 002505f
NODE = ("@foxglove/cdr@3", "@foxglove/rosmsg@5", "@foxglove/rosmsg2-serialization@3")
RCLNODEJS = ("rclnodejs@2.2.0", "rimraf@6")  # its build needs rimraf
PROGRAMS = Path(__file__).parent / "clients"
Result = TypeVar("Result")


def built(build: Callable[[], Result]) -> Result:
    """Return the result of `build`. If that fails, the test is skipped; in CI it fails."""
    try:
        return build()
    except NotBuilt as error:
        if "CI" in os.environ:
            raise
        pytest.skip(str(error))


def python() -> Path:
    """Install the Python clients if they are missing, and return their interpreter.

    Raises:
        NotBuilt: An installation failed.
    """
    return environment("python", PYTHON)


def free_fleet() -> Path:
    """Install the libraries of Open-RMF's adapter if they are missing; return an interpreter.

    Raises:
        NotBuilt: The installation failed.
    """
    return environment("free_fleet", FREE_FLEET)


def javascript() -> Path:
    """Install the JavaScript codec if it is missing, and return its folder.

    Raises:
        NotBuilt: Node.js is missing, or the installation failed.
    """
    if not shutil.which("npm"):
        raise NotBuilt("npm is missing; install Node.js")
    folder = FOLDER / "javascript"
    folder.mkdir(parents=True, exist_ok=True)
    install = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(folder), *NODE]
    return _built(folder / "node_modules", install).parent


class JavaScriptNode(NamedTuple):
    """The modules and the environment that a program needs for a node of rclnodejs."""

    modules: Path  # the folder node_modules
    environment: dict[str, str]


def rclnodejs(python: Path) -> JavaScriptNode:
    """Compile rclnodejs if it is missing, for the ROS 2 of a Python interpreter.

    rclnodejs finds ROS by its command `ros2`, which the wheels do not have, and their libraries
    need the library of Python. A sourced ROS 2 on Ubuntu needs none of this, and no compiling.

    Raises:
        NotBuilt: A header of Node.js or Python's library is missing, or the compilation failed.
    """
    node = shutil.which("node")
    headers = Path(node).resolve().parents[1] if node else Path()
    library = Path("{LIBDIR}/{INSTSONAME}".format(**sysconfig.get_config_vars()))
    for missing in (headers / "include/node/node.h", library):
        if not missing.exists():
            raise NotBuilt(f"rclnodejs cannot be compiled: {missing} is missing")
    folder, ros = FOLDER / "rclnodejs", python.parents[1]
    (command := folder / "ros/bin/ros2").parent.mkdir(parents=True, exist_ok=True)
    command.touch(0o755)
    for part in ("lib", "include"):
        with contextlib.suppress(FileExistsError):
            (folder / "ros" / part).symlink_to(ros / part)
    libraries = [ros / "lib", *ros.glob("lib/python3*/site-packages/ros_*.libs")]
    running = {
        "AMENT_PREFIX_PATH": str(ros),
        "ROS_DISTRO": "jazzy",
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "LD_PRELOAD": str(library),
        "PATH": os.pathsep.join((str(command.parent), str(python.parent), os.environ["PATH"])),
    }
    install = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(folder), *RCLNODEJS]
    compiling = {"npm_config_nodedir": str(headers), "LIBRARY_PATH": str(ros / "lib")}
    modules = _built(folder / "node_modules", install, environment=os.environ | running | compiling)
    return JavaScriptNode(modules, running)


def environment(name: str, packages: Sequence[str]) -> Path:
    """Install packages in an environment if they are missing; return its interpreter.

    Raises:
        NotBuilt: The installation failed.
    """
    folder = FOLDER / name
    return _built(
        folder / "bin/python",
        [sys.executable, "-m", "venv", str(folder)],
        [str(folder / "bin/python"), "-m", "pip", "install", "-q", *packages],
    )


def _built(result: Path, *commands: list[str], environment: Mapping[str, str] = os.environ) -> Path:
    """Run the commands unless they have succeeded before; return `result`, which they made."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    marker = FOLDER / f"{result.relative_to(FOLDER).parts[0]}.built"
    with (FOLDER / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not marker.exists():
            for command in commands:
                completed = subprocess.run(
                    command, capture_output=True, text=True, check=False, env=environment
                )
                if completed.returncode:
                    last = completed.stderr.strip().rpartition("\n")[2]
                    raise NotBuilt(f"{' '.join(command[:4])} failed: {last}")
            marker.touch()
    return result
