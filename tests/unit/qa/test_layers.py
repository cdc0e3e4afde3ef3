"""Third-party SDKs are only imported by their own modules, and functions fit on a screen.

The order of rooms is in pyproject.toml, for import-linter.
"""

import ast
import functools
import sys
from pathlib import Path

import pytest

from gigabrain_zenoh.qa import house

ROOT = house.ROOT
STANDARD = sys.stdlib_module_names
ONLY_IN = {
    "zenoh": (
        "gigabrain_zenoh/bus/zenoh/session.py",
        "gigabrain_zenoh/bus/zenoh/transport.py",
        "gigabrain_zenoh/qa/bench/relay.py",
        "gigabrain_zenoh/ros2/rmw_declared.py",
        "gigabrain_zenoh/ros2/rmw_zenoh.py",
        "gigabrain_zenoh/testing/processes.py",
    ),
    "rosbags": ("gigabrain_zenoh/ros2/",),
    "cyclonedds": ("gigabrain_zenoh/ros2/",),
    "ruckig": ("gigabrain_zenoh/manipulation/",),
    "mujoco": (
        "drivers/gigabrain_drivers/sim/",
        "drivers/gigabrain_drivers/cameras/rendered.py",
        "gigabrain_zenoh/manipulation/",
        "gigabrain_zenoh/qa/bench/eyes_worlds.py",
        "gigabrain_zenoh/qa/bench/jackal.py",
        "gigabrain_zenoh/qa/train/",
        "gigabrain_zenoh/safety/arm_shape.py",
    ),
}


def sources() -> list[Path]:
    return list(house.modules(ROOT).values())


@functools.cache
def imports(path: Path) -> set[str]:
    """Return the packages that a file imports anywhere."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            found.add((node.module or "").partition(".")[0])
    return found


def test_the_schemas_need_nothing_but_msgspec_and_numpy() -> None:
    allowed = {"gigabrain_schemas", "msgspec", "numpy"}
    for path in (ROOT / "schemas/gigabrain_schemas").rglob("*.py"):
        assert imports(path) - STANDARD <= allowed, path


@pytest.mark.long
@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_stays_behind_its_own_modules(library: str) -> None:
    for path in sources():
        if library in imports(path):
            name = path.relative_to(ROOT).as_posix()
            assert name.startswith(ONLY_IN[library]), path


@pytest.mark.long
def test_every_function_fits_on_a_screen() -> None:
    assert house.long_functions(sources()) == []
