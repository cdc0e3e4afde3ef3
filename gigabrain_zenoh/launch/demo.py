"""The demo: a whole robot on this machine, watched until it is stopped or its time is over."""

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

CAPACITY_LOOK_S = 1.0
SHORT_LOOKS = 5  # in a row, because a pause of the machine passes
KEPT = 0.95  # share of real time that a simulation keeps on a machine that can carry it


class Capacity:
    """Judges a run in real time by the robot's clock, and by why it stands."""

    def __init__(self) -> None:
        self.problem = ""  # for people; stays once it is there
        self._began: tuple[float, float] | None = None  # of a row of bad looks: wall, robot [s]
        self._last: tuple[float, float] | None = None
        self._short, self._held = 0, False

    def restart(self) -> None:
        """Count from the next look on: a process is starting, and time may wait for it."""
        self._last, self._short, self._held = None, 0, False

    def compare(self, now_s: float, robot_s: float, *, held: bool) -> None:
        """Compare the wall clock with the robot's.

        With `held` the brain is held back while the processors have no time to spare.
        """
        if self._last is None:
            self._last = self._began = now_s, robot_s
        self._held |= held
        passed_s, gained_s = now_s - self._last[0], robot_s - self._last[1]
        if passed_s < CAPACITY_LOOK_S:
            return
        lost = 0.0 < gained_s < KEPT * passed_s  # a clock that stands still is another fault
        if not (lost or self._held):
            self._began, self._short = (now_s, robot_s), 0
        else:
            self._short += 1
        self._last, self._held = (now_s, robot_s), False
        if self._short >= SHORT_LOOKS and not self.problem:
            self.problem = self._in_words(now_s, robot_s)

    def _in_words(self, now_s: float, robot_s: float) -> str:
        assert self._began
        share = (robot_s - self._began[1]) / (now_s - self._began[0])
        what = f"its time runs at {share:.0%} of real time" if share < KEPT else "the brain is late"
        return (
            f"this machine is too small for the robot, or too busy: {what}; "
            "run fewer robots on it, or end what else needs its processors"
        )


SYSTEMS = ("perception", "decision", "control")
LOOK_S = 0.1  # period of checks
RELEASE_FIRST = (
    "a real body drives only after a person has released and enabled it: while the demo runs, in "
    "another terminal, `gigabrain release` and `gigabrain enable`"
)
STALLED_S = 60.0  # without a tick of the robot's clock
ANSWER_S, HASTY_S = 5.0, 0.2  # how long the truth may take; and once a person wants it to end


class DemoOptions(Struct, frozen=True, kw_only=True):
    """Options of a demo."""

    seconds: float | None = None  # of the robot's time; None for until Ctrl-C
    headless: bool = False
    report: Path | None = None
    page: str = ""  # where the operator page is, or how to get it
    rows: tuple[Row, ...] = ()  # the settings and their sources, for `gigabrain config`
    keep_stuck: bool = False  # processes without progress are left alone, for a debugger


