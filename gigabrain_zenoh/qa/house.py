"""Checks module names in strings against the order of rooms, and prints the size of the code.

Run it in a checkout as `python -m gigabrain_zenoh.qa.house`, or with the argument `sizes`.
import-linter checks only import statements. A name in a string, such as
`"gigabrain_zenoh.safety.node:run"`, must keep the same order. If one does not, it exits with 1.
"""

import ast
import re
import statistics
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PACKAGES = ("gigabrain_zenoh", "drivers/gigabrain_drivers", "schemas/gigabrain_schemas")
NAME = re.compile(r"gigabrain_(?:zenoh|drivers|schemas)(?:\.\w+)+")
LIKELY = re.compile(r"""["'}]gigabrain_""")  # quick check for such a string
MAX_FUNCTION_LINES, MAX_FILE_LINES, MIN_FILE_LINES = 50, 450, 50
ROOMS = "each room names only rooms below it"
BY_NAME = ("launch", "gigabrain_drivers")  # allowed: the table of processes names the driver's

Modules = Mapping[str, Path]


def modules(root: Path) -> dict[str, Path]:
    """Return the path of each module of the product, by its dotted name."""
    found = {}
    for package in PACKAGES:
        base = (root / package).parent
        for path in sorted((root / package).rglob("*.py")):
            parts = path.relative_to(base).with_suffix("").parts
            found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def room_of(module: str) -> str:
    """Return the room of a module: `safety`, or the package's name outside `gigabrain_zenoh`."""
    package, _, rest = module.partition(".")
    return rest.partition(".")[0] if package == "gigabrain_zenoh" else package


class Rules(NamedTuple):
    """The contracts of import-linter that also hold for strings."""

    floor: Mapping[str, int]  # layer of each room, 0 for the top
    forbidden: Sequence[tuple[str, str, str]]  # importer, imported, name of the contract

    def broken_by(self, module: str, name: str) -> str:
        """Return the contract that `module` breaks when it names `name`; empty for none."""
        here, there = room_of(module), room_of(name)
        if (here, there) == BY_NAME:
            return ""
        for source, target, contract in self.forbidden:
            if _within(module, source) and _within(name, target):
                return contract
        if here == there or here not in self.floor or there not in self.floor:
            return ""
        return "" if self.floor[there] > self.floor[here] else ROOMS


def _within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def rules(root: Path) -> Rules:
    """Read the contracts of a checkout."""
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    (layers,) = (one["layers"] for one in contracts if one["type"] == "layers")
    return Rules(
        floor={r: floor for floor, rooms in enumerate(layers) for r in re.findall(r"\w+", rooms)},
        forbidden=[
            (source, target, one["name"])
            for one in contracts
            if one["type"] == "forbidden"
            for source in one["source_modules"]
            for target in one["forbidden_modules"]
        ],
    )


def names_in_strings(path: Path, known: Modules) -> Iterator[tuple[int, str]]:
    """Yield the modules that are named in strings of a file, each with its line."""
    source = path.read_text("utf-8")
    if not LIKELY.search(source):
        return  # saves a second, as parsing is slow
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = node.value.partition(":")[0]
            if NAME.fullmatch(text):
                while text not in known and "." in text:
                    text = text.rpartition(".")[0]
                yield node.lineno, text


def broken(root: Path) -> list[str]:
    """Return a line for each string that names a module which its room must not import."""
    known, judge, lines = modules(root), rules(root), []
    for module, path in known.items():
        for line, name in names_in_strings(path, known):
            if contract := judge.broken_by(module, name):
                where = path.relative_to(root).as_posix()
                lines.append(f"{where}:{line}: names {name}; the contract is: {contract}")
    return lines


class Size(NamedTuple):
    """Files and lines of a room."""

    files: int
    lines: int
    median: float  # lines of a file
    longest: int  # lines


def size_of(paths: Sequence[Path]) -> Size:
    """Count the lines of some files."""
    lines = [len(path.read_text("utf-8").splitlines()) for path in paths]
    return Size(len(lines), sum(lines), statistics.median(lines), max(lines))


def long_functions(paths: Sequence[Path]) -> list[str]:
    """Return the names of all functions that are longer than a screen, without docstrings."""
    found = []
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                head = node.body[0]
                is_text = isinstance(head, ast.Expr) and isinstance(head.value, ast.Constant)
                begin = (head.end_lineno or 0) if is_text else node.lineno
                if (node.end_lineno or 0) - begin > MAX_FUNCTION_LINES:
                    found.append(f"{path.name}:{node.name}")
    return found


def repeated_classes(known: Modules) -> dict[str, list[str]]:
    """Return the class names that a package uses more than once, by package."""
    classes: dict[str, Counter[str]] = {}
    for module, path in known.items():
        body = ast.parse(path.read_text("utf-8")).body
        names = [node.name for node in body if isinstance(node, ast.ClassDef)]
        classes.setdefault(module.partition(".")[0], Counter()).update(names)
    return {
        package: sorted(name for name, count in counted.items() if count > 1)
        for package, counted in classes.items()
    }


def show(root: Path) -> None:
    """Print the tables."""
    from rich.console import Console
    from rich.table import Table

    known = modules(root)
    rooms: dict[str, list[Path]] = {}
    for module, path in known.items():
        rooms.setdefault(room_of(module) or "(top)", []).append(path)
    table = Table("room", "files", "lines", "median", "longest", box=None)
    for room, paths in sorted(rooms.items()):
        table.add_row(room, *(f"{figure:g}" for figure in size_of(paths)))
    table.add_row("all", *(f"{figure:g}" for figure in size_of(list(known.values()))))
    console = Console()
    console.print(table)
    too_long = [p.name for p in known.values() if size_of([p]).lines > MAX_FILE_LINES]
    console.print(f"files over {MAX_FILE_LINES} lines: {', '.join(too_long) or 'none'}")
    small = sum(size_of([path]).lines < MIN_FILE_LINES for path in known.values())
    console.print(f"files under {MIN_FILE_LINES} lines: {small}")
    screens = long_functions(list(known.values()))
    console.print(f"functions over {MAX_FUNCTION_LINES} lines: {', '.join(screens) or 'none'}")
    for package, names in repeated_classes(known).items():
        console.print(f"{package}: {len(names)} class names used twice: {', '.join(names) or '-'}")


def main() -> None:
    """Print the names in strings that break the order of rooms, or print the sizes."""
    if sys.argv[1:] == ["sizes"]:
        show(ROOT)
        return
    lines = broken(ROOT)
    for line in lines:
        print(line)
    sys.exit(1 if lines else 0)


if __name__ == "__main__":
    main()
