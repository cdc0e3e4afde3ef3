"""Finds the topics and the processes of a robot, and draws the flows of messages between them."""

import asyncio
import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

from msgspec import Struct, field
from rich.table import Table
from rich.text import Text

from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import DESCRIBE, TOPICS, Topic, current_key
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.key_expressions import check_key_expression, matches
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.diagnostics.robot_view import ProcessHealth
from gigabrain_zenoh.errors import BodyLost, ConfigError, UnknownName, unknown
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.files import cannot_write

PREFIX = "robot/"
COMMAND_OF_SERVICE = {  # services that users mistake for topics, and their commands
    "estop": "estop", "release": "release", "enable": "enable", "limp": "arm limp",
    "goal": "goto X Y",
    "mission": "mission FILE", "task_change": "task", "map_save": "map save",
    "param": "param", "audit_log": "audit", "describe": "node info", "sim_change": "world",
    "map_list": "map list", "map_load": "map load NAME", "zones_change": "zone",
    "pose_set": "pose X Y", "objects_change": "objects --forget ID",
}  # fmt: skip
INSTALL_MATPLOTLIB = "for pictures install: pip install 'gigabrain-zenoh[record]'"
INK, PLAIN = "#1e293b", {"facecolor": "white", "edgecolor": "none", "pad": 1}
BOX = {"facecolor": "#e0f2fe", "edgecolor": "#0369a1"}
ORDER = ("driver", "perception", "decision", "control", "safety")  # of the chain
COMMON = ("health", "log", "audit")  # every process sends these: too many for a picture
TEXT_COLUMNS = {"process", "host", "latency", "topic", "message", "from", "to"}
DESCRIBE_TIMEOUT_S = 1.2
HEALTH_WINDOW_S = 1.3  # health is published once a second


class TopicPattern(Struct, frozen=True):
    """A key expression to subscribe to, and its topic in the table.

    Raises ConfigError for a pattern that is not a key expression.
    """

    pattern: str
    topic: Topic | None  # type: ignore[type-arg]  # None for keys of other projects

    def __post_init__(self) -> None:
        check_key_expression(self.pattern)


def short_name(key: str) -> str:
    """Return a key in its short form, without `robot/`."""
    return key.removeprefix(PREFIX)


def topic_pattern(name: str, live_keys: Iterable[str] = ()) -> TopicPattern | None:
    """Return the pattern for a name; None for an unknown one.

    The name may be `scan`, `robot/scan`, `health/driver`, a live key, or a key expression. Raises
    ConfigError for an invalid key expression.
    """
    key = current_key(PREFIX + short_name(name))
    for topic in TOPICS:
        if key == topic.key:
            return TopicPattern(topic.at("*"), topic)
        if topic.many and matches(topic.at("*"), key):
            return TopicPattern(key, topic)
    if name in live_keys or "*" in name:
        return TopicPattern(name, topic_of(name))
    return TopicPattern(key, topic_of(key)) if key in live_keys else None


def check_topic(name: str) -> None:
    """Raise UnknownName for a name that no topic of any robot can have, as that of a service."""
    possible = short_name(name) not in COMMAND_OF_SERVICE
    try:
        check_key_expression(PREFIX + short_name(name))
    except ConfigError:
        possible = False
    if not possible:
        raise unknown_topic(name, ())


def unknown_topic(name: str, live_keys: Iterable[str]) -> UnknownName:
    """Return the error for an unknown topic; it suggests the nearest topic, or a command."""
    if command := COMMAND_OF_SERVICE.get(short_name(name)):
        return UnknownName(f"{name} is a service, not a topic; use: gigabrain {command}")
    known = {*(short_name(topic.key) for topic in TOPICS), *map(short_name, live_keys)}
    return unknown("topic", short_name(name), known)


class Flow(Struct, frozen=True, order=True):
    """A key that one process sends to another."""

    sender: str
    key: str
    receiver: str
    hz: float = field(default=0.0)  # in the sender's newest health


class Processes(Struct, frozen=True):
    """All processes of a robot, by name."""

    described: Mapping[str, Description]
    health: Mapping[str, Health]  # newest

    def names(self) -> list[str]:
        """Return all names, sorted."""
        return sorted({*self.described, *self.health})


async def discover(bus: Bus, timeout_s: float = DESCRIBE_TIMEOUT_S) -> dict[str, Description]:
    """Return the description of each process that answers, by name."""
    replies = await bus.ask(
        DESCRIBE, DescribeRequest(), timeout_s=timeout_s, name="*", skip_refusals=True
    )
    return {reply.process: reply for reply in sorted(replies, key=lambda reply: reply.process)}


