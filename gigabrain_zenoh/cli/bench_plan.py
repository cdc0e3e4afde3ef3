"""`gigabrain bench plan`: global planning, timed."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.errors import ConfigError

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.bench.plan import PlanResult

LEAST = 400  # cells: below that no path is of the length that is asked for
# what Nav2's own documents say, of other maps on other machines
PUBLISHED = (
    ("Nav2 NavFn, about 75 m", 146.0),
    ("Nav2 Smac 2D A*, about 75 m", 243.0),
    ("Nav2 Smac Hybrid-A*, about 75 m", 144.0),
    ("Nav2 Smac Lattice, about 75 m", 113.0),
    ("Nav2 Theta*, 87.5 m", 46.0),
    ("Nav2 inflation, 2000 x 2000, one core", 48.9),
)


def plan(
    *,
    size: tuple[int, ...] = (1000, 2000),
    queries: int = 20,
    seed: int = 0,
    json: Path | None = None,
    png: Path | None = None,
) -> int:
    """Time global planning, on an office of 5 cm cells and on a random map, and check it.

    Example: gigabrain bench plan --size 1000 --size 2000 --queries 20

    Ends with 1 when any path was dearer than the cheapest.

    Parameters
    ----------
    size
        How many cells a side the map has; may be given again.
    queries
        How many paths of about three quarters of the map's side.
    seed
        For the maps and the queries.
    json
        Write all figures into this file.
    png
        Draw the last map and its paths into this file.
    """
    from rich.console import Console

    from gigabrain_zenoh.host import files
    from gigabrain_zenoh.qa.bench.plan import measure_plan

    above_zero("queries", queries)
    if any(one < LEAST for one in size):
        raise ConfigError(f"--size: expected at least {LEAST}, got {min(size)}")
    files.check_result_path(json)
    result = measure_plan(size, queries, seed, png, lambda text: print(text, file=sys.stderr))
    Console().print(_table(result))
    files.write_result(result, json)
    return 0 if result.ok else 1


def _table(result: "PlanResult") -> "Table":
    from rich.markup import escape
    from rich.table import Table

    table = Table(caption="Published figures are of other maps on other machines.")
    for name in ("map", "what", "n", "p50 [ms]", "p95 [ms]", "CPU p50 [ms]"):
        table.add_column(escape(name), justify="left" if name in ("map", "what") else "right")
    for one in result.sizes:
        for timing in one.timings:
            times = (timing.p50_ms, timing.p95_ms, timing.cpu_p50_ms)
            what = timing.what.replace("office", f"office, {one.path_m:.0f} m")
            row = (f"{one.size}²", what, str(timing.n), *(f"{ms:.1f}" for ms in times))
            table.add_row(*row)
        table.add_row(f"{one.size}²", "cost for Dijkstra's, worst", "", f"{one.ratio:.6f}", "", "")
        table.add_section()
    for what, ms in PUBLISHED:
        table.add_row("published", what, "", f"{ms:g}", "", "")
    return table
