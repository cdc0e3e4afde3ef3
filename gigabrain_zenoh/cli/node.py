"""`gigabrain node`, `graph`, `top` and `param`: show and configure the processes of a robot."""

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.options import (
    LOCAL,
    JsonLines,
    Process,
    ProcessOrAll,
    RobotAddress,
    check_name,
    checked,
    on_bus,
    print_json,
    print_line,
    print_progress,
    print_table,
)
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused, unknown
from gigabrain_zenoh.host.files import (
    cannot_write,
    check_picture_path,
    check_result_path,
    replace_file,
)

if TYPE_CHECKING:
    from gigabrain_schemas.requests import ParamReply
    from gigabrain_zenoh.bus.bus import Bus
    from gigabrain_zenoh.diagnostics.discovery import Processes
    from gigabrain_zenoh.diagnostics.top import Feed

INSTALL_TOP = "for the live view: pip install 'gigabrain-zenoh[view]'; or use: gigabrain top --once"


def list_(*, at: RobotAddress = LOCAL, json: JsonLines = False) -> None:
    """List the running processes: host, uptime, CPU, memory.

    Example: gigabrain node list
    """
    from gigabrain_zenoh.diagnostics.discovery import process_table

    processes = _find(at)
    if not json:
        print_table(process_table(processes))
        return
    for name in processes.names():
        row = {
            "process": name,
            "description": processes.described.get(name),
            "health": processes.health.get(name),
        }
        print_json(row)


def info(process: Process, /, *, at: RobotAddress = LOCAL) -> None:
    """Describe one process: what it sends and receives, latencies and counters.

    Example: gigabrain node info driver
    """
    from gigabrain_zenoh.diagnostics.discovery import describe

    check_name("PROCESS", process)
    for line in describe(_find(at), process):
        print_line(line)


def graph(
    *,
    at: RobotAddress = LOCAL,
    dot: bool = False,
    mermaid: bool = False,
    png: Path | None = None,
    everything: Annotated[bool, Parameter(name="--all")] = False,
) -> None:
    """Draw which process sends what to which, and how often, as measured on the bus.

    Example: gigabrain graph --png robot.png

    Args:
        dot: Print a Graphviz file.
        mermaid: Print a Mermaid flowchart.
        png: Draw a picture to this PNG file.
        everything: Also show health, log and audit, which every process sends.
    """
    from gigabrain_zenoh.diagnostics import discovery
    from gigabrain_zenoh.diagnostics.why import START_ROUTER

    if dot + mermaid + (png is not None) > 1:
        raise ConfigError("choose only one of --dot, --mermaid and --png")
    check_picture_path(png)
    processes = _find(at)
    flows = discovery.flows(processes.described.values(), processes.health)
    shown = discovery.chain_flows(flows, everything=everything)
    if not processes.described.keys() - {"router"}:
        raise BodyLost(f"no process sends to another here; {START_ROUTER}")
    if not shown:
        print_progress("no process sends to another yet")
    if png:
        discovery.write_graph_png(shown, png)
        print_line(str(png))
        return
    as_lines = discovery.graph_as_text
    if dot or mermaid:
        as_lines = discovery.graph_as_dot if dot else discovery.graph_as_mermaid
    for line in as_lines(shown):
        print_line(line)


def _find(at: RobotAddress) -> "Processes":
    from gigabrain_zenoh.diagnostics.discovery import find_processes

    return on_bus(at, find_processes)


def top(*, at: RobotAddress = LOCAL, once: bool = False) -> None:
    """Watch processes and topics: load, rates, sizes and latencies.

    Example: gigabrain top

    TAB: other table. < and >: sort by another column. r: reverse the order.
    Space: pause. q: quit.

    Args:
        once: Print both tables once, and exit.
    """
    from gigabrain_zenoh.diagnostics.listener import widest_pattern
    from gigabrain_zenoh.diagnostics.top import BusFeed
    from gigabrain_zenoh.diagnostics.topic_stats import monitored

    async def show(bus: "Bus") -> None:
        with monitored(bus, widest_pattern(at.where())) as monitor:
            feed = BusFeed(bus, monitor)
            await (_print_once(feed) if once else _watch(feed))

    on_bus(at, show)


async def _watch(feed: "Feed") -> None:
    try:
        from gigabrain_zenoh.diagnostics.top_app import watch
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL_TOP}") from None
    await watch(feed)


async def _print_once(feed: "Feed") -> None:
    from gigabrain_zenoh.diagnostics.discovery import plain_table
    from gigabrain_zenoh.diagnostics.top import (
        PROCESS_COLUMNS,
        TOPIC_COLUMNS,
        cell_text,
        sorted_rows,
    )

    await asyncio.sleep(1.3)
    for columns, rows in zip((PROCESS_COLUMNS, TOPIC_COLUMNS), feed.refresh(), strict=True):
        texts = [[cell_text(cell) for cell in row] for _, row in sorted_rows(rows, 0, down=False)]
        print_table(plain_table(columns, texts, left=columns[:1]))