async def find_processes(bus: Bus, seconds: float = HEALTH_WINDOW_S) -> Processes:
    """Return all processes with their health. Raises BodyLost if there are none."""
    health = ProcessHealth(bus)
    described, _ = await asyncio.gather(discover(bus), asyncio.sleep(seconds))
    health.close()
    if not described and not health.newest:
        raise BodyLost("the router answers, but no process of a robot does; start the robot")
    return Processes(described, health.newest)


def senders(key: str, processes: Iterable[Description]) -> list[str]:
    """Return the processes that sent on `key`."""
    return [each.process for each in processes if any(matches(key, k) for k in each.publishes)]


def receivers(key: str, processes: Iterable[Description]) -> list[str]:
    """Return the processes that subscribe to `key`."""
    return [
        each.process
        for each in processes
        if any(matches(wanted, key) or matches(key, wanted) for wanted in each.subscribes)
    ]


def flows(processes: Iterable[Description], health: Mapping[str, Health]) -> list[Flow]:
    """Return every flow of messages, from senders to receivers.

    A key whose sender reports 0 Hz is not a flow, unless its last value is kept.
    """
    processes, found = tuple(processes), set()
    for sender in processes:
        rates = health[sender.process].sent_hz if sender.process in health else None
        for key in sender.publishes:
            hz = rates.get(key, 0.0) if rates is not None else 0.0
            topic = topic_of(key)
            if rates is not None and not hz and not (topic and topic.keep):
                continue
            for name in receivers(key, processes):
                if name != sender.process:
                    found.add(Flow(sender.process, key, name, hz))
    return sorted(found)


def chain_flows(flows: Iterable[Flow], *, everything: bool = False) -> list[Flow]:
    """Return the flows that make the robot move, or all flows with `everything`."""
    return [f for f in flows if everything or short_name(f.key).split("/")[0] not in COMMON]


def graph_as_text(flows: Iterable[Flow]) -> Iterator[str]:
    """Yield the lines for each process, with its keys, their rates and their receivers."""
    for sender, sent in groupby(sorted(flows), key=lambda flow: flow.sender):
        yield sender
        for key, same_key in groupby(sent, key=lambda flow: flow.key):
            group = list(same_key)
            to = ", ".join(flow.receiver for flow in group)
            yield f"  {short_name(key):<12} {group[0].hz:>5.1f} Hz  -> {to}"


def graph_as_dot(flows: Iterable[Flow]) -> Iterator[str]:
    """Yield the lines of a Graphviz file."""
    yield "digraph robot {"
    yield "  rankdir=LR; node [shape=box, style=rounded]; edge [fontsize=10];"
    for flow in sorted(flows):
        label = f"{short_name(flow.key)} {flow.hz:g} Hz"
        yield f'  "{flow.sender}" -> "{flow.receiver}" [label="{label}"];'
    yield "}"


def graph_as_mermaid(flows: Iterable[Flow]) -> Iterator[str]:
    """Yield the lines of a Mermaid flowchart."""
    yield "flowchart LR"
    for flow in sorted(flows):
        sender, receiver = (re.sub(r"\W", "_", name) for name in (flow.sender, flow.receiver))
        label = f"{short_name(flow.key)} {flow.hz:g} Hz"
        yield f'  {sender}["{flow.sender}"] -->|"{label}"| {receiver}["{flow.receiver}"]'


