"""The demo: a whole robot on this machine, watched until a person or its time limit ends it."""

import asyncio
import contextlib
import sys
import time
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from msgspec import Struct, structs

from gigabrain_schemas.base import TICK_S
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.bus.zenoh.workarounds import NAP_S
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.layers import Row
from gigabrain_zenoh.config.settings import PageConfig
from gigabrain_zenoh.errors import BodyLost, ConfigError
from gigabrain_zenoh.host import files
from gigabrain_zenoh.host.escaping import printable
from gigabrain_zenoh.host.run_folders import new_run_dir
from gigabrain_zenoh.host.signals import run_until, stop_signals
from gigabrain_zenoh.launch.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.launch.merging import write_rows
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.launch.supervisor_log import SupervisorLog
from gigabrain_zenoh.launch.up import LIMIT_S, STOP_S
from gigabrain_zenoh.runtime.running import announced
from gigabrain_zenoh.runtime.supervisor import Supervisor
from gigabrain_zenoh.ui.live_view import DemoView, HeadlessView, LiveView
from gigabrain_zenoh.ui.page.node import INSTALL, free_port, installed, page_address
from gigabrain_zenoh.ui.run_report import (
    Observed,
    Report,
    RunMonitor,
    make_report,
    summary,
    truth_in_health,
)

CAPACITY_CHECK_S = 1.0  # period of checks
MAX_SLOW_CHECKS = 5  # in sequence, as a short pause of the machine is no problem
KEPT = 0.95  # share of real time that a simulation reaches on a sufficient machine


class Capacity:
    """Detects a machine that is too slow, by the robot's clock and the brain's delays."""

    def __init__(self) -> None:
        self.problem = ""  # for people; never reset
        # wall and robot time [s] before the first of consecutive slow checks, and at the last check
        self._slow_since: tuple[float, float] | None = None
        self._last: tuple[float, float] | None = None
        self._slow_checks, self._held = 0, False

    def restart(self) -> None:
        """Measure from the next `compare` on: while a process starts, time may stand still."""
        self._last, self._slow_checks, self._held = None, 0, False

    def compare(self, now_s: float, robot_s: float, *, held: bool) -> None:
        """Compare the wall clock with the robot's [s].

        With `held` the brain is late because the processors are busy.
        """
        if self._last is None:
            self._last = self._slow_since = now_s, robot_s
        self._held |= held
        passed_s, gained_s = now_s - self._last[0], robot_s - self._last[1]
        if passed_s < CAPACITY_CHECK_S:
            return
        slow = 0.0 < gained_s < KEPT * passed_s  # a clock that stands still is another fault
        if not (slow or self._held):
            self._slow_since, self._slow_checks = (now_s, robot_s), 0
        else:
            self._slow_checks += 1
        self._last, self._held = (now_s, robot_s), False
        if self._slow_checks >= MAX_SLOW_CHECKS and not self.problem:
            self.problem = self._in_words(now_s, robot_s)

    def _in_words(self, now_s: float, robot_s: float) -> str:
        assert self._slow_since
        share = (robot_s - self._slow_since[1]) / (now_s - self._slow_since[0])
        symptom = (
            f"its time runs at {share:.0%} of real time" if share < KEPT else "the brain is late"
        )
        return (
            f"this machine is too small for the robot, or too busy: {symptom}; "
            "run fewer robots on it, or stop other programs"
        )


SYSTEMS = ("perception", "decision", "control")
CHECK_S = 0.1  # period of checks
RELEASE_FIRST = (
    "a real body drives only after a person has released and enabled it: while the demo runs, "
    "call `gigabrain release` and `gigabrain enable` in another terminal"
)
STALL_TIMEOUT_S = 60.0  # without a tick of the robot's clock
REPORT_TIMEOUT_S, SHORT_TIMEOUT_S = 5.0, 0.2  # for processes' reports; the second after Ctrl-C


