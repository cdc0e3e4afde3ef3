"""`gigabrain driver test`, `new` and `trace`: for whoever writes drivers."""

import logging
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal, Self

from cyclopts import Parameter
from cyclopts.validators import Number

from gigabrain_zenoh.cli.checked import above_zero, finite
from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.host.signals import run_async


class _Said(logging.Handler):
    """Gathers the warnings of whatever is tried, instead of a line for each. Used as `with`."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.texts: Counter[str] = Counter()

    def emit(self, record: logging.LogRecord) -> None:
        """Count it."""
        self.texts[record.getMessage()] += 1

    def __enter__(self) -> Self:
        logging.getLogger().addHandler(self)
        return self

    def __exit__(self, *_: object) -> None:
        logging.getLogger().removeHandler(self)

    def __str__(self) -> str:
        return "; ".join(
            f"{text} ({times} times)" if times > 1 else text for text, times in self.texts.items()
        )


def test(
    name: str,
    *,
    link: Literal["sim", "emulated"] | None = None,  # noqa: PT028
    repeat: Annotated[int, Parameter(validator=Number(gte=1))] = 1,  # noqa: PT028
) -> int:
    """Check whether a driver does all that every driver has to do; ends with 1 if it does not.

    Example: gigabrain driver test mycustombot --link emulated

    A check that does not apply to a link is shown as skipped with the reason, not as passed.

    Parameters
    ----------
    name
        A known robot, or the path of a robot's YAML file.
    link
        The emulated one, where the robot has one: it shows more than the simulated one.
    repeat
        How often each stop is tried, by silence, SIGKILL, and a line that is cut or hangs; the
        table then shows the worst and the median.
    """
    from rich.console import Console
    from rich.table import Table

    from gigabrain_drivers.driver.catalog import links_of, load_robot
    from gigabrain_zenoh.qa.conformance import kit
    from gigabrain_zenoh.qa.judging import COLOURS

    links = links_of(load_robot(name))
    chosen: LinkName = link or ("emulated" if "emulated" in links else "sim")
    table = Table(title=f"{name}, link {chosen}")
    for title in ("check", "criterion", "measured", "verdict"):
        table.add_column(title)
    console = Console()
    said = _Said()
    place = tempfile.TemporaryDirectory(prefix="gigabrain-")
    with said, place as folder, console.status("") as status:
        results = run_async(kit.check(name, chosen, Path(folder), status.update, repeat))
    for result in results:
        colour = COLOURS[result.verdict]
        table.add_row(*result[:-1], f"[{colour}]{result.verdict}[/]")
    if said.texts:
        console.print(
            f"what was broken on purpose, in its own words: {said}", markup=False, soft_wrap=True
        )
    console.print(table)
    return int(any(result.verdict == "FAILED" for result in results))


def trace(
    name: str,
    *,
    link: Literal["emulated", "real"] = "emulated",
    part: Literal["base", "scan"] = "base",
    seconds: float = 2.0,
    linear_x: float = 0.0,
    linear_y: float = 0.0,
    angular_z: float = 0.0,
) -> int:
    """Show the bytes on a body's line both ways, each frame decoded beside its hex.

    Example: gigabrain driver trace mycustombot --seconds 0.5 --linear-x 0.1

    It starts the driver itself: on an emulator of its own, or on the real port, which nobody else
    may have open then; a real body is commanded zero only. A driver that runs already writes the
    same lines to its log with: gigabrain driver run NAME --link real --level debug

    Ends with 1 when nothing was received.

    Parameters
    ----------
    name
        A known robot, or the path of a robot's YAML file.
    link
        Which line.
    part
        The body's own line, or that of its lidar.
    seconds
        How long [s].
    linear_x
        What an emulated body is commanded all the time [m/s].
    linear_y
        The same to its left [m/s].
    angular_z
        What an emulated body is commanded all the time [rad/s].
    """
    above_zero("seconds", seconds)
    speeds = {"linear_x": linear_x, "linear_y": linear_y, "angular_z": angular_z}
    for option, speed in speeds.items():
        finite(option, speed)
    received = _traced(name, link, part, seconds, speeds)
    if not received:
        print("nothing was received", file=sys.stderr)
    return int(not received)


def _traced(name: str, link: LinkName, part: str, seconds: float, speeds: dict[str, float]) -> bool:
    """Print the bytes; whether any came from the body, or whoever was reading has seen enough."""
    from gigabrain_schemas.base import Velocity
    from gigabrain_zenoh.qa.conformance import authoring

    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
        tracing = authoring.trace_line(
            name,
            link,
            Path(folder),
            part=part,
            seconds=seconds,
            wanted=Velocity(**speeds),
            say=lambda line: print(line, flush=True),
        )
        try:
            return bool(run_async(tracing))
        except BrokenPipeError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return True


def new(name: str, *, folder: Path = Path()) -> int:
    """Write the package of a new driver, which passes `gigabrain driver test` as it is.

    Example: gigabrain driver new myrobot

    Nothing that exists is overwritten.

    Parameters
    ----------
    name
        Of the robot and of its driver: lower-case letters, digits and underscores.
    folder
        Where the package's folder is made.
    """
    from gigabrain_zenoh.qa.conformance.authoring import write_package

    path = write_package(name, folder)
    print(f"{path}: edit robot.yaml and driver.py; README.md says how to go on")
    return 0