def write_graph_png(flows: Iterable[Flow], path: Path) -> None:
    """Draw processes on a circle, with arrows between them. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.patches import FancyArrowPatch
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL_MATPLOTLIB}") from None
    pairs = {
        pair: [f"{short_name(flow.key)} {flow.hz:.0f} Hz" for flow in group]
        for pair, group in groupby(
            sorted(flows, key=lambda f: (f.sender, f.receiver, f.key)),
            key=lambda f: (f.sender, f.receiver),
        )
    }
    places = graph_positions({name for pair in pairs for name in pair})
    figure = Figure(figsize=(10, 8))
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(-1.5, 1.5), ylim=(-1.25, 1.25))
    axes.set_axis_off()
    for (sender, receiver), labels in pairs.items():
        a, b = places[sender], places[receiver]
        axes.add_patch(
            FancyArrowPatch(
                a, b, connectionstyle="arc3,rad=0.15", arrowstyle="-|>", mutation_scale=16,
                shrinkA=42, shrinkB=42, color="#64748b",
            )
        )  # fmt: skip
        bend = 0.15  # moves the label to the outer side of the bent arrow
        x = (a[0] + b[0]) / 2 + (b[1] - a[1]) * bend / 2
        y = (a[1] + b[1]) / 2 - (b[0] - a[0]) * bend / 2
        _text(axes, (x, y), "\n".join(labels), 8, PLAIN)
    for name, place in places.items():
        _text(axes, place, name, 12, {"boxstyle": "round,pad=0.7", **BOX})
    try:
        figure.savefig(path, dpi=120, format="png")
    except OSError as error:
        raise cannot_write(path, error) from None


def _text(axes: Any, place: tuple[float, float], text: str, size: int, box: dict[str, Any]) -> None:
    axes.text(*place, text, fontsize=size, ha="center", va="center", color=INK, bbox=box)


def graph_positions(names: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Return positions on an ellipse, clockwise from the left, in the order of the chain."""
    order = {name: i for i, name in enumerate(ORDER)}
    found = sorted(names, key=lambda name: (order.get(name, len(order)), name))
    places = {}
    for i, name in enumerate(found):
        angle = math.pi - i * math.tau / len(found)
        places[name] = (1.15 * math.cos(angle), 0.95 * math.sin(angle))
    return places


def plain_table(
    columns: Sequence[str],
    rows: Iterable[Sequence[str | Text]],
    *,
    left: Collection[str],
    wraps: Collection[str] = (),
) -> Table:
    """Return a table without lines; columns named in `left` are texts, others are numbers.

    Cells are shown without markup, as a process may have any name.
    """
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in columns:
        justify: Literal["left", "right"] = "left" if name in left else "right"
        table.add_column(name, justify=justify, no_wrap=name not in wraps)
    for row in rows:
        table.add_row(*(plain(cell) if isinstance(cell, str) else cell for cell in row))
    return table


def plain(cell: str) -> Text:
    """Return a cell without markup, and with control characters escaped."""
    return Text(printable(cell))


def process_table(processes: Processes) -> Table:
    """Return a table with one row per process."""
    columns = ("process", "pid", "host", "up", "CPU", "memory", "rejected", "latency")
    rows = (_row(name, processes) for name in processes.names())
    return plain_table(columns, rows, left=TEXT_COLUMNS, wraps=columns)


def _row(name: str, processes: Processes) -> tuple[str, ...]:
    description, health = processes.described.get(name), processes.health.get(name)
    place = description or health
    assert place
    if health is None:
        return (name, str(place.pid), place.host, "-", "-", "-", "-", "reports no health")
    return (
        name,
        str(place.pid),
        place.host,
        f"{health.uptime_s:.0f} s",
        f"{health.cpu:.1%}",
        f"{health.rss_bytes / 1e6:.0f} MB",
        str(sum(health.rejected.values())),
        "  ".join(f"{what} {value:.1f} ms" for what, value in health.latency_ms.items()),
    )


def describe(processes: Processes, name: str) -> Iterator[str]:
    """Yield lines that describe one process. Raises UnknownName."""
    description, health = processes.described.get(name), processes.health.get(name)
    if description is None and health is None:
        raise unknown("process", name, processes.names())
    if description is None:
        yield f"{name}: reports its health, but does not answer"
    else:
        yield f"{name}: version {description.version}, pid {description.pid} on {description.host}"
    if health:
        memory = f"{health.rss_bytes / 1e6:.0f} MB"
        yield f"  up {health.uptime_s:.0f} s, {health.cpu:.1%} of a core, {memory}"
    yield from _rates(
        "sends", description.publishes if description else (), health.sent_hz if health else {}
    )
    received_hz = health.received_hz if health else {}
    yield from _rates("receives", description.subscribes if description else (), received_hz)
    if health:
        yield from (f"  problem: {cause.text} ({cause.remedy})" for cause in health.problems)
        yield from _values("rejected", health.rejected)
        yield from _values("latency [ms]", health.latency_ms)
        yield from _values("counters", health.counters)
    if description:
        yield from _values("report", description.report)


def _rates(title: str, keys: tuple[str, ...], hz: Mapping[str, float]) -> Iterator[str]:
    yield f"  {title}:"
    for key in sorted({*keys, *hz}):
        yield f"    {short_name(key):<20} {hz.get(key, 0.0):>6.1f} Hz"


def _values(title: str, values: Mapping[str, object]) -> Iterator[str]:
    if values:
        yield f"  {title}:"
    for name, value in values.items():
        shown = f"{value:.6g}" if isinstance(value, float) else "-" if value is None else value
        yield f"    {name:<28} {shown}"
