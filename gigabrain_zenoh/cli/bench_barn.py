"""`gigabrain bench barn`: the BARN and DynaBARN tasks against a plant that makes it hard."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cyclopts import Parameter

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.bench.barn import BarnResult
    from gigabrain_zenoh.qa.bench.barn_course import BarnTrial


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Trials:
    """What is driven, and against what."""

    worlds: Path
    "The file of worlds: npz for BARN, JSON for DynaBARN."
    trials: int = 1
    "How often in each world."
    only: str = ""
    "Numbers of worlds, separated by commas; all without."
    dynamic: bool = False
    "DynaBARN: the obstacles move."
    plant: Literal["hard", "ideal", "mujoco"] = "hard"
    (
        "hard: 100 ms delay, 150 ms lag, slip to 0.6, drift 2 %, 3 cm noise, 10 % dropouts.\n"
        "ideal: none of it but 1 cm noise.\n"
        "mujoco: a skid-steer Jackal among solid posts, otherwise as hard; not with --dynamic."
    )
    nodes: bool = True
    (
        "Without them the functions that they call drive, with no map, bus or safety process; so "
        "they do with --dynamic, where nothing stands still that a map could be made of."
    )
    samples: int = 1000
    "Plans per cycle."
    jobs: int = 2
    "How many trials at the same time."

    def check(self) -> None:
        """Raises ConfigError for what cannot be driven."""
        for name in ("trials", "samples", "jobs"):
            above_zero(name, getattr(self, name))
        if self.dynamic and self.plant == "mujoco":
            raise ConfigError("--plant mujoco has no moving obstacles; leave out --dynamic")


def barn(*, of: Trials, json: Path | None = None) -> int:
    """Drive a Jackal through worlds that it does not know, and score it as the contest does.

    Example: gigabrain bench barn --worlds worlds.npz --trials 1 --only 1,7

    The robot's own nodes, its gate and the safety process run in memory and in fake time, tick by
    tick, against a plant with delay, lag, slip, drift and noise. Contacts are looked for in every
    tick.

    Parameters
    ----------
    json
        Write all trials into this file.
    """
    from rich.console import Console

    from gigabrain_zenoh.qa.bench.barn import measure_barn
    from gigabrain_zenoh.qa.bench.barn_course import choose_worlds, read_worlds

    of.check()
    files.check_result_path(json)
    chosen, nodes = (
        choose_worlds(read_worlds(of.worlds, of.dynamic), of.only),
        of.nodes and not of.dynamic,
    )
    result = measure_barn(chosen, of.trials, of.plant, of.samples, of.jobs, _progress, nodes=nodes)
    Console().print(_table(result, of.worlds.name, of.plant))
    files.write_result(result, json)
    return 0


def _progress(trial: "BarnTrial") -> None:
    text = f"world {trial.world} trial {trial.trial}: {trial.result} after {trial.seconds:.2f} s"
    text += f", least clearance {trial.least_clearance:.3f} m"
    print(text, file=sys.stderr, flush=True)


def _table(result: "BarnResult", file: str, plant: str) -> "Table":
    from rich.table import Table

    title = f"{file}, plant {plant}, {result.samples} plans a cycle"
    table = Table(title=title, show_header=False)
    table.add_column()
    table.add_column(justify="right")
    smallest, median = result.clearances
    rows = (
        ("trials", str(len(result.trials))),
        ("success", f"{result.share('success'):.3f}"),
        ("collision", f"{result.share('collision'):.3f}"),
        ("timeout", f"{result.share('timeout'):.3f}"),
        ("score (2024 and later, of 0.5)", f"{result.score:.4f}"),
        ("mean time of successes, s", _number(result.seconds)),
        ("least clearance, m", f"{smallest:.3f}"),
        ("median of each trial's least, m", f"{median:.3f}"),
        ("planning p50, ms", _number(result.cycle_ms(0.5))),
        ("planning p99, ms", _number(result.cycle_ms(0.99))),
    )
    for what, figure in rows:
        if figure is not None:  # what nodes take for a plan is not timed
            table.add_row(what, figure)
    return table


def _number(value: float | None) -> str | None:
    return None if value is None else f"{value:.2f}"
