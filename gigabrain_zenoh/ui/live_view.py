"""Views of a running demo: one page in the terminal, or a progress line."""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Literal, Protocol, Self

from rich.console import Group
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from gigabrain_zenoh.gate.causes import in_words
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.terminal import LINES, Display, writer
from gigabrain_zenoh.runtime.supervisor import Supervisor
from gigabrain_zenoh.ui.run_report import RunMonitor

FRAMES_HZ = 4
FAULT_SHOWN_S = 30.0
LINE_INTERVAL_S = 10.0  # of the robot's time, between two lines without a terminal
ACTIVITIES = {  # of processes whose messages do not show their work
    "router": "connects the processes",
    "relay": "connects the processes",
    "page": "shows the robot in a browser",
    "foxglove": "shows the robot in Foxglove",
    "emulator": "emulates the body's line",
}
GATE_COLOURS = {"enabled": "green", "idle": "yellow", "stopping": "yellow", "latched": "red"}


StartingText = Callable[[], str]  # names processes that are not ready yet; empty if all are ready
PageAddress = Callable[[], str]  # of the operator page; empty until it is served


class DemoView(Protocol):
    """Shows a run for as long as its `with` block lasts."""

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def show(self) -> None:
        """Update the view."""

    def show_fault(self, fault: str) -> None:
        """Show a fault."""


class HeadlessView:
    """A progress line on stderr: redrawn in place on a terminal, every ten seconds elsewhere."""

    def __init__(
        self,
        watch: RunMonitor,
        seconds: float | None,
        page: PageAddress = str,
        starting: StartingText = str,
    ) -> None:
        self._watch, self._seconds, self._page, self._starting = watch, seconds, page, starting
        self._next_line_s, self._page_shown = LINE_INTERVAL_S, False
        self._in_place = sys.stderr.isatty()
        self._display = Display(writer(sys.stderr), LINES)

    def __enter__(self) -> Self:
        self._display.__enter__()
        return self

    def __exit__(self, *end: object) -> None:
        if self._in_place:
            self._display.put("\n")
        self._display.__exit__(*end)

    def show_fault(self, fault: str) -> None:
        """Print a fault on a line of its own."""
        newline = "\n" if self._in_place else ""  # ends the line that is redrawn
        self._display.put(f"{newline}{fault}\n")

    def show(self) -> None:
        """Print the progress, if it is due."""
        watch = self._watch
        if not self._page_shown and watch.state.newest and (page := self._page()):
            self._display.put(f"operator page: {page}\n")
            self._page_shown = True
        if not self._in_place and watch.seconds < self._next_line_s:
            return
        self._next_line_s = watch.seconds + LINE_INTERVAL_S
        limit = f"/{self._seconds:.0f}" if self._seconds else ""
        activity = printable(doing(watch, self._starting()))
        line = f"{watch.seconds:6.1f}{limit} s  {watch.distance_m:6.2f} m  {activity}"
        if self._in_place:
            self._display.put(f"\r{line[:100]:<100}")
        else:
            self._display.put(f"{line}\n")


