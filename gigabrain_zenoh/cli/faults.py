"""`gigabrain faults`: break the robot on purpose, and see whether it stops."""

import logging
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from gigabrain_zenoh.cli.where import show
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.faults.fault import FaultResult, FaultRow, FaultRun
    from gigabrain_zenoh.qa.faults.rig.rig import Options


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Robot:
    """What is broken."""

    body: str = ""
    "Which robot, instead of the one that each test has."
    world: str = "arena"
    "Where it drives."
    behaviour: str = "avoid"
    (
        "What drives it: navigate explores and visits places, with a map (tried with 1 to 9, 18, "
        "19, 43 and 45)."
    )
    long: Annotated[bool, Parameter(negative=())] = False
    "The long forms, for a release: soak, load, all orders of deaths."

    def check(self) -> None:
        """Raises ConfigError for what the suite cannot be run with."""
        from gigabrain_drivers.driver.catalog import load_robot, simulated
        from gigabrain_drivers.sim.worlds import load_world

        load_world(self.world, 0)
        behaviours.load(self.behaviour)
        if not self.body:
            return
        sim = load_robot(self.body).sim
        if not sim or sim.get("driver") != "mujoco":
            able = ", ".join(simulated("sim"))
            raise ConfigError(
                f"--body {self.body}: no physics knows what becomes of it; choose of: {able}"
            )

    def options(self) -> "Options":
        """As the suite takes it."""
        from gigabrain_zenoh.qa.faults.rig.rig import Options

        return Options(self.body, self.world, self.behaviour, self.long)


ROBOT = Robot()


def faults(
    *,
    list_: Annotated[bool, Parameter(name="--list", negative=())] = False,
    only: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    skip: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    repeat: Annotated[int, Parameter(validator=Number(gte=1))] = 1,
    robot: Robot = ROBOT,
    into: Path | None = None,
    json: Path | None = None,
) -> int:
    """Break a running robot in all the ways of the table, and judge how it stops.

    Example: gigabrain faults --only decision-killed 12 --repeat 3

    Real processes, a simulated or emulated body; the robot's own time and the physics' truth
    decide. Ends with 1 when any test failed.

    Parameters
    ----------
    list_
        Show the table, and run nothing.
    only
        Which tests, by name or number.
    skip
        Which tests not.
    repeat
        How many runs of each count; the worst of them is judged.
    into
        Append each run to this file, and go on from those that are in it.
    json
        Write all results into this file.
    """
    from gigabrain_zenoh.qa.faults.suite import choose, failed

    left_out = choose(skip) if skip else ()
    chosen = tuple(fault for fault in choose(only) if fault not in left_out)
    if list_:
        show(_plan(chosen))
        return 0
    robot.check()
    files.check_result_path(json)
    files.check_result_path(into)
    judged = _run(chosen, robot.options(), repeat, into)
    show(_table(judged, chosen))
    files.write_result(judged, json)
    return 1 if failed(judged) else 0


def _run(
    chosen: "Sequence[FaultRow]", options: "Options", repeat: int, into: Path | None
) -> "list[FaultResult]":
    """Run them, with a line for each run that has ended."""
    from rich.console import Console

    from gigabrain_zenoh.qa.faults.suite import RunsFile, run_suite

    # the suite hears what it forges itself; nobody has to read that
    logging.getLogger("gigabrain_zenoh").addHandler(logging.NullHandler())
    console, file = Console(), RunsFile(into, options) if into else None
    earlier = file.read() if file else {}
    with tempfile.TemporaryDirectory(prefix="gb-") as folder, console.status("") as status:

        def begun(fault: "FaultRow") -> None:
            status.update(f"{chosen.index(fault) + 1} of {len(chosen)}: {fault.name}")

        def ended(fault: "FaultRow", run: "FaultRun") -> None:
            console.print(_line(fault, run))
            if file:
                file.append(fault, run)

        suite = run_suite(chosen, options, Path(folder), repeat, begun, ended, earlier)
        return run_async(suite)


def _line(fault: "FaultRow", run: "FaultRun") -> str:
    why = f": {run.reason}" if run.reason else ""
    disturbed = f", disturbed: waited {run.waited_ms:g} ms for a core" if run.disturbed else ""
    return f"{fault.number:>2} {fault.name}: {run.verdict}{why} ({run.seconds:g} s{disturbed})"


def _plan(chosen: "Sequence[FaultRow]") -> "Table":
    from rich.table import Table

    table = Table(title="fault tests")
    for name in ("no.", "fault", "group", "criterion", "needs"):
        table.add_column(name, overflow="fold", no_wrap=name == "fault")
    for fault in chosen:
        needs = ", ".join(fault.needs)
        table.add_row(str(fault.number), fault.name, fault.group, fault.criterion, needs)
    return table


def _table(results: "Sequence[FaultResult]", chosen: "Sequence[FaultRow]") -> "Table":
    from rich.markup import escape
    from rich.table import Table

    from gigabrain_zenoh.qa.faults.fault import in_words
    from gigabrain_zenoh.qa.judging import COLOURS

    rows = {fault.number: fault for fault in chosen}
    passed = sum(result.verdict == "passed" for result in results)
    table = Table(title=f"{passed} of {len(results)} passed")
    for name in ("no.", "fault", "criterion", "worst", "tries", "waited", "verdict"):
        table.add_column(name, overflow="fold", no_wrap=name == "fault")
    for result in results:
        told = f"[{COLOURS[result.verdict]}]{result.verdict}[/]"
        if result.reason:
            told += f": {escape(result.reason)}"
        worst = in_words(rows[result.number], result.worst)
        waited = f"{max(one.waited_ms for one in result.tries):.0f} ms"
        number, tries = str(result.number), _tries(result.tries)
        table.add_row(number, result.name, result.criterion, worst, tries, waited, told)
    return table


def _tries(tries: "Sequence[FaultRun]") -> str:
    """Say what came of all runs: `9 of 10, disturbed: 1 of 2`."""
    counted = [one.verdict == "passed" for one in tries if not one.disturbed]
    disturbed = [one.verdict == "passed" for one in tries if one.disturbed]
    beside = f", disturbed: {sum(disturbed)} of {len(disturbed)}" if disturbed else ""
    return f"{sum(counted)} of {len(counted)}{beside}"
