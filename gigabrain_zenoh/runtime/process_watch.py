"""Reports silent ones of the user's own processes, so that every tool can name them.

The router has their list, and so also finds those that never sent a health report.
"""

from collections.abc import Sequence

from gigabrain_schemas.base import Cause
from gigabrain_schemas.safety import Health, LogRecord
from gigabrain_schemas.topics import HEALTH, LOG
from gigabrain_zenoh.bus.bus import Bus

SILENT_NS = 3_500_000_000  # three health reports are missing
FIRST_HEALTH_NS = 20_000_000_000  # until the first report
END_EVENTS = ("failed", "died")  # events of a process's log with the reason of its end
MAX_TEXT = 300


class ProcessWatch:
    """Keeps `bus.problems` up to date for the processes `names`."""

    def __init__(self, bus: Bus, names: Sequence[str]) -> None:
        self._bus = bus
        due_ns = bus.clock.now_ns() + FIRST_HEALTH_NS
        self._due_ns = dict.fromkeys(names, due_ns)  # latest time of the next health
        self._end_texts: dict[str, str] = {}  # reason of the last end, until ready again
        if names:
            bus.subscribe(HEALTH, self._on_health)
            bus.subscribe(LOG, self._on_log)

    def _on_health(self, _key: str, health: Health) -> None:
        if health.process in self._due_ns:
            self._due_ns[health.process] = self._bus.clock.now_ns() + SILENT_NS

    def _on_log(self, _key: str, record: LogRecord) -> None:
        if record.process in self._due_ns and record.event in END_EVENTS:
            self._end_texts[record.process] = record.text[:MAX_TEXT]
        elif record.process in self._due_ns and record.event == "ready":
            self._end_texts.pop(record.process, None)

    def look(self) -> None:
        """Update `bus.problems`; call this about once a second."""
        now_ns = self._bus.clock.now_ns()
        silent = [name for name, due_ns in self._due_ns.items() if now_ns > due_ns]
        self._bus.problems = tuple(self._problem(name) for name in silent[:16])

    def _problem(self, name: str) -> Cause:
        end = self._end_texts.get(name)
        return Cause(
            code="process_silent",
            text=f"{name} {end}" if end else f"{name} is silent: it hangs or does not run",
            remedy=f"read its log with `gigabrain log --process {name}`",
        )
