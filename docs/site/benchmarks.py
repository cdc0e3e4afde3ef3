"""Tables of measurements in `docs/benchmarks/`, made from the files in its folder `results`.

`python -m docs.site.benchmarks` writes the tables of all pages again. A new measurement:

    gigabrain bench plan --size 2000 --json plan.json
    python -m docs.site.benchmarks plan plan.json "gigabrain bench plan --size 2000"

stores the table that the command printed, with command, date and machine, in `results/plan.json`.
"""

import json
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gigabrain_zenoh.cli import bench, bench_eyes, bench_hands, bench_navigation
from gigabrain_zenoh.qa.bench.barn import BarnResult
from gigabrain_zenoh.qa.bench.bodies import BodiesResult
from gigabrain_zenoh.qa.bench.camera_cost import CameraCost, cameras_table
from gigabrain_zenoh.qa.bench.chain import ChainResult, chain_page
from gigabrain_zenoh.qa.bench.clutter import ClutterResult
from gigabrain_zenoh.qa.bench.estop import EstopResult, estop_page
from gigabrain_zenoh.qa.bench.eyes import EyesResult
from gigabrain_zenoh.qa.bench.fetch import FetchResult
from gigabrain_zenoh.qa.bench.goals import GoalsResult
from gigabrain_zenoh.qa.bench.hands import HandsResult
from gigabrain_zenoh.qa.bench.joints import TrackingResult
from gigabrain_zenoh.qa.bench.objects import ObjectsResult
from gigabrain_zenoh.qa.bench.plan import PlanResult
from gigabrain_zenoh.qa.bench.reach import ReachResult
from gigabrain_zenoh.qa.bench.robots import RobotsResult, robots_page
from gigabrain_zenoh.qa.bench.slam_logs import SlamResult
from gigabrain_zenoh.qa.bench.stack import StackResult, stack_page

PAGES = Path(__file__).parents[1] / "benchmarks"
RESULTS = PAGES / "results"
BLOCK = re.compile(r"^<!-- table: (\w+) -->\n.*?^<!-- end -->\n", re.MULTILINE | re.DOTALL)
DRAWN: dict[str, tuple[type[Struct], Callable[[Any], Any]]] = {  # by the words behind `bench`
    "barn": (BarnResult, lambda result: bench_navigation._barn_table(result, "worlds", "plant")),
    "bodies": (BodiesResult, bench._bodies_table),
    "cameras": (CameraCost, cameras_table),
    "chain": (ChainResult, chain_page),
    "clutter": (ClutterResult, bench_eyes._clutter_table),
    "estop": (EstopResult, estop_page),
    "eyes": (EyesResult, bench_eyes._eyes_table),
    "fetch": (FetchResult, bench_hands._fetch_table),
    "goals": (GoalsResult, bench_navigation._goals_table),
    "hands": (HandsResult, bench_hands._hands_table),
    "joints": (TrackingResult, bench_hands._joints_table),
    "objects": (ObjectsResult, bench_eyes._objects_table),
    "plan": (PlanResult, bench._plan_table),
    "reach": (ReachResult, bench_hands._reach_table),
    "robots": (RobotsResult, robots_page),
    "slam": (SlamResult, bench_navigation._logs_table),
    "stack": (StackResult, stack_page),
}


class Measured(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A table of measurements."""

    command: str  # what measured it
    date: str
    machine: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]  # Markdown

    def lines(self) -> Iterator[str]:
        """Yield the table and where it comes from, as Markdown."""
        yield f"| {' | '.join(self.columns)} |"
        yield f"|{'---|' * len(self.columns)}"
        for row in self.rows:
            yield f"| {' | '.join(row)} |"
        yield ""
        yield f"{self.command} · {self.date} · {self.machine}"


def load(name: str) -> Measured:
    """Return a stored table. Raises FileNotFoundError."""
    return msgspec.json.decode((RESULTS / f"{name}.json").read_bytes(), type=Measured)


def made(page: str) -> str:
    """Return the text of a page with its tables made again."""

    def block(found: re.Match[str]) -> str:
        lines = "\n".join(load(found[1]).lines())
        return f"<!-- table: {found[1]} -->\n{lines}\n<!-- end -->\n"

    return BLOCK.sub(block, page)


def measured(kind: str, result: bytes, command: str) -> Measured:
    """Return the table that `gigabrain bench KIND` prints for what it wrote with `--json`."""
    type_, draw = DRAWN[kind]
    page = draw(msgspec.json.decode(result, type=type_))
    tables = page.renderables if isinstance(page, Group) else [page]
    table = next(one for one in tables if isinstance(one, Table))
    cells = [[_plain(cell) for cell in column.cells] for column in table.columns]
    return Measured(
        command=f"`{command}`",
        date=time.strftime("%Y-%m-%d"),
        machine=this_machine(),
        columns=tuple(_plain(column.header) for column in table.columns),
        rows=tuple(zip(*cells, strict=True)),
    )


def this_machine() -> str:
    """Return what matters of this machine, in words."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("eclipse-zenoh", "mujoco-core"))
    python = platform.python_version()
    system = f"{platform.machine()}, {platform.system()}, Python {python}"
    return f"{os.cpu_count()} cores ({system}, {libraries})"


def _plain(cell: Any) -> str:
    text = cell.plain if isinstance(cell, Text) else str(cell)
    return " ".join(text.replace("|", "\\|").split())


def main() -> None:
    """Store a measurement, if one is named, and write the pages again."""
    if sys.argv[1:]:
        kind, file, command = sys.argv[1:]
        found = measured(kind, Path(file).read_bytes(), command)
        store(kind, found)
    for page in PAGES.glob("*.md"):
        page.write_text(made(page.read_text("utf-8")), "utf-8")


def store(name: str, found: Measured) -> None:
    """Write a table into the folder of results."""
    values = msgspec.to_builtins(found)
    rows = ",\n  ".join(json.dumps(row, ensure_ascii=False) for row in values.pop("rows"))
    head = json.dumps(values, ensure_ascii=False, indent=1).rstrip("\n}")
    (RESULTS / f"{name}.json").write_text(f'{head},\n "rows": [\n  {rows}\n ]\n}}\n', "utf-8")


if __name__ == "__main__":
    main()
