"""`gigabrain bench bodies`: one brain, all bodies in turn, side by side."""

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.runtime.deployment import Deployment

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.bench.bodies import BodiesResult


def bodies(
    *names: str,
    link: Literal["sim", "emulated"] = "emulated",
    world: str = "arena",
    seed: int = 0,
    seconds: float = 30.0,
    json: Path | None = None,
) -> int:
    """Drive all bodies in turn with the same brain, which is neither restarted nor reconfigured.

    Example: gigabrain bench bodies --seconds 30 --world house

    Ends with 1 after any contact, or when a process of the brain had to be started again.

    Parameters
    ----------
    names
        Which robots; without names all that can be had over the link.
    link
        How to reach them.
    world
        Where they drive.
    seed
        For the start pose and the noise of the sensors.
    seconds
        How long each drives [s of its own time].
    json
        Write all figures into this file.
    """
    from rich.console import Console

    from gigabrain_drivers.driver.catalog import simulated
    from gigabrain_zenoh.host import files
    from gigabrain_zenoh.qa.bench.bodies import measure_bodies

    above_zero("seconds", seconds)
    files.check_result_path(json)
    chosen = names or simulated(link)
    deployment = Deployment(
        link=link, world=world, seed=seed, resume="auto", router="tcp/127.0.0.1:0"
    )
    console = Console()
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder, console.status("") as status:
        measuring = measure_bodies(chosen, deployment, seconds, Path(folder), status.update)
        result = run_async(measuring)
    console.print(_table(result))
    files.write_result(result, json)
    return 0 if result.ok else 1


def _table(result: "BodiesResult") -> "Table":
    from rich.markup import escape
    from rich.table import Table

    brain = ", ".join(f"{name} {pid}" for name, pid in result.brain_pids.items())
    table = Table(
        title=f"link {result.link}, {result.world}, seed {result.seed}",
        caption=f"one brain: {brain}; restarts {result.brain_restarts}",
    )
    table.add_column("")
    for body in result.bodies:
        table.add_column(body.body, justify="right")
    rows = (
        ("driven [s]", "seconds"),
        ("contacts", "contacts"),
        ("distance [m]", "distance_m"),
        ("mean speed commanded [m/s]", "commanded"),
        ("mean speed measured [m/s]", "measured"),
        ("least clearance [m]", "min_clearance_m"),
        ("command to motion, median [ticks]", "latency_ticks"),
        ("... of so many motions", "motions"),
        ("CPU of the driver [% of a core]", "driver_cpu"),
        ("reconnects", "reconnects"),
        ("gate shut meanwhile", "stops"),
    )
    for title, field in rows:
        table.add_row(escape(title), *(_text(getattr(body, field)) for body in result.bodies))
    return table


def _text(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"
