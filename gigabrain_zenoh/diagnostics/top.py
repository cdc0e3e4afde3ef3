"""Rows of `gigabrain top`: processes and topics, each with a sparkline of its newest values."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from gigabrain_schemas.safety import Health
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.diagnostics.discovery import short_name
from gigabrain_zenoh.diagnostics.robot_view import ProcessHealth
from gigabrain_zenoh.diagnostics.topic_stats import StreamStats, TopicMonitor
from gigabrain_zenoh.host.escaping import printable

BARS = "▁▂▃▄▅▆▇█"
MAX_BARS = 20
SILENT_AFTER_S = 3.0  # without a health report
Cell = str | float
Rows = dict[str, tuple[Cell, ...]]


# "latency ms" is the largest that a process measures; "delay ms" is the median since the stamps;
# "jitter ms" is the standard deviation of the gaps; "latency" and "delay" are sparklines
PROCESS_COLUMNS = ("process", "state", "CPU %", "MB", "sends Hz", "receives Hz", "rejected",
                   "latency ms", "latency", "up s")  # fmt: skip
TOPIC_COLUMNS = ("topic", "Hz", "promised", "kB/s", "bytes", "delay ms", "delay", "jitter ms",
                 "age s", "missing")  # fmt: skip


def process_cells(health: Health, age_s: float, latencies: str = "") -> tuple[Cell, ...]:
    """Return the row of a process whose newest health is `age_s` old."""
    return (
        health.process,
        "ok" if age_s < SILENT_AFTER_S else "silent",
        health.cpu * 100,
        health.rss_bytes / 1e6,
        sum(health.sent_hz.values()),
        sum(health.received_hz.values()),
        sum(health.rejected.values()),
        max(health.latency_ms.values(), default=""),
        latencies,
        health.uptime_s,
    )


def topic_cells(
    key: str, stats: StreamStats | None, age_s: float, missing: int, delays: str = ""
) -> tuple[Cell, ...]:
    """Return the row of a key; `stats` is None if nothing arrived."""
    topic = topic_of(key)
    promised_hz: Cell = topic.hz if topic else ""
    if stats is None:
        return (short_name(key), 0.0, promised_hz, 0.0, 0, "", delays, "", age_s, missing)
    return (
        short_name(key),
        stats.hz,
        promised_hz,
        stats.bytes_s / 1e3,
        stats.size,
        "" if stats.delay_median_ms is None else stats.delay_median_ms,
        delays,
        "" if stats.gap_std_ms is None else stats.gap_std_ms,
        age_s,
        missing,
    )


def cell_text(cell: Cell) -> str:
    """Return a cell as text."""
    if isinstance(cell, str):
        return printable(cell)
    return str(cell) if isinstance(cell, int) else f"{cell:.1f}"


def sorted_rows(
    rows: Mapping[str, tuple[Cell, ...]], column: int, *, down: bool
) -> list[tuple[str, tuple[Cell, ...]]]:
    """Return rows sorted by one column; empty cells come last in both directions."""
    empty = [item for item in rows.items() if item[1][column] == ""]
    filled = [item for item in rows.items() if item[1][column] != ""]
    filled.sort(key=lambda item: (isinstance(item[1][column], str), item[1][column]), reverse=down)
    return filled + empty


class History:
    """Newest values by name, for sparklines."""

    def __init__(self) -> None:
        self._values: dict[str, deque[float]] = {}

    def add(self, name: str, value: float | None) -> None:
        """Add a value; None adds nothing."""
        if value is not None:
            self._values.setdefault(name, deque(maxlen=MAX_BARS)).append(value)

    def line(self, name: str) -> str:
        """Return the sparkline of a name."""
        return sparkline(tuple(self._values.get(name, ())))


def sparkline(values: Sequence[float]) -> str:
    """Return bars, from zero to the largest value."""
    largest = max(values, default=0.0)
    if largest <= 0:
        return BARS[0] * len(values)
    return "".join(BARS[min(7, int(max(value, 0.0) / largest * 8))] for value in values)


class Feed(Protocol):
    """Source of both tables."""

    def refresh(self) -> tuple[Rows, Rows]:
        """Return the rows of processes and topics since the last call."""
        ...


class BusFeed:
    """Feed from a running robot."""

    def __init__(self, bus: Bus, monitor: TopicMonitor) -> None:
        self._bus, self._monitor = bus, monitor
        self._since_ns = bus.clock.now_ns()
        self._latencies, self._delays = History(), History()
        self._health = ProcessHealth(bus, self._add_latency)

    def _add_latency(self, health: Health) -> None:
        self._latencies.add(health.process, max(health.latency_ms.values(), default=None))

    def refresh(self) -> tuple[Rows, Rows]:
        """Return the rows of processes and topics since the last call."""
        now_ns = self._bus.clock.now_ns()
        processes = {}
        for name, health in self._health.newest.items():
            age_s = (now_ns - self._health.arrived_ns[name]) / 1e9
            processes[name] = process_cells(health, age_s, self._latencies.line(name))
        return processes, self._streams(now_ns)

    def _streams(self, now_ns: int) -> Rows:
        found, rows = self._monitor.stats(self._since_ns), {}
        for key, stream in self._monitor.streams().items():
            stats, age_s = found.get(key), stream.age_s(now_ns) or 0.0
            self._delays.add(key, stats.delay_median_ms if stats else None)
            missing, delay = self._monitor.missing(key), self._delays.line(key)
            rows[key] = topic_cells(key, stats, age_s, missing, delay)
        self._since_ns = now_ns
        return rows
