"""Other people's implementations of ROS 2's wire, each in an environment of its own.

They know nothing of this project: `zenoh-ros2-sdk` speaks as a node of `rmw_zenoh`, `pamoja-ros2`
makes keys, the codec of Foxglove and Lichtblick reads CDR in JavaScript, `rclnodejs` joins
JavaScript with an installed ROS 2, and Open-RMF's adapter free_fleet has its own versions of Zenoh
and of a codec.
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
FREE_FLEET = ("pycdr2==1.0.0", "eclipse-zenoh==1.5.0")  # as open-rmf/free_fleet at 002505f says
NODE = ("@foxglove/cdr@3", "@foxglove/rosmsg@5", "@foxglove/rosmsg2-serialization@3")
RCLNODEJS = ("rclnodejs@2.2.0", "rimraf@6")  # its build calls the second one
PROGRAMS = Path(__file__).parent / "clients"
Made = TypeVar("Made")


def built(build: Callable[[], Made]) -> Made:
    """Return what was built; where it cannot be the test is skipped, but in CI it fails."""
    try:
        return build()
    except NotBuilt as error:
        if "CI" in os.environ:
            raise
        pytest.skip(str(error))


def python() -> Path:
    """Install the Python clients where they are missing, and return their interpreter.

    Raises:
        NotBuilt: An installation failed.
    """
    return environment("python", PYTHON)


def free_fleet() -> Path:
    """Install the libraries of Open-RMF's adapter where they are missing; return an interpreter.

    Raises:
        NotBuilt: The installation failed.
    """
    return environment("free_fleet", FREE_FLEET)


def javascript() -> Path:
    """Install the JavaScript codec where it is missing, and return its folder.

    Raises:
        NotBuilt: Node.js is missing, or the installation failed.
    """
    if not shutil.which("npm"):
        raise NotBuilt("npm is missing; install Node.js")
    made = FOLDER / "javascript"
    made.mkdir(parents=True, exist_ok=True)
    install = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(made), *NODE]
    return _built(made / "node_modules", install).parent


class JavaScriptNode(NamedTuple):
    """The modules and the environment that a program needs for a node of rclnodejs."""

    modules: Path  # its folder node_modules
    environment: dict[str, str]


def rclnodejs(python: Path) -> JavaScriptNode:
    """Compile rclnodejs where it is missing, for the ROS 2 that an interpreter belongs to.

    The wheels of ROS have no command `ros2`, by which rclnodejs looks for ROS, and their libraries
    want that of Python. A sourced ROS 2 on Ubuntu needs nothing of this, and no compiling.

    Raises:
        NotBuilt: A header of Node.js or Python's library is missing, or the compilation failed.
    """
    node = shutil.which("node")
    headers = Path(node).resolve().parents[1] if node else Path()
    library = Path("{LIBDIR}/{INSTSONAME}".format(**sysconfig.get_config_vars()))
    for missing in (headers / "include/node/node.h", library):
        if not missing.exists():
            raise NotBuilt(f"rclnodejs cannot be compiled: {missing} is missing")
    made, ros = FOLDER / "rclnodejs", python.parents[1]
    (command := made / "ros/bin/ros2").parent.mkdir(parents=True, exist_ok=True)
    command.touch(0o755)
    for part in ("lib", "include"):
        with contextlib.suppress(FileExistsError):
            (made / "ros" / part).symlink_to(ros / part)
    libraries = [ros / "lib", *ros.glob("lib/python3*/site-packages/ros_*.libs")]
    used = {
        "AMENT_PREFIX_PATH": str(ros),
        "ROS_DISTRO": "jazzy",
        "LD_LIBRARY_PATH": os.pathsep.join(map(str, libraries)),
        "LD_PRELOAD": str(library),
        "PATH": os.pathsep.join((str(command.parent), str(python.parent), os.environ["PATH"])),
    }
    install = ["npm", "install", "--no-audit", "--no-fund", "--prefix", str(made), *RCLNODEJS]
    compiling = {"npm_config_nodedir": str(headers), "LIBRARY_PATH": str(ros / "lib")}
    modules = _built(made / "node_modules", install, environment=os.environ | used | compiling)
    return JavaScriptNode(modules, used)


def environment(name: str, packages: Sequence[str]) -> Path:
    """Install packages where they are missing, in an environment; return its interpreter.

    Raises:
        NotBuilt: The installation failed.
    """
    made = FOLDER / name
    return _built(
        made / "bin/python",
        [sys.executable, "-m", "venv", str(made)],
        [str(made / "bin/python"), "-m", "pip", "install", "-q", *packages],
    )


def _built(result: Path, *commands: list[str], environment: Mapping[str, str] = os.environ) -> Path:
    """Run the commands once, and return what they made."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    done = FOLDER / f"{result.relative_to(FOLDER).parts[0]}.built"
    with (FOLDER / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            for command in commands:
                ended = subprocess.run(
                    command, capture_output=True, text=True, check=False, env=environment
                )
                if ended.returncode:
                    last = ended.stderr.strip().rpartition("\n")[2]
                    raise NotBuilt(f"{' '.join(command[:4])} failed: {last}")
            done.touch()
    return result