def with_page(deployment: Deployment, port: int, *, login: bool = False) -> tuple[Deployment, str]:
    """Return the deployment with a page on its first host, and the page's address.

    Without the page's libraries return the deployment as it is, and how to install them. With
    `login` the address contains the operator's token. Raises ConfigError.
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
    """One run."""

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
        self._failures: list[tuple[str, str]] = []  # of which process, and what
        self._compiling: set[str] = set()  # processes that reported it
        self._mismatches: dict[str, None] = {}  # between model and robot file, in order
        self._refusals: dict[str, str] = {}  # by process, the last error with which it ended
        self._faults: deque[tuple[float, str]] = deque(maxlen=4)  # when [s], and what
        self._capacity = Capacity()
        self._disk_full = False  # and the driver waits for space
        self._last_fault = ""  # before all were asked to end, the driver's first

    async def run(self) -> int:
        """Run it; return 0 for a run with motion, without contact, with all processes alive.

        A run that a person ends is not judged. Raises GigabrainError if it cannot start.
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
                    # what comes only later has not ended the run
                    stopped, why = stop.is_set(), self._why()
                    report = await self._ask_for_truth(watch, stop) if watch else None
                finally:
                    closing = asyncio.ensure_future(bus.close()) if bus else None
                    await self._supervisor.stop(STOP_S)
                    await running
                    if closing:
                        await closing
        self._log.close()
        return self._finish(report, why, stopped=stopped)

    async def _join(self, stop: asyncio.Event) -> Bus | None:
        """Open a session; return None if the run ends before there is a router."""
        endpoint = structs.replace(client_endpoint(self._deployment), nap_s=NAP_S)
        opening = asyncio.ensure_future(ZenohTransport.open(endpoint))
        while not (opening.done() or stop.is_set() or self._supervisor.lost):
            await asyncio.wait((opening,), timeout=LOOK_S)
        if not opening.done():
            opening.cancel()
            return None
        return Bus(opening.result(), Clock(), "demo")

    async def _watch(self, watch: RunMonitor, stop: asyncio.Event) -> None:
        """Look on until the end."""
        view = self._view(watch)
        loop = asyncio.get_running_loop()
        moved_s, seconds = loop.time(), watch.seconds
        with view:
            while not (stop.is_set() or self._supervisor.lost or self._over(watch)):
                watch.look()
                view.show()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(stop.wait(), LOOK_S)
                self._look_at_capacity(watch, view)
                if watch.problem:
                    self._failures.append(("demo", watch.problem))
                    break
                if watch.seconds != seconds or self._starting:
                    moved_s, seconds = loop.time(), watch.seconds
                elif loop.time() - moved_s > STALLED_S:
                    stall = f"the robot's clock stood still for {STALLED_S:.0f} s"
                    self._failures.append(("demo", stall))
                    break
            watch.look()
            view.show()
        self._last_fault = newest_fault(text for _, text in self._faults)

    def _look_at_capacity(self, watch: RunMonitor, view: DemoView) -> None:
        """Report once that this machine is too small; in lock-step, time may wait for the brain."""
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
        """Return whether a process is starting; the very first start compiles."""
        statuses = self._supervisor.statuses.values()
        return any(status.state in ("waiting", "starting") for status in statuses)

    def _starting_up(self) -> str:
        """Return which of the three systems is starting, and why it takes long; empty for none."""
        statuses = self._supervisor.statuses
        late = [one for one in SYSTEMS if one in statuses and statuses[one].state == "starting"]
        if not late:
            return ""
        why = ", compiling, once per installation" if self._compiling & set(late) else ""
        return f"{' and '.join(late)} {'is' if len(late) == 1 else 'are'} starting up{why}"

    def _served(self) -> str:
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
            return HeadlessView(watch, seconds, self._served, self._starting_up)
        made = self._deployment
        speed = "" if made.speed == 1.0 else f" · ×{made.speed:g}"
        title = f"{made.body} · {made.world} · seed {made.seed}{speed}"
        return LiveView(
            watch, self._supervisor, title, self._faults, seconds, page, self._starting_up
        )

    async def _ask_all(
        self, watch: RunMonitor, stop: asyncio.Event
    ) -> dict[str, Mapping[str, Any]]:
        """Return what processes report of the run, by name; hardly wait once `stop` is set."""
        statuses = self._supervisor.statuses
        answers: dict[str, Mapping[str, Any]] = {}

        async def ask(name: str, within_s: float) -> None:
            if answer := await watch.describe(name, within_s):
                answers[name] = answer.report

        async def ask_all(within_s: float) -> None:
            silent = [n for n, s in statuses.items() if s.state == "ready" and n not in answers]
            await asyncio.gather(*(ask(name, within_s) for name in silent))

        await run_until(stop, ask_all(ANSWER_S))
        if stop.is_set():
            await ask_all(HASTY_S)
        return answers

    async def _ask_for_truth(self, watch: RunMonitor, stop: asyncio.Event) -> Report | None:
        answers, statuses = await self._ask_all(watch, stop), self._supervisor.statuses
        state = watch.state.newest
        if "driver" not in answers and state is None:
            return None
        told_of_all = truth_in_health(watch.health.get("driver"))
        for answer in answers.values():
            told_of_all |= answer
        seen = Observed(
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
        return make_report(told_of_all, seen)  # the truth is the simulator's, wherever it runs

    def _record(self, name: str, record: Mapping[str, Any]) -> None:
        """Process a log record of a process."""
        self._log.add(record)
        event, level = record.get("event"), record.get("level")
        if event == "decision":
            decided = round(record["tick"] * TICK_S, 2), str(record["reason"])
            if self._decisions and self._decisions[-1][0] == decided[0]:
                self._decisions.pop()  # the last word of a tick counts
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

    def _why(self) -> str:
        """Return why the run has failed: the newest failure, of a lost process if there is one."""
        lost = [text for name, text in self._failures if name in self._supervisor.lost]
        return (lost or [text for _, text in self._failures] or [""])[-1]

    def _finish(self, report: Report | None, why: str, *, stopped: bool) -> int:
        if self._capacity.problem and self._live:
            print(self._capacity.problem, file=sys.stderr)
        if report:
            print(summary(report))
            files.write_result(report, self._options.report)
        for text in self._mismatches:
            print(f"warning: {text}", file=sys.stderr)
        closing = f"{why}; logs in {self._run_dir}" if why else f"logs in {self._run_dir}"
        if stopped and report is None:
            print("ended; the driver did not answer, so there is no report", file=sys.stderr)
        if stopped:
            if why:
                print(closing, file=sys.stderr)
            return 0
        if report and report.ok and not why:
            return 0
        if wrong := self._supervisor.misconfigured:
            raise ConfigError(self._refusals.get(wrong[0], why))
        if report is None:
            raise BodyLost(f"no report: {'' if why else 'the driver did not answer; '}{closing}")
        if self._last_fault:
            print(f"newest fault: {self._last_fault}", file=sys.stderr)
        if self._deployment.link == "real":
            print(RELEASE_FIRST, file=sys.stderr)
        print(closing, file=sys.stderr)
        return 1


def newest_fault(texts: Iterable[str]) -> str:
    """Return the driver's newest fault, else the newest of all: the likeliest reason."""
    newest = list(texts)[::-1]
    return next((text for text in newest if text.startswith("driver:")), "".join(newest[:1]))
