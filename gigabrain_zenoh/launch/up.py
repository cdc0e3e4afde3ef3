"""Runs a deployment's processes on this host, logging to a run folder and to the console."""

import asyncio
import contextlib
import os
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self, TypeVar

from gigabrain_zenoh import logs
from gigabrain_zenoh.config.layers import Row
from gigabrain_zenoh.decision import behaviours
from gigabrain_zenoh.errors import BusError, ConfigError, DiskFull, NotYetValid
from gigabrain_zenoh.host.run_folders import new_run_dir, state_dir, state_locked
from gigabrain_zenoh.host.signals import stop_signals
from gigabrain_zenoh.launch.deployment import (
    Deployment,
    check_keys,
    local_endpoint,
    with_free_port,
)
from gigabrain_zenoh.launch.merging import write_rows
from gigabrain_zenoh.launch.own_processes import check_installed, unknown_to_router
from gigabrain_zenoh.launch.processes import PROCESSES
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.launch.supervisor_log import SupervisorLog
from gigabrain_zenoh.runtime.running import announced
from gigabrain_zenoh.runtime.supervisor import Supervisor

KEEP_ALIVE_SHARE = 0.4  # of the watchdog's timeout between two keep-alives


# own code: sdnotify 0.3.2 blocks, sends Latin-1, and does not hide NOTIFY_SOCKET from children
class Notifier:
    """Sends the state of this service to its manager. It ignores errors: the robot continues."""

    def __init__(
        self,
        address: str = "",
        watchdog_s: float | None = None,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._watchdog_s, self._now_s = watchdog_s, now_s
        self._fed_s: float | None = None  # time of the last keep-alive
        self._status, self._ready = "", False

    @classmethod
    def from_environment(cls) -> Self:
        """Create a notifier from the service manager's variables, and unset them."""
        address = os.environ.pop("NOTIFY_SOCKET", "")
        microseconds = os.environ.pop("WATCHDOG_USEC", "")
        watched_pid = os.environ.pop("WATCHDOG_PID", "") or str(os.getpid())
        watched = microseconds.isdecimal() and watched_pid == str(os.getpid())
        return cls(address, int(microseconds) / 1e6 if watched else None)

    def ready(self) -> None:
        """Report that the service is ready; sent only once."""
        if not self._ready:
            self._ready = True
            self._send("READY=1")

    def status(self, text: str) -> None:
        """Send a status line for people; sent only when it changes."""
        if text != self._status:
            self._status = text
            self._send(f"STATUS={text}")

    def alive(self) -> None:
        """Feed the watchdog, if one is configured and it is due.

        Call this while all processes make progress. Otherwise the service manager restarts the
        service.
        """
        now_s = self._now_s()
        if self._watchdog_s is None:
            return
        if self._fed_s is None or now_s - self._fed_s >= KEEP_ALIVE_SHARE * self._watchdog_s:
            self._fed_s = now_s
            self._send("WATCHDOG=1")

    def stopping(self) -> None:
        """Report that the service is stopping on request."""
        self._send("STOPPING=1")

    def _send(self, line: str) -> None:
        if not self._address:
            return
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as out:
            out.setblocking(False)
            out.sendto(line.encode(), self._address)


STOP_S = 1.5  # then processes that do not end are killed
LIMIT_S = STOP_S + 2.0  # then the supervisor itself is killed
CHECK_S = 0.1  # period of checks
RETRY_S = 1.0  # pause between checks of the clock or of disk space
ROUTERS = {"router", "relay"}  # without them no message is delivered on the host


async def up(
    deployment: Deployment,
    host: str,
    print_line: Callable[[str], None],
    level: str = "info",
    *,
    keep_stuck: bool = False,
    file: str = "",
    rows: Sequence[Row] = (),
) -> None:
    """Keep a host's processes running until Ctrl-C, also if some are given up.

    A process without progress is restarted, or with `keep_stuck` left for a debugger. `file` is the
    deployment file, for errors; `rows` are the settings and their sources, for `gigabrain config`.
    Raises ConfigError for wrong settings and for a folder that cannot be written, and BusError if
    the router cannot run.
    """
    notifier = Notifier.from_environment()
    await _check_keys(deployment, host, print_line, notifier)
    check_installed(deployment, host, file)
    if "decision" in deployment.hosts[host]:
        behaviours.check(deployment.decision)
    deployment = with_free_port(deployment)
    label = deployment.namespace or deployment.body.replace("/", "-")
    robot_dir = state_dir() / "robots" / label
    space = Waiting("space on the disk", DiskFull, print_line, notifier)
    with contextlib.ExitStack() as held:
        await space.until_done(lambda: held.enter_context(state_locked(robot_dir, label, host)))
        run_dir = await space.until_done(lambda: new_run_dir(None, label))
        write_rows(run_dir, rows)
        specs = process_specs(deployment, host, run_dir, robot_dir, level=level, file=file)
        names = ", ".join(spec.name for spec in specs)
        print_line(f"{deployment.body} on {host}: {names}; logs in {run_dir}")
        if unknown := unknown_to_router(deployment, host, PROCESSES):
            print_line(f"warning: {unknown}")
        stop = held.enter_context(stop_signals(LIMIT_S))
        note = held.enter_context(announced(label, local_endpoint(deployment, host), run_dir))
        records = _Records(run_dir, print_line)
        async with Supervisor(specs, records.add, keep_stuck=keep_stuck) as supervisor:
            await _supervise(supervisor, records, notifier, note, stop)


async def _supervise(
    supervisor: Supervisor, records: "_Records", notifier: Notifier, note: Path, stop: asyncio.Event
) -> None:
    """Run the processes until a signal, or until a restart cannot help."""
    running = asyncio.ensure_future(supervisor.run())
    while not stop.is_set() and not running.done() and not _hopeless(supervisor):
        _report(supervisor, notifier, note)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(stop.wait(), CHECK_S)
    stopped = stop.is_set()  # a later signal is not the reason for the end
    notifier.stopping()
    await supervisor.stop(STOP_S)
    await running
    records.close()
    if not stopped:
        records.check(supervisor)


async def _check_keys(
    deployment: Deployment, host: str, print_line: Callable[[str], None], notifier: Notifier
) -> None:
    """Check the keys of a host. Wait while they are not yet valid, as before the clock is set.

    Raises ConfigError.
    """
    waiting = Waiting("the clock to be set", NotYetValid, print_line, notifier)
    await waiting.until_done(lambda: check_keys(deployment, host))


T = TypeVar("T")


@dataclass(frozen=True)
class Waiting:
    """Retries an action that cannot succeed yet, and reports that once."""

    what: str
    error: type[ConfigError]
    print_line: Callable[[str], None]
    notifier: Notifier

    async def until_done(self, act: Callable[[], T]) -> T:
        """Call `act` until it no longer raises the error, and return its result."""
        printed = False
        while True:
            try:
                return act()
            except self.error as error:
                text = f"waiting for {self.what}: {error}"
            self.notifier.status(text)
            if not printed:
                self.print_line(text)
            printed = True
            await asyncio.sleep(RETRY_S)


class _Records:
    """Logs and prints the records of processes, and keeps the reasons of failed starts."""

    def __init__(self, run_dir: Path, print_line: Callable[[str], None]) -> None:
        self._log, self._print_line = SupervisorLog(run_dir), print_line
        # by process: text of the last failure, and the invalid value in it
        self._refusals: dict[str, tuple[str, str | None]] = {}

    def add(self, name: str, record: Mapping[str, Any]) -> None:
        """Process a record of a process."""
        self._log.add(record)
        if record.get("event") == "failed":
            record = dict(record)
            refusal = str(record.get("text", "")), record.pop("value", None)
            before, self._refusals[name] = self._refusals.get(name), refusal
            if refusal == before:  # already printed
                return
        self._print_line(logs.readable(record, colour=False))

    def check(self, supervisor: Supervisor) -> None:
        """Raise ConfigError for wrong settings of a process, and BusError for a lost router."""
        for name in _hopeless(supervisor)[:1]:
            text, value = self._refusals.get(name, (f"{name} cannot run; see its log", None))
            if name in supervisor.misconfigured:
                raise ConfigError(text, value=value)
            raise BusError(text)

    def close(self) -> None:
        """Write the queued records, and close the log."""
        self._log.close()


def _hopeless(supervisor: Supervisor) -> list[str]:
    """Return the processes given up that no restart can help: misconfigured ones and routers."""
    routers = [name for name in supervisor.given_up if name in ROUTERS]
    return [*supervisor.misconfigured, *routers]


def _report(supervisor: Supervisor, notifier: Notifier, note: Path) -> None:
    """Report the processes' state to the service manager.

    The note of a healthy robot is touched, so that its age shows its health without a manager.
    """
    states = {name: status.state for name, status in supervisor.statuses.items()}
    not_yet = [name for name, state in states.items() if state not in ("ready", "given up")]
    problems = {
        "given up": supervisor.given_up,
        "stuck": supervisor.stuck,
        "not ready": tuple(not_yet),
    }
    problem_texts = [f"{state}: {', '.join(names)}" for state, names in problems.items() if names]
    notifier.status("; ".join(problem_texts) or f"all ready: {', '.join(states)}")
    if not not_yet:
        notifier.ready()
    if not supervisor.stuck:
        notifier.alive()
    if not problem_texts:
        with contextlib.suppress(OSError):  # another process removed it
            os.utime(note)
