"""`gigabrain why`, `doctor` and `log`: find faults of a robot, and their remedies."""

import time
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh import logs
from gigabrain_zenoh.cli.options import (
    LOCAL,
    JsonLines,
    ProcessOrAll,
    RobotAddress,
    on_bus,
    print_json,
    print_line,
)
from gigabrain_zenoh.errors import Ambiguous, BusError, ConfigError
from gigabrain_zenoh.host.escaping import printable_json
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_zenoh.diagnostics.log_reader import Line
    from gigabrain_zenoh.diagnostics.why import ChainFacts

GRADES = {"ok": "ok  ", "hint": "hint", "bad": "BAD "}
MAX_LINES = 1_000_000


def why(*, at: RobotAddress = LOCAL, json: bool = False) -> int:
    """Say why the robot does not move, and what to do about it.

    Example: gigabrain why

    It follows one command from link to link. Exit code 0 if no link is broken:
    the robot moves, or waits, for example for a goal. Otherwise the code of the broken
    link: 10 router, 11 driver, 12 link to the body, 13 scan, 14 world,
    15 intent, 16 control, 17 safety, 18 gate, 19 body.

    Args:
        json: Print one JSON object.
    """
    import msgspec

    from gigabrain_zenoh.diagnostics.why import judge

    verdict = judge(_chain_facts(at))
    broken, waits = verdict.broken, verdict.waits
    if json:
        summary = {
            "broken": broken.link if broken else None,
            "waits": waits.text if waits and not verdict.moves else None,
            **msgspec.to_builtins(verdict),
        }
        print_json(summary)
        return verdict.exit_code
    for status in verdict.findings:
        word = "BROKEN" if not status.ok else "waits" if status.waits else "ok"
        print_line(f"  {status.link:<8} {word:<6}  {status.text}")
    for note in verdict.notes:
        print_line(f"  note: {note}")
    if broken:
        moves = "It still moves, but not for long." if verdict.moves else "It does not move."
        print_line(f"{moves} {broken.link}: {_ended(broken.text)}")
        print_line(f"What to do: {broken.remedy}.")
    elif waits and not verdict.moves:
        print_line(f"It does not move, but no link is broken: {_ended(waits.text)}")
        print_line(f"What to do: {waits.remedy}.")
    else:
        print_line("It moves.")
    return verdict.exit_code


def _ended(sentence: str) -> str:
    """Return a sentence with a full stop, unless it ends with a question mark."""
    return sentence if sentence.endswith("?") else f"{sentence}."


def _chain_facts(at: RobotAddress) -> "ChainFacts":
    from gigabrain_zenoh.diagnostics.why import ChainFacts, ChainWatcher

    try:
        return on_bus(at, lambda bus: ChainWatcher(bus).collect())
    except Ambiguous:  # not a broken link: the user did not choose a robot
        raise
    except BusError as error:
        return ChainFacts(router=str(error))


def doctor(*, at: RobotAddress = LOCAL, json: JsonLines = False) -> int:
    """Check this machine and the robot, and say what to fix.

    Example: gigabrain doctor

    Exit code 1 if anything is bad; hints do not count.
    """
    from gigabrain_zenoh.diagnostics.doctor import (
        examine,
        exit_code,
        inspect_machine,
        inspect_robot,
    )

    robot, keys = run_async(inspect_robot(at.where()))
    results = examine(inspect_machine(keys), robot)
    for result in results:
        if json:
            print_json(result)
            continue
        print_line(f"{GRADES[result.grade]}  {result.about:<14} {result.text}")
        if result.cure:
            print_line(f"      {'':<14} -> {result.cure}")
    return exit_code(results)


def log(
    run: str = "",
    /,
    *,
    at: RobotAddress = LOCAL,
    process: ProcessOrAll = "",
    level: str = "debug",
    since: str = "",
    newest: Annotated[int, Parameter(alias="-n")] = 100,
    follow: bool = False,
    json: JsonLines = False,
) -> None:
    """Show the logs of all processes of a run on this machine, in order of time.

    Example: gigabrain log --process driver --level warning --since 10m

    With --follow it continues with new lines of all hosts, until Ctrl-C.

    Args:
        run: Folder of the run, or part of its name. Default: the one that runs, or the newest.
        level: Lowest level: debug, info, warning, error or critical.
        since: Maximum age: 90s, 10m, 2h, 1d.
        newest: Number of lines.
        follow: Continue with new lines, of level info and above.
    """
    from gigabrain_zenoh.diagnostics.log_reader import (
        LogFilter,
        ago_ns,
        follow_log,
        read,
        run_folder,
    )

    if not 0 < newest <= MAX_LINES:
        raise ConfigError(f"--newest: expected 1 to {MAX_LINES}, got {newest}")
    if at.connect and not follow:
        raise ConfigError(
            "logs of a remote robot are on its host; use --follow to receive new lines"
        )
    since_ns = ago_ns(since, time.time_ns()) if since else 0
    wanted = LogFilter(process=process, level=level, since_ns=since_ns)

    def show(line: "Line") -> None:
        if json:
            print_line(printable_json(logs.encode(line).decode()))
        else:
            print(logs.readable(line), flush=True)  # escaped; a traceback has several lines

    folder = None if at.connect else run_folder(run)

    def logged() -> "list[Line]":
        return read(folder, wanted, newest) if folder else []

    if follow:
        on_bus(at, lambda bus: follow_log(bus, wanted, show, logged))
        return
    for line in logged():
        show(line)
