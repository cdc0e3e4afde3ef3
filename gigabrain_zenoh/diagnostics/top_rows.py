"""What `gigabrain top` shows: processes and topics as rows, and what they were before as lines."""

from collections import deque
from collections.abc import Mapping, Sequence

from msgspec import Struct

from gigabrain_schemas.safety import Health
from gigabrain_zenoh.diagnostics.names import short, topic_of
from gigabrain_zenoh.diagnostics.tally import Figures

BARS = "▁▂▃▄▅▆▇█"
ROOM = 20  # values of a line
SILENT_S = 3.0  # a process that has reported nothing for so long
Cell = str | float


class ProcessRow(Struct, frozen=True, kw_only=True):
    """One process."""

    name: str
    state: str  # "ok", "silent"
    cpu: float  # of a core
    rss_mb: float
    sends_hz: float
    hears_hz: float
    rejected: int
    latency_ms: float | None  # the worst of what it measures
    uptime_s: float


class TopicRow(Struct, frozen=True, kw_only=True):
    """One key."""

    name: str
    hz: float
    promised_hz: float | None
    kb_s: float
    size: int
    delay_ms: float | None  # median, by stamp
    jitter_ms: float | None  # standard deviation of the gaps
    age_s: float
    missing: int


def process_row(health: Health, age_s: float) -> ProcessRow:
    """How a process was when it last said so."""
    return ProcessRow(
        name=health.process,
        state="ok" if age_s < SILENT_S else "silent",
        cpu=health.cpu,
        rss_mb=health.rss_bytes / 1e6,
        sends_hz=sum(health.sent_hz.values()),
        hears_hz=sum(health.received_hz.values()),
        rejected=sum(health.rejected.values()),
        latency_ms=max(health.latency_ms.values(), default=None),
        uptime_s=health.uptime_s,
    )


def topic_row(key: str, figures: Figures | None, age_s: float, missing: int) -> TopicRow:
    """How a key was in the last look; zero where nothing came."""
    topic = topic_of(key)
    return TopicRow(
        name=short(key),
        hz=figures.hz if figures else 0.0,
        promised_hz=topic.hz if topic else None,
        kb_s=figures.bytes_s / 1e3 if figures else 0.0,
        size=figures.size if figures else 0,
        delay_ms=figures.delay_median_ms if figures else None,
        jitter_ms=figures.gap_std_ms if figures else None,
        age_s=age_s,
        missing=missing,
    )


class Past:
    """The newest values of each row."""

    def __init__(self) -> None:
        self._of: dict[str, deque[float]] = {}

    def add(self, name: str, value: float | None) -> None:
        """Take one; None, where there was none, leaves no trace."""
        if value is not None:
            self._of.setdefault(name, deque(maxlen=ROOM)).append(value)

    def line(self, name: str) -> str:
        """As bars."""
        return sparkline(tuple(self._of.get(name, ())))


def sparkline(values: Sequence[float]) -> str:
    """Bars from zero to the largest."""
    most = max(values, default=0.0)
    if most <= 0:
        return BARS[0] * len(values)
    return "".join(BARS[min(7, int(max(value, 0.0) / most * 8))] for value in values)


PROCESS_COLUMNS = ("process", "state", "CPU %", "MB", "sends Hz", "hears Hz", "rejected",
                   "latency ms", "latency", "up s")  # fmt: skip
TOPIC_COLUMNS = ("topic", "Hz", "promised", "kB/s", "bytes", "delay ms", "delay", "jitter ms",
                 "age s", "missing")  # fmt: skip


def process_cells(row: ProcessRow, past: Past) -> tuple[Cell, ...]:
    """In the order of PROCESS_COLUMNS."""
    return (
        row.name, row.state, row.cpu * 100, row.rss_mb, row.sends_hz, row.hears_hz, row.rejected,
        _or_nothing(row.latency_ms), past.line(row.name), row.uptime_s,
    )  # fmt: skip


def topic_cells(row: TopicRow, past: Past) -> tuple[Cell, ...]:
    """In the order of TOPIC_COLUMNS."""
    return (
        row.name, row.hz, _or_nothing(row.promised_hz), row.kb_s, row.size,
        _or_nothing(row.delay_ms), past.line(row.name), _or_nothing(row.jitter_ms), row.age_s,
        row.missing,
    )  # fmt: skip


def _or_nothing(value: float | None) -> Cell:
    return "" if value is None else value


def shown(cell: Cell) -> str:
    """A cell as people read it."""
    if isinstance(cell, str):
        return cell
    return str(cell) if isinstance(cell, int) else f"{cell:.1f}"


def in_order(
    rows: Mapping[str, tuple[Cell, ...]], column: int, *, down: bool
) -> list[tuple[str, tuple[Cell, ...]]]:
    """Rows by one column; what is empty comes last either way."""
    empty = [item for item in rows.items() if item[1][column] == ""]
    rest = [item for item in rows.items() if item[1][column] != ""]
    rest.sort(key=lambda item: (isinstance(item[1][column], str), item[1][column]), reverse=down)
    return rest + empty