class LiveView:
    """One page in the terminal with the whole robot; the last page stays after the end."""

    def __init__(
        self,
        watch: RunMonitor,
        supervisor: Supervisor,
        title: str,
        faults: Sequence[tuple[float, str]],
        seconds: float | None,
        page: str = "",
        starting: StartingText = str,
    ) -> None:
        self._starting = starting
        self._title = _line(title)
        self._subtitle = _line(f"{page} · Ctrl-C ends it" if page else "Ctrl-C ends it")
        self._watch, self._supervisor = watch, supervisor
        self._faults, self._seconds = faults, seconds
        # drawn in the event loop, so that all values are of the same moment
        self._live = Live(self._page(), screen=True, auto_refresh=False)
        self._display = Display[Panel](lambda page: self._live.update(page, refresh=True), room=1)
        self._next_s = 0.0

    def __enter__(self) -> Self:
        self._live.start()
        self._display.__enter__()
        return self

    def __exit__(self, *end: object) -> None:
        self._display.__exit__(*end)
        self._live.stop()
        self._live.console.print(self._page())

    def show(self) -> None:
        """Redraw the page, a few times a second."""
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s = now_s + 1 / FRAMES_HZ
            self._display.put(self._page())

    def show_fault(self, fault: str) -> None:
        """Do nothing: the page lists the faults itself."""

    def _page(self) -> Panel:
        watch = self._watch
        gate = watch.state.newest.gate.mode if watch.state.newest else "idle"
        headline = "bold cyan" if gate == "enabled" else f"bold {GATE_COLOURS[gate]}"
        parts: list[Text | Table] = [
            _line(doing(watch, self._starting()), headline, "center"),
            Text(),
            self._figures(),
            Text(),
            self._processes(),
        ]
        now_s = time.monotonic()
        parts += [
            _line(text, "yellow") for at_s, text in self._faults if now_s - at_s < FAULT_SHOWN_S
        ]
        return Panel(Group(*parts), title=self._title, subtitle=self._subtitle, padding=(1, 2))

    def _figures(self) -> Table:
        watch, state = self._watch, self._watch.state.newest
        table = Table.grid(expand=True)
        for ratio in (3, 3, 2, 2):
            table.add_column(justify="center", ratio=ratio, no_wrap=True)
        gate = Text("-", style="dim")
        battery = "-"
        if state:
            gate = Text(state.gate.mode, style=GATE_COLOURS[state.gate.mode])
            if state.battery:
                battery = f"{state.battery.percentage:.0f} %  {state.battery.voltage:.1f} V"
        driver = watch.health.get("driver")
        latency = driver.latency_ms if driver else {}
        p50, p99 = latency.get("scan_to_cmd_p50"), latency.get("scan_to_cmd_p99")
        latency_text = f"{p50:.1f} ms (p99 {p99:.1f})" if p50 and p99 else "-"
        names = ("driven", "scan → command", "gate", "battery")
        table.add_row(*(Text(name, style="dim") for name in names))
        limit = f" of {self._seconds:.0f}" if self._seconds else ""
        driven = f"{watch.distance_m:.2f} m in {watch.seconds:.0f}{limit} s"
        table.add_row(driven, latency_text, gate, battery)
        return table

    def _processes(self) -> Table:
        table = Table(box=None, expand=True, pad_edge=False, header_style="dim")
        table.add_column("process", style="bold", width=10)
        table.add_column("state", width=11)
        table.add_column("pid", justify="right", width=7)
        table.add_column("CPU", justify="right", width=6)
        table.add_column("memory", justify="right", width=6)
        table.add_column("what it does", ratio=1, no_wrap=True, overflow="ellipsis")
        for name, status in self._supervisor.statuses.items():
            ready = status.state == "ready"
            health = self._watch.health.get(name) if ready else None
            restarts = f" ↻{status.restarts}" if status.restarts else ""
            style = "green" if ready else "red" if status.state == "given up" else "yellow"
            table.add_row(
                name,
                _line(f"{status.state}{restarts}", style),
                str(status.pid or ""),
                f"{health.cpu * 100:.1f} %" if health else "",
                f"{health.rss_bytes / 1e6:.0f} MB" if health else "",
                _line(_activity(name, self._watch) if ready else ""),
            )
        return table


def _line(text: str, style: str = "", justify: Literal["left", "center"] = "left") -> Text:
    """Return a line of plain text, without markup; an ellipsis ends it if it is too long."""
    return Text(printable(text), style=style, justify=justify, no_wrap=True, overflow="ellipsis")


def doing(watch: RunMonitor, starting: str = "") -> str:
    """Describe what the robot does; `starting` names processes that are not ready yet."""
    state, intent = watch.state.fresh(), watch.intent.fresh()
    if state is None:
        return starting or "starting" if watch.state.newest is None else "the driver is silent"
    gate = state.gate
    if gate.mode == "enabled" and gate.commander != "control":
        return f"{gate.commander} drives"
    if gate.mode != "enabled" and starting:
        return starting
    if gate.mode != "enabled" and gate.causes:
        return f"{gate.mode}: {in_words(gate.causes)}"
    if gate.mode != "enabled":
        return f"{gate.mode}: waiting to be enabled"
    return intent.reason if intent else "decision is silent"


def _activity(name: str, watch: RunMonitor) -> str:
    """Describe the work of a process by its messages."""
    health = watch.health.get(name)
    sent = health.sent_hz if health else {}
    if name == "recorder":
        return f"recorded {health.counters.get('recorded', 0) if health else 0} messages"
    if name == "driver":
        return f"state {sent.get('robot/state', 0):.0f} Hz, scan {sent.get('robot/scan', 0):.0f} Hz"
    if name == "perception":
        return _world_summary(watch)
    if name == "decision":
        intent = watch.intent.fresh()
        if intent is None:
            return "silent"
        task = watch.task.current
        work = task.doing if task and task.doing else intent.reason
        return f"{intent.progress:.0%} · {work}"
    if name == "control":
        command = watch.command.fresh()
        if command is None:
            return "silent"
        return f"{command.linear_x:+.2f} m/s  {command.angular_z:+.2f} rad/s"
    if name == "safety":
        return _verdict_summary(watch)
    return ACTIVITIES.get(name, "")


def _verdict_summary(watch: RunMonitor) -> str:
    verdict = watch.safety.fresh()
    if verdict is None:
        return "silent"
    causes = in_words((*verdict.causes, *verdict.warnings))
    return f"{verdict.verdict}: {causes}" if causes else verdict.verdict


def _world_summary(watch: RunMonitor) -> str:
    world = watch.world.fresh()
    if world is None:
        return "silent"
    if not world.scan_ok:
        return f"blind: {world.scan_problem}"
    if world.distance_ahead is not None:
        return f"obstacle {world.distance_ahead:.2f} m ahead"
    return "free ahead"