class DemoOptions(Struct, frozen=True, kw_only=True):
    """Options of a demo."""

    seconds: float | None = None  # of the robot's time; None for until Ctrl-C
    headless: bool = False
    report: Path | None = None
    page: str = ""  # address of the operator page, or how to install it
    rows: tuple[Row, ...] = ()  # the settings and their sources, for `gigabrain config`
    keep_stuck: bool = False  # do not kill processes without progress, for a debugger


def with_page(deployment: Deployment, port: int, *, login: bool = False) -> tuple[Deployment, str]:
    """Return the deployment with a page on its first host, and the page's address.

    Without the page's libraries it returns the deployment unchanged, and how to install them.
    With `login` the address contains the operator's token. Raises ConfigError.
    """
    if not installed():
        return deployment, INSTALL
    page = PageConfig(port=free_port(port), login=login)
    (host, names), *others = deployment.hosts.items()
    hosts = {host: (*names, "page"), **dict(others)}
    return structs.replace(deployment, hosts=hosts, page=page), page_address(page)


def only_host(deployment: Deployment) -> str:
    """Return the host of a demo. Raises ConfigError for a deployment of several."""
    host, *others = deployment.hosts
    if others:
        names = ", ".join(deployment.hosts)
        raise ConfigError(f"hosts: a demo has one host, got {names}; run them with `gigabrain up`")
    return host


