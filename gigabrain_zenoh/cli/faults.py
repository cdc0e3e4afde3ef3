"""`gigabrain faults` and `proxy`: inject faults into a robot or its network."""

import asyncio
import logging
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter

from gigabrain_zenoh.cli.options import (
    AnySeed,
    JsonFile,
    check_names,
    check_positive,
    print_line,
    print_table,
)
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.network import is_loopback
from gigabrain_zenoh.host.signals import run_async
from gigabrain_zenoh.host.terminal import typed_lines
from gigabrain_zenoh.qa.proxy.chaos import (
    CALM,
    WAYS,
    ProxyCommand,
    parse_command,
)
from gigabrain_zenoh.qa.proxy.tcp import Address, TcpProxy

if TYPE_CHECKING:
    from rich.table import Table

    from gigabrain_zenoh.qa.faults.rig import Options
    from gigabrain_zenoh.qa.judging import FaultResult, FaultRow, FaultRun
    from gigabrain_zenoh.qa.proxy.serial import LineProxy

    FaultyLine = LineProxy | TcpProxy

ENDPOINT = re.compile(r"(?:(?:tcp|tls|ws)/)?(?P<host>\[[^\]]+\]|[^/:\[\]]+):(?P<port>\d+)")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SuiteOptions:
    """Robot of the fault suite."""

    body: str = ""
    "Robot, instead of the one of each test."
    world: str = "arena"
    "Simulated world; see `gigabrain worlds`."
    behaviour: str = "avoid"
    "Behaviour. `navigate` makes a map (tried with tests 1 to 9, 18, 19, 43 and 45)."
    cameras: Annotated[bool, Parameter(negative=())] = False
    "Use simulated cameras in all tests, not only in the camera tests."
    long: Annotated[bool, Parameter(negative=())] = False
    "Run the long variants, as before a release: soak, load, all kill orders."

    def check(self) -> None:
        """Raise ConfigError if the suite cannot run with these options."""
        from gigabrain_drivers.driver.catalog import load_robot, simulated

        check_names(worlds=[self.world])
        behaviours.load(self.behaviour)
        if not self.body:
            return
        sim = load_robot(self.body).sim
        if not sim or sim.get("driver") != "mujoco":
            able = ", ".join(simulated("sim"))
            raise ConfigError(f"--body {self.body}: not simulated in MuJoCo; choose one of: {able}")

    def options(self) -> "Options":
        """Return the options for the suite."""
        from gigabrain_zenoh.qa.faults.rig import Options

        return Options(self.body, self.world, self.behaviour, self.cameras, self.long)


DEFAULT = SuiteOptions()


def faults(
    *,
    list_: Annotated[bool, Parameter(name="--list", negative=())] = False,
    only: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    skip: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = (),
    repeat: int = 1,
    robot: SuiteOptions = DEFAULT,
    into: Path | None = None,
    json: JsonFile = None,
) -> int:
    """Inject every fault of the table into a running robot, and check that it stops.

    Example: gigabrain faults --only decision-killed 12 --repeat 3

    It uses real processes, and a simulated or emulated robot. Results are
    judged by the robot's own time and by the simulator's true state. Exit code
    1 if a test fails.

    Args:
        list_: Print the table of tests, and exit.
        only: Names or numbers of the tests to run.
        skip: Names or numbers of the tests to leave out.
        repeat: Number of runs per test; the worst one is judged.
        into: Append each run to this file, and skip the runs that it holds.
    """
    from gigabrain_zenoh.qa.faults.suite import choose, failed

    check_positive(repeat=repeat)
    left_out = choose(skip) if skip else ()
    chosen = tuple(fault for fault in choose(only) if fault not in left_out)
    if not chosen:
        raise ConfigError("--skip leaves no test to run; see `gigabrain faults --list`")
    if list_:
        print_table(_plan(chosen))
        return 0
    robot.check()
    files.check_result_path(json)
    files.check_result_path(into)
    judged = _run(chosen, robot.options(), repeat, into)
    print_table(_table(judged, chosen))
    files.write_result(judged, json)
    return 1 if failed(judged) else 0


def _run(
    chosen: "Sequence[FaultRow]", options: "Options", repeat: int, into: Path | None
) -> "list[FaultResult]":
    """Run the tests, and print a line after each run."""
    from rich.console import Console

    from gigabrain_zenoh.diagnostics.discovery import plain
    from gigabrain_zenoh.qa.faults.suite import RunsFile, run_suite

    # hides warnings about messages that the suite itself forges
    logging.getLogger("gigabrain_zenoh").addHandler(logging.NullHandler())
    console, file = Console(), RunsFile(into, options) if into else None
    earlier = file.read() if file else {}
    with tempfile.TemporaryDirectory(prefix="gb-") as folder, console.status("") as status:

        def on_start(fault: "FaultRow") -> None:
            status.update(f"{chosen.index(fault) + 1} of {len(chosen)}: {fault.name}")

        def on_end(fault: "FaultRow", run: "FaultRun") -> None:
            console.print(plain(_line(fault, run)), soft_wrap=True)
            if file:
                file.append(fault, run)

        suite = run_suite(chosen, options, Path(folder), repeat, on_start, on_end, earlier)
        return run_async(suite)


def _line(fault: "FaultRow", run: "FaultRun") -> str:
    reason = f": {run.reason}" if run.reason else ""
    disturbed = f", disturbed: waited {run.waited_ms:g} ms for a core" if run.disturbed else ""
    return f"{fault.number:>2} {fault.name}: {run.verdict}{reason} ({run.seconds:g} s{disturbed})"


