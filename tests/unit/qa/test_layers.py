"""Third-party SDKs stay behind one module each, and functions fit on a screen.

Which room may import which is in pyproject.toml, for import-linter.
"""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
STANDARD = sys.stdlib_module_names
PACKAGES = ("schemas/gigabrain_schemas", "gigabrain_zenoh", "drivers/gigabrain_drivers")
ONLY_IN = {
    "zenoh": (
        "gigabrain_zenoh/bus/zenoh/session.py",
        "gigabrain_zenoh/bus/zenoh/transport.py",
        "gigabrain_zenoh/qa/bench/relay.py",
        "gigabrain_zenoh/testing/processes.py",
    ),
    "mujoco": ("drivers/gigabrain_drivers/sim/", "gigabrain_zenoh/qa/bench/jackal.py"),
}


def sources() -> list[Path]:
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def imports(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute here"
            yield (node.module or "").partition(".")[0]


def test_the_schemas_need_nothing_but_msgspec_and_numpy() -> None:
    allowed = {"gigabrain_schemas", "msgspec", "numpy"}
    for path in (ROOT / "schemas/gigabrain_schemas").rglob("*.py"):
        assert {name for name in imports(path) if name not in STANDARD} <= allowed, path


@pytest.mark.parametrize("library", ONLY_IN)
def test_a_library_stays_behind_its_own_modules(library: str) -> None:
    for path in sources():
        if library in imports(path):
            name = path.relative_to(ROOT).as_posix()
            assert name.startswith(ONLY_IN[library]), path


def lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """How long a function is without its docstring: what the command line shows lies there."""
    first = function.body[0]
    told = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)
    begin = (first.end_lineno or 0) if told else function.lineno
    return (function.end_lineno or 0) - begin


def test_every_function_fits_on_a_screen() -> None:
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert lines(node) <= 50, (path, node.name)
