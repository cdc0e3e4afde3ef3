"""Fuzz checks of the files of robots, deployments and worlds."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import yaml

from gigabrain_drivers.driver.catalog import driver_class, link_options, robot_files
from gigabrain_drivers.driver.robot import LINKS, RobotFile
from gigabrain_drivers.sim.world_file import WorldFile, build_world
from gigabrain_drivers.sim.worlds import NAMED_WORLDS, shipped_world
from gigabrain_zenoh.config.loading import loads
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import Deployment, deployment_type
from tests.fuzz.harness import ROOT, split

KINDS = ("deployment", "robot", "world")
DEPLOYMENT = deployment_type()
LONGEST_LINE = 2000  # characters of a complaint


def check(data: bytes) -> None:
    """Refused in one line that names the line, or a value that is the same when written again."""
    kind, rest = split(data, list(KINDS))
    try:
        text = rest.decode()
    except UnicodeDecodeError:  # which `load` refuses before anything else
        return
    read: Callable[[str], Any] = {"deployment": deployment, "world": world}.get(kind, robot)
    try:
        value = read(text)
    except ConfigError as error:
        told(str(error))
        return
    plain = msgspec.to_builtins(value)
    assert msgspec.to_builtins(read(yaml.safe_dump(plain, allow_unicode=True))) == plain


def told(complaint: str) -> None:
    """One line, and where it is not about a driver's name, which line of the file it is."""
    assert complaint.startswith(("x.yaml:", "no driver", "no lidar", "no camera source"))
    assert "\n" not in complaint
    assert len(complaint) < LONGEST_LINE


def deployment(text: str) -> Deployment:
    """As `gigabrain up` reads it."""
    return loads(text, DEPLOYMENT, "x.yaml")


def world(text: str) -> WorldFile:
    """As the simulator reads it, down to its shapes; maps and models are files of their own."""
    found = loads(text, WorldFile, "x.yaml")
    alone = msgspec.structs.replace(found, map="", model="", size=found.size or (1.0, 1.0))
    made = build_world(alone, Path("x.yaml"))
    assert all(math.isfinite(one.distance(0.0, 0.0)) for one in made.everything())
    return found


def robot(text: str) -> RobotFile:
    """As the driver's process reads it, down to the options of its links."""
    found = loads(text, RobotFile, "x.yaml")
    for name in LINKS:
        link = getattr(found, name)
        if link is not None:
            options = link_options(driver_class(str(link.get("driver"))), found, link)
            found = loads(text, exact(name, options), "x.yaml")
    return found


def exact(link: str, options: Any) -> type[RobotFile]:
    """A robot's file with the options of one link."""
    return msgspec.defstruct(
        "RobotFile", [(link, options)], bases=(RobotFile,),
        frozen=True, kw_only=True, forbid_unknown_fields=True,
    )  # fmt: skip


def seeds() -> Iterator[bytes]:
    """The files that there are."""
    for path in robot_files().values():
        yield b"robot\n" + path.read_bytes()
    for path in sorted(Path(ROOT / "deploy").glob("*.yaml")):
        yield b"deployment\n" + path.read_bytes()
    for name in NAMED_WORLDS:
        yield b"world\n" + shipped_world(name).read_bytes()
