"""The processes of a robot: what each is, how it is doing, and what it sends and hears."""

import asyncio
from collections.abc import Iterator, Mapping

from msgspec import Struct
from rich.table import Table

from gigabrain_schemas.requests import Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.names import short
from gigabrain_zenoh.diagnostics.roll_call import roll_call
from gigabrain_zenoh.errors import BodyLost, unknown

LOOK_S = 1.3  # health comes once a second


class Nodes(Struct, frozen=True):
    """One look at all of them."""

    there: Mapping[str, Description]
    health: Mapping[str, Health]  # newest, by process


async def census(bus: Bus, seconds: float = LOOK_S) -> Nodes:
    """Who answers, and how all are doing. Raises BodyLost where there is nobody."""
    health: dict[str, Health] = {}
    close = bus.subscribe(HEALTH, lambda _key, told: health.update({told.process: told}))
    there, _ = await asyncio.gather(roll_call(bus), asyncio.sleep(seconds))
    close()
    if not there and not health:
        raise BodyLost("the router answers, but no process of a robot does")
    return Nodes(there, health)


def table(nodes: Nodes) -> Table:
    """A line per process."""
    made = Table(box=None, pad_edge=False, header_style="dim")
    for name, justify in (("process", "left"), ("pid", "right"), ("host", "left"),
                          ("up", "right"), ("CPU", "right"), ("memory", "right"),
                          ("rejected", "right"), ("latency", "left")):  # fmt: skip
        made.add_column(name, justify=justify)  # type: ignore[arg-type]
    for name in sorted({*nodes.there, *nodes.health}):
        made.add_row(*row(name, nodes))
    return made


def row(name: str, nodes: Nodes) -> tuple[str, ...]:
    """One process in words."""
    one, health = nodes.there.get(name), nodes.health.get(name)
    about = one or health
    assert about
    if health is None:
        return (name, str(about.pid), about.host, "-", "-", "-", "-", "reports no health")
    return (
        name,
        str(about.pid),
        about.host,
        f"{health.uptime_s:.0f} s",
        f"{health.cpu:.1%}",
        f"{health.rss_bytes / 1e6:.0f} MB",
        str(sum(health.rejected.values())),
        "  ".join(f"{what} {value:.1f} ms" for what, value in health.latency_ms.items()),
    )


def about(nodes: Nodes, name: str) -> Iterator[str]:
    """All that is known of one. Raises UnknownName."""
    one, health = nodes.there.get(name), nodes.health.get(name)
    if one is None and health is None:
        raise unknown("process", name, {*nodes.there, *nodes.health})
    if one is None:
        yield f"{name}: reports its health, but does not answer"
    else:
        yield f"{name}: version {one.version}, pid {one.pid} on {one.host}"
    if health:
        yield f"  up {health.uptime_s:.0f} s, {health.cpu:.1%} of a core, " + (
            f"{health.rss_bytes / 1e6:.0f} MB"
        )
    yield from _rates("sends", one.publishes if one else (), health.sent_hz if health else {})
    yield from _rates("hears", one.subscribes if one else (), health.received_hz if health else {})
    if health:
        yield from (f"  problem: {one.text} ({one.remedy})" for one in health.problems)
        yield from _figures("rejected", health.rejected)
        yield from _figures("latency [ms]", health.latency_ms)
        yield from _figures("counters", health.counters)
    if one:
        yield from _figures("report", one.report)


def _rates(title: str, keys: tuple[str, ...], hz: Mapping[str, float]) -> Iterator[str]:
    yield f"  {title}:"
    for key in sorted({*keys, *hz}):
        yield f"    {short(key):<20} {hz.get(key, 0.0):>6.1f} Hz"


def _figures(title: str, values: Mapping[str, object]) -> Iterator[str]:
    if values:
        yield f"  {title}:"
    for name, value in values.items():
        shown = f"{value:.6g}" if isinstance(value, float) else "-" if value is None else value
        yield f"    {name:<28} {shown}"