def list_params(process: ProcessOrAll = "", /, *, at: RobotAddress = LOCAL) -> int:
    """List the parameters that can be changed at run time: value, and what is accepted.

    Example: gigabrain param list decision

    Exit code 1 if a process refuses; the others are listed.
    """
    refusals = 0
    for name, reply in sorted(_param_answers(at, process, "", "").items()):
        if isinstance(reply, Refused):
            refusals += 1
            print_progress(str(reply))
            continue
        for one in reply.params:
            print_line(f"{name:<12} {one.name:<24} {one.value:<10} {one.expected}")
    return int(refusals > 0)


def get_param(process: Process, name: str, /, *, at: RobotAddress = LOCAL) -> None:
    """Print one parameter.

    Example: gigabrain param get decision max_linear_speed

    Args:
        name: Name of the parameter.
    """
    check_name("PROCESS", process)
    check_name("NAME", name)
    reply = ask_params(at, process)[process]
    params = {one.name: one for one in reply.params}
    if name not in params:
        raise unknown("parameter", name, params)
    print_line(params[name].value)


def set_param(
    process: Process,
    name: str,
    value: str,
    /,
    *,
    save: Path | None = None,
    at: RobotAddress = LOCAL,
) -> None:
    """Change one parameter, until the process ends.

    Example: gigabrain param set decision max_linear_speed 0.15

    Args:
        name: Name of the parameter.
        value: New value.
        save: File to save it in, with all other changed parameters; see `param save`.
    """
    from gigabrain_schemas.requests import ParamRequest
    from gigabrain_zenoh.cli.config import with_values

    check_name("PROCESS", process)
    check_name("NAME", name)
    checked({"value": value}, ParamRequest, positional=("value",))
    check_result_path(save)
    if save:
        with_values(save, {})  # raises if the file is not a settings file
    reply = ask_params(at, process, name, value)[process]
    if not reply.ok:
        raise Refused(f"{process}: {reply.text}")
    print_line(f"{process}: {reply.text}")
    if save:
        save_params(save, at=at)


def save_params(file: Path, /, *, at: RobotAddress = LOCAL) -> None:
    """Save the parameters that were changed, for `up --settings` and `demo --settings`.

    Example: gigabrain param save slow.yaml

    Args:
        file: File to write. Its other values are kept; a file with comments is refused.
    """
    from gigabrain_zenoh.cli.config import with_values

    check_result_path(file)
    with_values(file, {})  # raises if the file is not a settings file
    params = [one for reply in ask_params(at).values() for one in reply.params if one.key]
    changed = {one.key: one.value for one in params if one.value != one.initial}
    if not changed:
        raise Refused("no parameter of this robot was changed, so there is nothing to save")
    try:
        replace_file(file, with_values(file, changed).encode())
    except OSError as error:
        raise cannot_write(file, error) from None
    print_line(f"saved {', '.join(sorted(changed))} in {file}")


def ask_params(
    at: RobotAddress, process: str = "", name: str = "", value: str = ""
) -> "dict[str, ParamReply]":
    """Return the replies of one process, or of all without a name. Raises the first Refused."""
    replies = {}
    for each, reply in _param_answers(at, process, name, value).items():
        if isinstance(reply, Refused):
            raise reply
        replies[each] = reply
    return replies


def _param_answers(
    at: RobotAddress, process: str, name: str, value: str
) -> "dict[str, ParamReply | Refused]":
    """Return the reply or the refusal of each process, by name."""
    from gigabrain_schemas.requests import ParamRequest
    from gigabrain_schemas.topics import PARAM
    from gigabrain_zenoh.diagnostics.discovery import discover
    from gigabrain_zenoh.host.this_process import user_name

    request = ParamRequest(name=name, value=value, source=user_name())

    async def ask_one(bus: "Bus", each: str) -> "list[ParamReply] | list[Refused]":
        try:
            return await bus.ask(PARAM, request, name=each)
        except Refused as error:
            return [Refused(f"{each}: {error}")]

    async def ask(bus: "Bus") -> "dict[str, ParamReply | Refused]":
        known = await discover(bus)
        if process and process not in known:
            raise unknown("process", process, known)
        asked = [process] if process else list(known)
        answers = await asyncio.gather(*(ask_one(bus, each) for each in asked))
        return {each: found[0] for each, found in zip(asked, answers, strict=True) if found}

    replies = on_bus(at, ask)
    if not replies:
        silent = process or "any process"
        raise BodyLost(f"no answer from {silent}; check that it runs, and that your keys permit it")
    return replies
