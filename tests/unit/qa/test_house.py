"""The check of module names in strings against the order of rooms, and the sizes of code."""

import shutil
from pathlib import Path

import pytest

from gigabrain_zenoh.qa import house

SKIPPED = shutil.ignore_patterns("__pycache__", "*.js", "*.svg")


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a copy of the product's sources, in which a test breaks one file at a time."""
    folder = tmp_path_factory.mktemp("copy")
    for package in house.PACKAGES:
        shutil.copytree(house.ROOT / package, folder / package, ignore=SKIPPED)
    shutil.copy(house.ROOT / "pyproject.toml", folder)
    return folder


@pytest.mark.long
def test_no_string_names_a_module_that_its_room_must_not_import() -> None:
    assert house.broken(house.ROOT) == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("where", "name", "contract"),
    [
        ("safety/step.py", "gigabrain_zenoh.perception.node:run", "safety trusts"),
        ("mapping/slam.py", "gigabrain_zenoh.bus.bus:Bus", "gate, geometry"),
        ("decision/node.py", "gigabrain_drivers.bodies.mock.driver:Mock", "only the commands"),
        ("host/files.py", "gigabrain_zenoh.bus.bus:Bus", "each room"),
    ],
)
def test_a_name_in_a_string_is_found(copy: Path, where: str, name: str, contract: str) -> None:
    path = copy / "gigabrain_zenoh" / where
    source = path.read_text("utf-8")
    path.write_text(f'{source}\nELSEWHERE = "{name}"\n', "utf-8")
    (line,) = house.broken(copy)
    path.write_text(source, "utf-8")
    assert line.startswith(f"gigabrain_zenoh/{where}:")
    assert line.partition("the contract is: ")[2].startswith(contract)


def test_sizes_are_counted(tmp_path: Path) -> None:
    long = "def f():\n" + "    x = 1\n" * 51
    (tmp_path / "a.py").write_text(long)
    (tmp_path / "b.py").write_text("x = 1\n")
    paths = sorted(tmp_path.glob("*.py"))
    assert house.size_of(paths) == (2, 53, 26.5, 52)
    assert house.long_functions(paths) == ["a.py:f"]
