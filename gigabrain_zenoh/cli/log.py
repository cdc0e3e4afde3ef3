"""`gigabrain log`: what the processes have logged."""

import asyncio
import time
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh import logs
from gigabrain_zenoh.cli.live_names import processes
from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from collections.abc import Callable

    from gigabrain_schemas.safety import LogRecord
    from gigabrain_zenoh.diagnostics.log_reading import Line, Wanted


def log(
    run: str = "",
    /,
    *,
    at: Which = HERE,
    process: Annotated[str, Parameter(completer=processes)] = "",
    level: str = "debug",
    since: str = "",
    newest: Annotated[int, Parameter(alias="-n")] = 100,
    follow: bool = False,
    json: bool = False,
) -> int:
    """Show what the processes of a run have logged on this machine, in the order of time.

    Example: gigabrain log --process driver --level warning --since 10m

    With --follow it goes on with what the robot says from now on, whichever host that comes from,
    until Ctrl-C.

    Parameters
    ----------
    run
        Its folder, or part of its name; without it, the newest one.
    process
        Of this process only.
    level
        This one and above: debug, info, warning, error, critical.
    since
        Not older than this: 90s, 10m, 2h, 1d.
    newest
        How many lines of what is past.
    follow
        Go on with what is said from now on: level info and above.
    json
        One JSON object per line.
    """
    from gigabrain_zenoh.diagnostics.log_reading import read, run_folder

    if not 0 < newest <= 1_000_000:
        raise ConfigError(f"--newest: expected 1 to 1000000, got {newest}")
    if at.connect and not follow:
        raise ConfigError("what a robot elsewhere has logged lies there; add --follow to listen")
    wanted, tell = _wanted(process, level, since), _tell_json if json else _tell
    if not at.connect:
        for line in read(run_folder(run), wanted, newest):
            tell(line)
    if follow:
        run_async(_follow(at, wanted, tell))
    return 0


def _wanted(process: str, level: str, since: str) -> "Wanted":
    """Raises ConfigError, and UnknownName."""
    from gigabrain_zenoh.diagnostics.log_reading import Wanted, ago_ns

    since_ns = ago_ns(since, time.time_ns()) if since else 0
    return Wanted(process=process, level=level, since_ns=since_ns)


def _tell(line: "Line") -> None:
    say(logs.readable(line))


def _tell_json(line: "Line") -> None:
    say(logs.encode(line).decode())


async def _follow(at: Which, wanted: "Wanted", tell: "Callable[[Line], None]") -> None:
    from gigabrain_schemas.topics import LOG
    from gigabrain_zenoh.diagnostics.hearing import NAME
    from gigabrain_zenoh.diagnostics.log_reading import as_line
    from gigabrain_zenoh.diagnostics.reader import ended_with_reader
    from gigabrain_zenoh.host.signals import stop_signals
    from gigabrain_zenoh.runtime.connect import joined

    async with joined(at.where(), NAME) as (bus, _):

        def hear(_key: str, record: "LogRecord") -> None:
            line = as_line(record)
            if wanted.has(line):
                tell(line)

        bus.subscribe(LOG, hear)
        with stop_signals() as stop, ended_with_reader(stop):
            stopped = asyncio.ensure_future(stop.wait())
            await asyncio.wait((stopped, bus.failed), return_when=asyncio.FIRST_COMPLETED)
            stopped.cancel()
        if bus.failed.done():
            bus.failed.result()  # nobody reads on
