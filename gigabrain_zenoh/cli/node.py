"""`gigabrain node`: the processes of a robot."""

from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.live_names import processes
from gigabrain_zenoh.cli.where import HERE, Which, say, show
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_zenoh.diagnostics.nodes import Nodes


def list_(*, at: Which = HERE, json: bool = False) -> int:
    """List the processes that run: where, since when, and what they take.

    Example: gigabrain node list

    Parameters
    ----------
    json
        One JSON object per line.
    """
    import msgspec

    from gigabrain_zenoh.diagnostics.nodes import table

    nodes = _census(at)
    if not json:
        show(table(nodes))
        return 0
    for name in sorted({*nodes.there, *nodes.health}):
        told = {"process": name, "description": nodes.there.get(name)}
        say(msgspec.json.encode({**told, "health": nodes.health.get(name)}).decode())
    return 0


def info(process: Annotated[str, Parameter(completer=processes)], /, *, at: Which = HERE) -> int:
    """Show all about one process: what it sends and hears, its figures and counts.

    Example: gigabrain node info driver

    Parameters
    ----------
    process
        Its name.
    """
    from gigabrain_zenoh.diagnostics.nodes import about

    for line in about(_census(at), process):
        say(line)
    return 0


def _census(at: Which) -> "Nodes":
    from gigabrain_zenoh.diagnostics.hearing import NAME
    from gigabrain_zenoh.diagnostics.nodes import census
    from gigabrain_zenoh.runtime.connect import joined

    async def look() -> "Nodes":
        async with joined(at.where(), NAME) as (bus, _):
            return await census(bus)

    return run_async(look())
