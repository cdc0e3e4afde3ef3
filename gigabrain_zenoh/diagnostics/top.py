"""Rows of `gigabrain top`: processes and topics, each with a sparkline of its newest values."""

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from msgspec import Struct

from gigabrain_schemas.safety import Health
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.discovery import short, topic_of
from gigabrain_zenoh.diagnostics.robot_view import ProcessHealth
from gigabrain_zenoh.diagnostics.topic_stats import StreamStats, TopicMonitor

BARS = "▁▂▃▄▅▆▇█"
MAX_BARS = 20
SILENT_AFTER_S = 3.0  # a process that reports no health
Cell = str | float
Rows = dict[str, tuple[Cell, ...]]


class ProcessRow(Struct, frozen=True, kw_only=True):
    """One process. The fields are the columns, in their order."""

    process: str
    state: str  # "ok", "silent"
    cpu: float  # [% of a core]
    rss_mb: float
    sends_hz: float
    receives_hz: float
    rejected: int
    latency_ms: float | str  # the largest that it measures
    latency: str  # sparkline
    uptime_s: float


class StreamRow(Struct, frozen=True, kw_only=True):
    """One key. The fields are the columns, in their order."""

    topic: str
    hz: float
    promised_hz: float | str
    kb_s: float
    size: int
    delay_ms: float | str  # median, by stamp
    delay: str  # sparkline
    jitter_ms: float | str  # standard deviation of the gaps
    age_s: float
    missing: int


PROCESS_COLUMNS = ("process", "state", "CPU %", "MB", "sends Hz", "receives Hz", "rejected",
                   "latency ms", "latency", "up s")  # fmt: skip
TOPIC_COLUMNS = ("topic", "Hz", "promised", "kB/s", "bytes", "delay ms", "delay", "jitter ms",
                 "age s", "missing")  # fmt: skip


def process_row(health: Health, age_s: float, latency: str = "") -> ProcessRow:
    """Return the row of a process whose newest health is `age_s` old."""
    return ProcessRow(
        process=health.process,
        state="ok" if age_s < SILENT_AFTER_S else "silent",
        cpu=health.cpu * 100,
        rss_mb=health.rss_bytes / 1e6,
        sends_hz=sum(health.sent_hz.values()),
        receives_hz=sum(health.received_hz.values()),
        rejected=sum(health.rejected.values()),
        latency_ms=max(health.latency_ms.values(), default=""),
        latency=latency,
        uptime_s=health.uptime_s,
    )


def stream_row(
    key: str, stats: StreamStats | None, age_s: float, missing: int, delay: str = ""
) -> StreamRow:
    """Return the row of a key; `stats` is None where nothing arrived."""
    topic = topic_of(key)
    return StreamRow(
        topic=short(key),
        hz=stats.hz if stats else 0.0,
        promised_hz=topic.hz if topic else "",
        kb_s=stats.bytes_s / 1e3 if stats else 0.0,
        size=stats.size if stats else 0,
        delay_ms=_or_empty(stats.delay_median_ms if stats else None),
        delay=delay,
        jitter_ms=_or_empty(stats.gap_std_ms if stats else None),
        age_s=age_s,
        missing=missing,
    )


def _or_empty(value: float | None) -> Cell:
    return "" if value is None else value


def cells(row: Struct) -> tuple[Cell, ...]:
    """Return the values of a row, in the order of its columns."""
    return tuple(getattr(row, name) for name in row.__struct_fields__)


def cell_text(cell: Cell) -> str:
    """Return a cell as text."""
    if isinstance(cell, str):
        return cell
    return str(cell) if isinstance(cell, int) else f"{cell:.1f}"


def sorted_rows(
    rows: Mapping[str, tuple[Cell, ...]], column: int, *, down: bool
) -> list[tuple[str, tuple[Cell, ...]]]:
    """Return rows sorted by one column; empty cells come last in both directions."""
    empty = [item for item in rows.items() if item[1][column] == ""]
    rest = [item for item in rows.items() if item[1][column] != ""]
    rest.sort(key=lambda item: (isinstance(item[1][column], str), item[1][column]), reverse=down)
    return rest + empty


class History:
    """Newest values by name, as sparklines."""

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
            processes[name] = cells(process_row(health, age_s, self._latencies.line(name)))
        return processes, self._streams(now_ns)

    def _streams(self, now_ns: int) -> Rows:
        found, rows = self._monitor.stats(self._since_ns), {}
        for key, stream in self._monitor.streams().items():
            stats, age_s = found.get(key), stream.age_s(now_ns) or 0.0
            self._delays.add(key, stats.delay_median_ms if stats else None)
            missing, delay = self._monitor.missing(key), self._delays.line(key)
            rows[key] = cells(stream_row(key, stats, age_s, missing, delay))
        self._since_ns = now_ns
        return rows
