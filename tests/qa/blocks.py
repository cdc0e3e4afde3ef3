"""Reads the fenced blocks of README.md and docs/, and the comments before them.

    <!-- run: robot -->         run beside a robot that drives
    <!-- run: arm -->           run beside an arm
    <!-- run: 5 s -->           each line is ended by Ctrl-C after 5 s
    <!-- run: robot, 5 s -->    both
    <!-- run: stays -->         run until the end of the page; wait until its robot may drive
    <!-- file: NAME -->         the block is this file, for the blocks of the page
    <!-- data: FOLDER/NAME -->  run with this file of the folder GIGABRAIN_DATA
    <!-- not run: hardware (WHAT) -->  it needs hardware, other hosts, or root

A block of `sh` or `python` without a comment is run. YAML must be one of the known kinds of files,
or a part of a robot.yaml. A block of `text` is output or a drawing.
"""

import ast
import json
import re
import shutil
import subprocess
import tempfile
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from gigabrain_drivers.driver.catalog import load_link
from gigabrain_drivers.driver.robot import RobotFile, Run
from gigabrain_drivers.sim.world_file import WorldFile
from gigabrain_zenoh.config import loading
from gigabrain_zenoh.config.map_image import MapYaml
from gigabrain_zenoh.decision.tasks.mission import Mission, PatrolFile
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.launch.deployment import deployment_type
from gigabrain_zenoh.mapping.zone_file import ZoneFile
from tests.places import ROOT

BLOCK = re.compile(
    r"^(?:<!-- (?P<mark>[^\n]*) -->\n)?(?P<indent> *)```(?P<language>[\w]*)(?P<rest>[^\n]*)\n"
    r"(?P<text>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)
VERBS = ("run", "not run", "file", "data")
NOT_RUN = ("hardware (", "what CI runs itself")
PART_OF = ROOT / "drivers/gigabrain_drivers/bodies/mycustombot"  # completes a part of a robot.yaml
ARM = ROOT / "drivers/gigabrain_drivers/bodies/so101"  # the same, for a part with joints


class Block(NamedTuple):
    """A fenced block of a page."""

    page: Path
    line: int
    language: str
    text: str
    verb: str  # one of VERBS, or ""
    value: str


def pages() -> list[Path]:
    """Return all pages whose blocks are checked and run."""
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> Iterator[Block]:
    """Yield the blocks of a page with their comments."""
    text = page.read_text("utf-8")
    for found in BLOCK.finditer(text):
        verb, _, value = (found["mark"] or "").partition(": ")
        line = text.count("\n", 0, found.start("language")) + 1
        verb = verb if verb in VERBS else ""
        yield Block(page, line, found["language"], found["text"], verb, value)


def problem(block: Block) -> str:
    """Return the fault of a block before it is run; empty without one."""
    if block.verb == "not run" and not block.value.startswith(NOT_RUN):
        return f"not run: expected one of {NOT_RUN}, got {block.value!r}"
    if block.language not in READERS:
        known = ", ".join(READERS)
        return f"a block of {block.language or 'no language'}; expected one of {known}"
    try:
        READERS[block.language](block)
    except (SyntaxError, ValueError, ConfigError, ElementTree.ParseError) as error:
        return str(error)
    return ""


def _read_yaml(block: Block) -> None:
    errors = []
    kinds = (deployment_type(), Mission, PatrolFile, RobotFile, MapYaml, WorldFile, ZoneFile)
    for one in kinds:
        try:
            loading.loads(block.text, one, block.value or "block")
            return
        except ConfigError as error:
            errors.append(f"{one.__name__}: {error}")
    try:
        _read_part_of_robot(block.text)
    except ConfigError as error:
        raise ValueError("; ".join([*errors, f"a part of robot.yaml: {error}"])) from None


def _read_part_of_robot(text: str) -> None:
    """Raise ConfigError unless a robot's file with these fields can be loaded."""
    part = yaml.safe_load(text)
    with tempfile.TemporaryDirectory(prefix="docs-") as name:
        folder = Path(name) / "robot"
        of_arm = {"arm", "joints"} & set(part) or " link: " in text  # like a camera on an arm
        shutil.copytree(ARM if of_arm else PART_OF, folder)
        file = folder / "robot.yaml"
        file.write_text(yaml.safe_dump(_joined(yaml.safe_load(file.read_text()), part)))
        load_link(str(file), Run(folder=folder, link="sim" if "sim" in part else "real"))


def _joined(whole: dict[str, Any], part: dict[str, Any]) -> dict[str, Any]:
    """Return a robot's fields with those of `part`; links with the same driver are merged."""
    for key, value in part.items():
        old = whole.get(key)
        if (
            isinstance(old, dict)
            and isinstance(value, dict)
            and old.get("driver") == value.get("driver")
        ):
            part[key] = old | value
    return whole | part


def _compile_c(block: Block) -> None:
    compiler = shutil.which("cc")
    if not compiler:
        return
    source = f"#include <stddef.h>\n#include <stdint.h>\n{block.text}"
    options = ("-fsyntax-only", "-Wall", "-Werror", "-x", "c", "-")
    done = subprocess.run((compiler, *options), input=source, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(done.stderr)


def _nothing(block: Block) -> None:
    """Accept a shell block or output without reading it."""


READERS: dict[str, Callable[[Block], Any]] = {
    "sh": _nothing,
    "python": lambda block: ast.parse(block.text),
    "yaml": _read_yaml,
    "toml": lambda block: tomllib.loads(block.text),
    "json": lambda block: json.loads(block.text),
    "xml": lambda block: ElementTree.fromstring(block.text),
    "c": _compile_c,
    "text": _nothing,
}
RUN = ("sh", "python")  # all others are only checked