def _plan(chosen: "Sequence[FaultRow]") -> "Table":
    table = _fault_table("fault tests", "group", "criterion", "needs")
    for fault in chosen:
        needs = ", ".join(fault.needs)
        table.add_row(str(fault.number), fault.name, fault.group, fault.criterion, needs)
    return table


def _fault_table(title: str, *columns: str) -> "Table":
    from rich.table import Table

    table = Table(title=title)
    for name in ("no.", "fault", *columns):
        table.add_column(name, overflow="fold", no_wrap=name == "fault")
    return table


def _table(results: "Sequence[FaultResult]", chosen: "Sequence[FaultRow]") -> "Table":
    from rich.markup import escape

    from gigabrain_zenoh.qa.judging import coloured, in_words

    rows = {fault.number: fault for fault in chosen}
    passed = sum(result.verdict == "passed" for result in results)
    title = f"{passed} of {len(results)} passed"
    table = _fault_table(title, "criterion", "worst", "tries", "waited", "verdict")
    for result in results:
        verdict = coloured(result.verdict)
        if result.reason:
            verdict += f": {escape(result.reason)}"
        worst = in_words(rows[result.number], result.worst)
        waited = f"{max(one.waited_ms for one in result.tries):.0f} ms"
        number, tries = str(result.number), _tries(result.tries)
        table.add_row(number, result.name, result.criterion, worst, tries, waited, verdict)
    return table


def _tries(tries: "Sequence[FaultRun]") -> str:
    """Return the count of passed runs: `9 of 10, disturbed: 1 of 2`."""
    counted = [run.verdict == "passed" for run in tries if not run.disturbed]
    disturbed = [run.verdict == "passed" for run in tries if run.disturbed]
    also = f", disturbed: {sum(disturbed)} of {len(disturbed)}" if disturbed else ""
    return f"{sum(counted)} of {len(counted)}{also}"


def proxy(
    to: str,
    *,
    listen: str = "tcp/127.0.0.1:0",
    baud: int = 115200,
    chaos: str = "",
    seed: AnySeed = 0,
    insecure: bool = False,
) -> int:
    """Emulate a bad network in front of a router or a robot's port, until Ctrl-C.

    Example: gigabrain proxy tcp/127.0.0.1:7447 --listen tcp/127.0.0.1:7448

    In another terminal: gigabrain control --connect tcp/127.0.0.1:7448

    Type faults, one per line: `delay_ms=50 jitter_ms=20`, `down hole`,
    `corrupt=0.001`, `cut=rst`, `figures`, `off`.

    Args:
        to: Zenoh endpoint, HOST:PORT, or path of a serial port to forward to.
        listen: Endpoint to listen on; port 0 for a free one. For a serial port, a new path.
        baud: Baud rate of a serial port.
        chaos: Faults from the start, in the same words.
        seed: Random seed of the faults.
        insecure: Listen beyond loopback: others on the network can then reach the robot.
    """
    first = parse_command(chaos)
    check_positive(baud=baud)
    if to.startswith("/"):
        from gigabrain_zenoh.qa.proxy.serial import LineProxy

        line: FaultyLine = LineProxy(to, _path(listen), baud=baud, seed=seed)
    else:
        line = TcpProxy(_address(to), _own(listen, insecure), seed=seed)
    run_async(_run_proxy(line, first, to))
    return 0


async def _run_proxy(proxy: "FaultyLine", first: ProxyCommand, to: str) -> None:
    async with proxy:
        await obey(proxy, first)
        print_line(f"{proxy} forwards to {to}")
        print_line(f"type [{'|'.join(WAYS)}] {' '.join(CALM.__struct_fields__)}; "
                   "cut[=rst] unplug plug figures; off ends it")  # fmt: skip
        typed: asyncio.Queue[str] = asyncio.Queue()
        with typed_lines(typed.put_nowait):
            while True:
                try:
                    await obey(proxy, parse_command(await typed.get()))
                except ConfigError as error:
                    print_line(str(error))


async def obey(proxy: "FaultyLine", command: ProxyCommand) -> None:
    """Execute a command that was typed."""
    if command.cut:
        proxy.cut(reset=command.cut == "rst")
    if command.unplugged is not None:
        await (proxy.unplug if command.unplugged else proxy.plug)()
    if command.figures:
        for way, figures in proxy.figures.items():
            print_line(f"{way}: {msgspec.json.encode(figures).decode()}")
    if command.ways:
        proxy.set(command.chaos, *command.ways)


def _path(listen: str) -> Path:
    if "/" not in listen or listen.startswith("tcp/"):
        raise ConfigError(f"--listen: expected the path of the new port, got {listen!r}")
    return Path(listen)


def _own(listen: str, insecure: bool) -> Address:
    address = _address(listen)
    if not insecure and not is_loopback(address[0]):
        raise ConfigError(
            f"--listen: anybody on the network can reach {listen}, and the robot through it; "
            "use a loopback address, or add --insecure"
        )
    return address


def _address(text: str) -> Address:
    found = ENDPOINT.fullmatch(text)
    if not found or int(found["port"]) > 65535:
        raise ConfigError(f"expected an endpoint such as tcp/127.0.0.1:7447, got {text!r}")
    return found["host"].strip("[]"), int(found["port"])
