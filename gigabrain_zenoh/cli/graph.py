"""`gigabrain graph`: who talks to whom."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from gigabrain_zenoh.cli.where import HERE, Which, say
from gigabrain_zenoh.host.signals import run_async


def graph(
    *,
    at: Which = HERE,
    dot: bool = False,
    mermaid: bool = False,
    png: Path | None = None,
    everything: Annotated[bool, Parameter(name="--all")] = False,
) -> int:
    """Draw which process sends what to which, and how often, from what really goes over the bus.

    Example: gigabrain graph --png robot.png

    Parameters
    ----------
    dot
        For Graphviz.
    mermaid
        For Mermaid.
    png
        A picture into this file.
    everything
        Also health, log and audit, which everybody sends.
    """

    from gigabrain_zenoh.diagnostics import graph as draw
    from gigabrain_zenoh.diagnostics.hearing import NAME
    from gigabrain_zenoh.diagnostics.nodes import Nodes, census
    from gigabrain_zenoh.diagnostics.roll_call import flows
    from gigabrain_zenoh.errors import ConfigError
    from gigabrain_zenoh.runtime.connect import joined

    if dot + mermaid + (png is not None) > 1:
        raise ConfigError("choose one of --dot, --mermaid and --png")

    async def look() -> Nodes:
        async with joined(at.where(), NAME) as (bus, _):
            return await census(bus)

    nodes = run_async(look())
    found = draw.chain(flows(nodes.there.values(), nodes.health), everything=everything)
    if png:
        draw.write_png(found, png)
        say(str(png))
        return 0
    as_lines = draw.as_dot if dot else draw.as_mermaid if mermaid else draw.as_text
    for line in as_lines(found):
        say(line)
    return 0
