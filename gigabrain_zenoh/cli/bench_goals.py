"""`gigabrain bench goals`: explore, then get to places drawn at random, all processes running."""

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from gigabrain_zenoh.cli.checked import above_zero
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.bench.goals import GoalsResult

BODIES = ("turtlebot3_waffle", "mycustombot", "alpha")
WORLDS = ("house", "warehouse")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Runs:
    """Who is sent where."""

    bodies: tuple[str, ...] = BODIES
    "Which robots; may be given again."
    worlds: tuple[str, ...] = WORLDS
    "Where; may be given again."
    goals: int = 100
    "How many places each robot is sent to in each world."
    meetings: int = 0
    "Send it on until the person of the world has had to stand for it so often."
    hours: float = 0.0
    "Send it on for so long, of its own time, and tell what perception's memory came to."
    speed: float = 5.0
    "How many times faster than real time."
    seed: int = 0
    "For the start, the sensors' noise and the places."


RUNS = Runs()


def goals(*, of: Runs = RUNS, json: Path | None = None, logs: Path | None = None) -> int:
    """Have each body explore each world in MuJoCo, then send it to places drawn at random.

    Example: gigabrain bench goals --bodies alpha --worlds house --goals 10 --speed 1
    Example: gigabrain bench goals --bodies turtlebot3_waffle --worlds house --hours 8

    The table says how long mapping took, how much room the body kept round it at least, how long a
    goal took in the mean, how far from a goal and a wanted heading it came to rest at most (by the
    physics: errors of the map are in it), how often the person of the world had to stand for the
    robot, and how many ticks went on without the brain because the host was too busy. A robot that
    says that it is there, and by the physics is half a metre or 15 degrees off, has not reached it.

    Ends with 1 after any contact, or when more than one goal in a hundred was not reached.

    Parameters
    ----------
    json
        Write all figures into this file.
    logs
        Keep the logs of all processes in this folder.
    """
    from gigabrain_zenoh.qa.bench.goals import GoalCourse, measure_goals

    above_zero("goals", of.goals)
    above_zero("speed", of.speed)
    files.check_result_path(json)
    course = GoalCourse(
        goals=of.goals,
        meetings=of.meetings,
        hours=of.hours,
        speed=of.speed,
        seed=of.seed,
        logs=logs,
    )
    result = run_async(measure_goals(of.bodies, of.worlds, course, _progress))
    _show(result)
    files.write_result(result, json)
    return 0 if result.ok else 1


def _show(result: "GoalsResult") -> None:
    """The table, and what was not reached and why."""
    from rich.console import Console

    from gigabrain_zenoh.decision.tasks.drive_command import describe_goal

    console = Console()
    console.print(_table(result))
    for run in result.runs:
        grown = run.growth
        console.print(
            f"{run.body} in {run.world}: perception at most {grown.most_mb:.0f} MB, "
            f"{grown.mb_an_hour:+.1f} MB/h after the first quarter; "
            f"occupied cells by the hour: {', '.join(map(str, grown.walls))}",
            soft_wrap=True,
        )
    for run in result.runs:
        for one in run.failures:
            after = f"after {one.seconds:.0f} s"
            failure = f"{run.body} in {run.world}, {describe_goal(one.goal)} {after}: {one.reason}"
            console.print(failure, markup=False, soft_wrap=True)


def _progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _table(result: "GoalsResult") -> "Table":
    from rich.table import Table
    from rich.text import Text

    faster = ", ".join(sorted({f"x{run.speed:g}" for run in result.runs}))
    title = f"seed {result.seed}, {faster} real time"
    table = Table("body", "world", title=title, box=None, padding=(0, 1, 0, 0), pad_edge=False)
    for name in (
        "mapped\n[s]", "reached", "con-\ntacts", "room\n[m]", "goal\n[s]", "off\n[m]", "turn\n[°]",
        "met", "alone",
    ):  # fmt: skip
        table.add_column(Text(name), justify="right")  # of 80 columns all that there is room for
    for run in result.runs:
        table.add_row(
            run.body, run.world, f"{run.explored_s:.0f}", f"{run.reached}/{run.goals}",
            f"{run.contacts}", f"{run.min_clearance_m:.3f}", f"{run.seconds_per_goal:.1f}",
            f"{run.worst_m:.2f}", f"{math.degrees(run.worst_rad):.1f}",
            f"{run.met}", f"{run.alone}",
        )  # fmt: skip
    return table