class Demo:
    """One run of a demo."""

    def __init__(self, deployment: Deployment, options: DemoOptions) -> None:
        self._deployment, self._options = with_free_port(deployment), options
        files.check_result_path(options.report)
        self._run_dir = new_run_dir(None, "demo")
        write_rows(self._run_dir, options.rows)
        specs = process_specs(
            self._deployment,
            only_host(deployment),
            self._run_dir,
            self._run_dir / "state",
            seconds=options.seconds,
        )
        self._log = SupervisorLog(self._run_dir)
        self._supervisor = Supervisor(specs, self._record, keep_stuck=options.keep_stuck)
        self._decisions: list[tuple[float, str]] = []
        self._failures: list[tuple[str, str]] = []  # process and text
        self._compiling: set[str] = set()  # processes that compile now
        self._mismatches: dict[str, None] = {}  # between model and robot file, in order
        self._refusals: dict[str, str] = {}  # last error, by process
        self._faults: deque[tuple[float, str]] = deque(maxlen=4)  # time [s] and text
        self._capacity = Capacity()
        self._disk_full = False  # the driver waits for space
        self._last_fault = ""  # before the end of the run; the driver's take precedence

    async def run(self) -> int:
        """Run it; return 0 for a run with motion, without contact, with all processes alive.

        A run that a person ends counts as good. Raises GigabrainError if it cannot start.
        """
        label = f"{self._deployment.body} in {self._deployment.world}"
        endpoint = client_endpoint(self._deployment)
        with stop_signals(LIMIT_S) as stop, announced(label, endpoint, self._run_dir):
            async with self._supervisor:
                running = asyncio.ensure_future(self._supervisor.run())
                bus = await self._join(stop)
                try:
                    watch = RunMonitor(bus) if bus else None
                    if watch:
                        await self._watch(watch, stop)
                    # later events are not the reason for the end of the run
                    stopped, reason = stop.is_set(), self._failure()
                    report = await self._make_report(watch, stop) if watch else None
                finally:
                    closing = asyncio.ensure_future(bus.close()) if bus else None
                    await self._supervisor.stop(STOP_S)
                    await running
                    if closing:
                        await closing
        self._log.close()
        return self._finish(report, reason, stopped=stopped)

    async def _join(self, stop: asyncio.Event) -> Bus | None:
        """Connect to the robot; return None if the run ends before there is a router."""
        endpoint = structs.replace(client_endpoint(self._deployment), nap_s=NAP_S)
        opening = asyncio.ensure_future(ZenohTransport.open(endpoint))
        while not (opening.done() or stop.is_set() or self._supervisor.lost):
            await asyncio.wait((opening,), timeout=CHECK_S)
        if not opening.done():
            opening.cancel()
            return None
        return Bus(opening.result(), Clock(), "demo")

    async def _watch(self, watch: RunMonitor, stop: asyncio.Event) -> None:
        """Watch and show the run until its end."""
        view = self._view(watch)
        loop = asyncio.get_running_loop()
        moved_s, seconds = loop.time(), watch.seconds
        with view:
            while not (stop.is_set() or self._supervisor.lost or self._over(watch)):
                watch.look()
                view.show()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(stop.wait(), CHECK_S)
                self._check_capacity(watch, view)
                if watch.problem:
                    self._failures.append(("demo", watch.problem))
                    break
                if watch.seconds != seconds or self._starting:
                    moved_s, seconds = loop.time(), watch.seconds
                elif loop.time() - moved_s > STALL_TIMEOUT_S:
                    stall = f"the robot's clock stood still for {STALL_TIMEOUT_S:.0f} s"
                    self._failures.append(("demo", stall))
                    break
            watch.look()
            view.show()
        self._last_fault = newest_fault(text for _, text in self._faults)

    def _check_capacity(self, watch: RunMonitor, view: DemoView) -> None:
        """Report once if this machine is too slow; only in real time, without lock-step."""
        capacity, known = self._capacity, self._capacity.problem
        if self._starting or self._compiling or self._deployment.speed != 1.0:
            capacity.restart()
            return
        capacity.compare(asyncio.get_running_loop().time(), watch.seconds, held=watch.held_by_load)
        if capacity.problem != known:
            self._faults.append((time.monotonic(), capacity.problem))
            view.show_fault(capacity.problem)

    @property
    def _starting(self) -> bool:
        """Return whether a process is starting."""
        statuses = self._supervisor.statuses.values()
        return any(status.state in ("waiting", "starting") for status in statuses)

    def _starting_up(self) -> str:
        """Return a text about the systems that are starting; empty if there are none."""
        statuses = self._supervisor.statuses
        names = [name for name in SYSTEMS if name in statuses]
        names = [name for name in names if statuses[name].state == "starting"]
        if not names:
            return ""
        reason = ", compiling, once per installation" if self._compiling & set(names) else ""
        return f"{' and '.join(names)} {'is' if len(names) == 1 else 'are'} starting up{reason}"

    def _page_text(self) -> str:
        """Return the address of the operator page once it runs, or how to install it."""
        status = self._supervisor.statuses.get("page")
        return self._options.page if status is None or status.state == "ready" else ""

    def _over(self, watch: RunMonitor) -> bool:
        seconds = self._options.seconds
        return self._disk_full or (seconds is not None and watch.seconds >= seconds - 1e-6)

    @property
    def _live(self) -> bool:
        """Return whether the live view is shown in the terminal."""
        return not self._options.headless and sys.stdout.isatty()

    def _view(self, watch: RunMonitor) -> DemoView:
        seconds, page = self._options.seconds, self._options.page
        if not self._live:
            return HeadlessView(watch, seconds, self._page_text, self._starting_up)
        run = self._deployment
        speed = "" if run.speed == 1.0 else f" · ×{run.speed:g}"
        title = f"{run.body} · {run.world} · seed {run.seed}{speed}"
        return LiveView(
            watch, self._supervisor, title, self._faults, seconds, page, self._starting_up
        )

    async def _ask_all(
        self, watch: RunMonitor, stop: asyncio.Event
    ) -> dict[str, Mapping[str, Any]]:
        """Return the processes' reports of the run; wait less once `stop` is set."""
        statuses = self._supervisor.statuses
        answers: dict[str, Mapping[str, Any]] = {}

        async def ask(name: str, within_s: float) -> None:
            if answer := await watch.describe(name, within_s):
                answers[name] = answer.report

        async def ask_all(within_s: float) -> None:
            silent = [n for n, s in statuses.items() if s.state == "ready" and n not in answers]
            await asyncio.gather(*(ask(name, within_s) for name in silent))

        await run_until(stop, ask_all(REPORT_TIMEOUT_S))
        if stop.is_set():
            await ask_all(SHORT_TIMEOUT_S)
        return answers

    async def _make_report(self, watch: RunMonitor, stop: asyncio.Event) -> Report | None:
        answers, statuses = await self._ask_all(watch, stop), self._supervisor.statuses
        state = watch.state.newest
        if "driver" not in answers and state is None:
            return None
        truth = truth_in_health(watch.health.get("driver"))
        for answer in answers.values():
            truth |= answer
        observed = Observed(
            body=state.robot_type if state else self._deployment.body,
            answered="driver" in answers,
            world=self._deployment.world,
            seed=self._deployment.seed,
            speed=self._deployment.speed,
            seconds=watch.seconds,
            distance_m=watch.distance_m,
            drives=watch.drives,
            decisions=tuple(self._decisions),
            turns=watch.turns,
            deaths=self._supervisor.deaths,
            restarts=sum(status.restarts for status in statuses.values()),
            mapped_m2=watch.mapped_m2,
            tasks=watch.task.current,
            start=watch.start_times,
            problem=watch.problem,
            rejected=sum(int(report.get("rejected_messages") or 0) for report in answers.values()),
        )
        return make_report(truth, observed)  # the truth comes from the process with the simulator

    def _record(self, name: str, record: Mapping[str, Any]) -> None:
        """Process a log record of a process."""
        self._log.add(record)
        event, level = record.get("event"), record.get("level")
        if event == "decision":
            decided = round(record["tick"] * TICK_S, 2), str(record["reason"])
            if self._decisions and self._decisions[-1][0] == decided[0]:
                self._decisions.pop()  # only the last decision of a tick counts
            self._decisions.append(decided)
        if event == "compiling":
            self._compiling.add(str(record["process"]))
        if event == "compiled":
            self._compiling.discard(str(record["process"]))
        if event == "mismatch":
            self._mismatches[str(record.get("text", ""))] = None
        if event == "failed":
            self._refusals[name] = str(record.get("text", ""))
        self._disk_full |= event == "disk full"
        if event in ("disk full", "given up", "died"):
            self._failures.append((name, str(record.get("text", ""))))
        if level in ("warning", "error", "critical"):
            text = printable(f"{record['process']}: {record.get('text', '')}")
            self._faults.append((time.monotonic(), text))

    def _failure(self) -> str:
        """Return the newest failure, of a lost process if there is one; empty without failures."""
        lost = [text for name, text in self._failures if name in self._supervisor.lost]
        return (lost or [text for _, text in self._failures] or [""])[-1]

    def _finish(self, report: Report | None, reason: str, *, stopped: bool) -> int:
        """Print the result; return the exit code. `reason` is the failure that ended the run."""
        if self._capacity.problem and self._live:
            print(self._capacity.problem, file=sys.stderr)
        if report:
            print(summary(report))
            files.write_result(report, self._options.report)
        for text in self._mismatches:
            print(f"warning: {text}", file=sys.stderr)
        closing = f"{reason}; logs in {self._run_dir}" if reason else f"logs in {self._run_dir}"
        if stopped and report is None:
            print("ended; the driver did not answer, so there is no report", file=sys.stderr)
        if stopped:
            if reason:
                print(closing, file=sys.stderr)
            return 0
        if report and report.ok and not reason:
            return 0
        if wrong := self._supervisor.misconfigured:
            raise ConfigError(self._refusals.get(wrong[0], reason))
        if report is None:
            raise BodyLost(f"no report: {'' if reason else 'the driver did not answer; '}{closing}")
        if self._last_fault:
            print(f"newest fault: {self._last_fault}", file=sys.stderr)
        if self._deployment.link == "real":
            print(RELEASE_FIRST, file=sys.stderr)
        print(closing, file=sys.stderr)
        return 1


def newest_fault(texts: Iterable[str]) -> str:
    """Return the driver's newest fault, else the newest of all, as the likeliest reason."""
    newest = list(texts)[::-1]
    return next((text for text in newest if text.startswith("driver:")), "".join(newest[:1]))
