"""What `gigabrain top` hears, second by second."""

from typing import Protocol

from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.tally import Tally
from gigabrain_zenoh.diagnostics.top_rows import (
    Cell,
    Past,
    process_cells,
    process_row,
    topic_cells,
    topic_row,
)
from gigabrain_zenoh.host.bounded import put_newest

Rows = dict[str, tuple[Cell, ...]]
MOST_PROCESSES = 64


class Feed(Protocol):
    """Where the tables come from."""

    def refresh(self) -> tuple[Rows, Rows]:
        """Processes and topics, of the time since the last call."""
        ...


class BusFeed:
    """From a running robot."""

    def __init__(self, bus: Bus, tally: Tally) -> None:
        self._bus, self._tally = bus, tally
        self._since_ns = bus.clock.now_ns()
        self._health: dict[str, tuple[Health, int]] = {}
        self._past, self._delays = Past(), Past()
        bus.subscribe(HEALTH, self._hear)

    def _hear(self, _key: str, told: Health) -> None:
        put_newest(self._health, told.process, (told, self._bus.clock.now_ns()), MOST_PROCESSES)
        self._past.add(told.process, max(told.latency_ms.values(), default=None))

    def refresh(self) -> tuple[Rows, Rows]:
        """Processes and topics, of the time since the last call."""
        now_ns = self._bus.clock.now_ns()
        processes = {}
        for name, (told, at_ns) in self._health.items():
            row = process_row(told, (now_ns - at_ns) / 1e9)
            processes[name] = process_cells(row, self._past)
        return processes, self._topics(now_ns)

    def _topics(self, now_ns: int) -> Rows:
        found, rows = self._tally.figures(self._since_ns), {}
        for key, stream in self._tally.streams().items():
            made = topic_row(
                key, found.get(key), stream.age_s(now_ns) or 0.0, self._tally.missing(key)
            )
            self._delays.add(made.name, made.delay_ms)
            rows[key] = topic_cells(made, self._delays)
        self._since_ns = now_ns
        return rows
