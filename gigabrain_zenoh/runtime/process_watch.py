"""Reports processes of one's own that are silent, so that every tool can name them.

The router has the list, and so also knows of those that nobody has heard of yet.
"""

from collections.abc import Sequence

from gigabrain_schemas.base import Cause
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.topics import HEALTH, LOG
from gigabrain_zenoh.bus.bus import Bus

SILENT_NS = 3_500_000_000  # three reports of its health are missing
START_NS = 20_000_000_000  # before the first one
ENDS = ("failed", "died")  # events of a process's log that tell why it ended
MAX_TEXT = 300


class ProcessWatch:
    """Keeps `bus.problems` up to date for the processes `names`."""

    def __init__(self, bus: Bus, names: Sequence[str]) -> None:
        self._bus = bus
        due = bus.clock.now_ns() + START_NS
        self._due = dict.fromkeys(names, due)  # when the next health is overdue
        self._ends: dict[str, str] = {}  # why it last ended
        if names:
            bus.subscribe(HEALTH, self._on_health)
            bus.subscribe(LOG, self._on_log)

    def _on_health(self, _key: str, health: Health) -> None:
        if health.process in self._due:
            self._due[health.process] = self._bus.clock.now_ns() + SILENT_NS

    def _on_log(self, _key: str, record: LogRecord) -> None:
        if record.process in self._due and record.event in ENDS:
            self._ends[record.process] = record.text[:MAX_TEXT]
        elif record.process in self._due and record.event == "ready":
            self._ends.pop(record.process, None)

    def look(self) -> None:
        """Find the silent ones; called about once a second."""
        now_ns = self._bus.clock.now_ns()
        silent = [name for name, due_ns in self._due.items() if now_ns > due_ns]
        self._bus.problems = tuple(self._problem(name) for name in silent[:16])

    def _problem(self, name: str) -> Cause:
        end = self._ends.get(name)
        return Cause(
            code="process_silent",
            text=f"{name} {end}" if end else f"{name} is silent: it hangs or does not run",
            remedy=f"read its log with `gigabrain log --process {name}`",
        )
