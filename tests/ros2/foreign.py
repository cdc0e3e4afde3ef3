"""Other people's implementations of ROS 2's wire, each in an environment of its own.

They know nothing of this project: `zenoh-ros2-sdk` speaks as a node of `rmw_zenoh`, `pamoja-ros2`
makes keys, the codec of Foxglove and Lichtblick reads CDR in JavaScript, and Open-RMF's adapter
free_fleet has its own versions of Zenoh and of a codec.
"""

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from tests.places import ROOT
from tests.ros2.environment import NotBuilt

FOLDER = Path(os.environ.get("GIGABRAIN_ROS2_CLIENTS", ROOT / ".qa/ros2_clients"))
PYTHON = ("zenoh-ros2-sdk==0.1.8", "pamoja-ros2==0.2.0", "eclipse-zenoh>=1.10")
FREE_FLEET = ("pycdr2==1.0.0", "eclipse-zenoh==1.5.0")  # as open-rmf/free_fleet at 002505f says
NODE = ("@foxglove/cdr@3", "@foxglove/rosmsg@5", "@foxglove/rosmsg2-serialization@3")
PROGRAMS = Path(__file__).parent / "clients"


def built(build: Callable[[], Path]) -> Path:
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
    return _environment("python", PYTHON)


def free_fleet() -> Path:
    """Install the libraries of Open-RMF's adapter where they are missing; return an interpreter.

    Raises:
        NotBuilt: The installation failed.
    """
    return _environment("free_fleet", FREE_FLEET)


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


def _environment(name: str, packages: Sequence[str]) -> Path:
    made = FOLDER / name
    return _built(
        made / "bin/python",
        [sys.executable, "-m", "venv", str(made)],
        [str(made / "bin/python"), "-m", "pip", "install", "-q", *packages],
    )


def _built(result: Path, *commands: list[str]) -> Path:
    """Run the commands once, and return what they made."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    done = FOLDER / f"{result.relative_to(FOLDER).parts[0]}.built"
    with (FOLDER / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            for command in commands:
                ended = subprocess.run(command, capture_output=True, text=True, check=False)
                if ended.returncode:
                    last = ended.stderr.strip().rpartition("\n")[2]
                    raise NotBuilt(f"{' '.join(command[:4])} failed: {last}")
            done.touch()
    return result
