"""import-linter finds imports that break the order of the packages."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gigabrain_zenoh.qa import house

SKIPPED = shutil.ignore_patterns("__pycache__", "*.js", "*.svg")


@pytest.fixture
def source_copy(tmp_path: Path) -> Path:
    """Return a copy of the product's sources that a test may change."""
    for package in house.PACKAGES:
        shutil.copytree(house.ROOT / package, tmp_path / package, ignore=SKIPPED)
    shutil.copy(house.ROOT / "pyproject.toml", tmp_path)
    return tmp_path


def lint_imports(root: Path) -> subprocess.CompletedProcess[str]:
    linter = Path(sys.executable).with_name("lint-imports")
    path = os.pathsep.join(str((root / package).parent) for package in house.PACKAGES)
    return subprocess.run(
        (linter, "--no-cache"), cwd=root, env=os.environ | {"PYTHONPATH": path},
        capture_output=True, text=True,
    )  # fmt: skip


def append_text(path: Path, text: str) -> None:
    path.write_text(path.read_text("utf-8") + text, "utf-8")


@pytest.mark.parametrize(
    ("where", "statement", "contract"),
    [
        (
            "safety/step.py",
            "from gigabrain_zenoh.mapping.likelihood_field import OCCUPIED",
            "safety trusts",
        ),
        ("mapping/slam.py", "def late():\n    import gigabrain_zenoh.bus.bus", "gate, geometry"),
        ("host/files.py", "from gigabrain_zenoh.bus.bus import Bus", "each room"),
        (
            "ui/steering.py",
            "from gigabrain_drivers.bodies.mock.driver import Mock",
            "only the commands",
        ),
    ],
)
def test_an_import_against_the_package_order_is_found(
    source_copy: Path, where: str, statement: str, contract: str
) -> None:
    assert lint_imports(source_copy).returncode == 0
    append_text(source_copy / "gigabrain_zenoh" / where, f"\n{statement}\n")
    done = lint_imports(source_copy)
    assert done.returncode == 1
    assert any(line.startswith(contract) and "BROKEN" in line for line in done.stdout.splitlines())
