"""Draws the graph of processes and messages: as text, for Graphviz or Mermaid, or as a PNG."""

import math
import re
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

from gigabrain_zenoh.diagnostics.discovery import Flow, short_name
from gigabrain_zenoh.errors import ConfigError

INSTALL = "for pictures install: pip install 'gigabrain-zenoh[record]'"
INK, PLAIN = "#1e293b", {"facecolor": "white", "edgecolor": "none", "pad": 1}
BOX = {"facecolor": "#e0f2fe", "edgecolor": "#0369a1"}
ORDER = ("driver", "perception", "decision", "control", "safety")  # along the chain
COMMON = ("health", "log", "audit")  # every process sends these: too much for a picture


def chain(flows: Iterable[Flow], *, everything: bool = False) -> list[Flow]:
    """Return the flows that make the robot move, or all flows with `everything`."""
    return [f for f in flows if everything or short_name(f.key).split("/")[0] not in COMMON]


def as_text(flows: Iterable[Flow]) -> Iterator[str]:
    """Yield each process, with its keys, their rates and their receivers."""
    for sender, of in groupby(sorted(flows), key=lambda flow: flow.sender):
        yield sender
        for key, same in groupby(of, key=lambda flow: flow.key):
            group = list(same)
            to = ", ".join(flow.receiver for flow in group)
            yield f"  {short_name(key):<12} {group[0].hz:>5.1f} Hz  -> {to}"


def as_dot(flows: Iterable[Flow]) -> Iterator[str]:
    """Yield the lines of a Graphviz file."""
    yield "digraph robot {"
    yield "  rankdir=LR; node [shape=box, style=rounded]; edge [fontsize=10];"
    for flow in sorted(flows):
        label = f"{short_name(flow.key)} {flow.hz:g} Hz"
        yield f'  "{flow.sender}" -> "{flow.receiver}" [label="{label}"];'
    yield "}"


def as_mermaid(flows: Iterable[Flow]) -> Iterator[str]:
    """Yield the lines of a Mermaid flowchart."""
    yield "flowchart LR"
    for flow in sorted(flows):
        sender, receiver = (re.sub(r"\W", "_", name) for name in (flow.sender, flow.receiver))
        label = f"{short_name(flow.key)} {flow.hz:g} Hz"
        yield f'  {sender}["{flow.sender}"] -->|"{label}"| {receiver}["{flow.receiver}"]'


def write_png(flows: Iterable[Flow], path: Path) -> None:
    """Draw processes on a circle, with arrows between them. Raises ConfigError."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.patches import FancyArrowPatch
    except ModuleNotFoundError as error:
        raise ConfigError(f"{error}; {INSTALL}") from None
    pairs = {
        pair: [f"{short_name(flow.key)} {flow.hz:.0f} Hz" for flow in group]
        for pair, group in groupby(
            sorted(flows, key=lambda f: (f.sender, f.receiver, f.key)),
            key=lambda f: (f.sender, f.receiver),
        )
    }
    places = positions({name for pair in pairs for name in pair})
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
        bow = 0.15  # to the side to which the arrow bends
        x = (a[0] + b[0]) / 2 + (b[1] - a[1]) * bow / 2
        y = (a[1] + b[1]) / 2 - (b[0] - a[0]) * bow / 2
        _text(axes, (x, y), "\n".join(labels), 8, PLAIN)
    for name, place in places.items():
        _text(axes, place, name, 12, {"boxstyle": "round,pad=0.7", **BOX})
    try:
        figure.savefig(path, dpi=120, format="png")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None


def _text(axes: Any, place: tuple[float, float], text: str, size: int, box: dict[str, Any]) -> None:
    axes.text(*place, text, fontsize=size, ha="center", va="center", color=INK, bbox=box)


def positions(names: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Return places on a circle, clockwise from the left, in the order of the chain."""
    order = {name: i for i, name in enumerate(ORDER)}
    found = sorted(names, key=lambda name: (order.get(name, len(order)), name))
    places = {}
    for i, name in enumerate(found):
        angle = math.pi - i * math.tau / len(found)
        places[name] = (1.15 * math.cos(angle), 0.95 * math.sin(angle))
    return places
