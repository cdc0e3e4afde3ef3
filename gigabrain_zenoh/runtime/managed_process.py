"""One supervised process: its starts, its restarts after failures, and its end."""

import asyncio
import contextlib
import signal
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.runtime import heartbeat
from gigabrain_zenoh.runtime.child import Child, supervised_environment
from gigabrain_zenoh.runtime.fork_server import ForkRequest
from gigabrain_zenoh.runtime.forking import ForkServers


@dataclass(frozen=True)
class Backoff:
    """Pauses before restarts, and the number of deaths after which a process is given up."""

    first_s: float = 0.2
    factor: float = 2.0
    longest_s: float = 5.0
    deaths: int = 5  # given up after this many ...
    window_s: float = 60.0  # ... within this time
    reset_after_s: float = 10.0  # after this long ready, the next pause is `first_s` again


# own code: tenacity retries calls, and does not reset the pause after 10 s without failure
class RestartPolicy:
    """Decides when a process is restarted, and when it is given up."""

    def __init__(self, backoff: Backoff) -> None:
        self._backoff = backoff
        self._deaths: deque[float] = deque()
        self._next_s = backoff.first_s

    def died(self, now_s: float, up_s: float) -> float | None:
        """Return the pause before the next start [s], None to give up; `up_s` counts from ready."""
        backoff = self._backoff
        self._deaths.append(now_s)
        while now_s - self._deaths[0] > backoff.window_s:
            self._deaths.popleft()
        if len(self._deaths) >= backoff.deaths:
            return None
        delay_s = backoff.first_s if up_s >= backoff.reset_after_s else self._next_s
        self._next_s = min(delay_s * backoff.factor, backoff.longest_s)
        return delay_s


_STACK_PRINT_S = 0.2  # a stuck process has this long to print its stack

State = Literal["waiting", "starting", "ready", "backing off", "given up", "stopped"]
OnRecord = Callable[[str, Mapping[str, Any]], None]


@dataclass(frozen=True)
class ProcessSpec:
    """One process to keep running, and the processes that must be ready before it starts."""

    name: str
    argv: tuple[str, ...]  # other users can see them
    after: tuple[str, ...] = ()
    config: str = ""  # it reads this from its standard input; may hold passwords
    ready_timeout_s: float = 10.0
    stop_last: bool = False  # others need it for a clean end, as they need the router
    optional: bool = False  # the robot runs without it, also if its settings are wrong
    shows_stack: bool = False  # prints its stack on `this_process.STACK_SIGNAL`
    beats: bool = False  # reports progress once a second, and is killed without it
    fork: ForkRequest | None = None  # the same as `argv` and `config`, for a fork server


@dataclass
class ProcessStatus:
    """Current state of a process."""

    name: str
    pid: int | None = None
    state: State = "waiting"
    restarts: int = 0
    last_exit: int | None = None  # exit code, or minus the signal's number
    ready_after_s: float | None = None  # from its last start


@dataclass
class Shared:
    """State shared by all processes of one supervisor."""

    on_record: OnRecord
    backoff: Backoff
    keep_stuck: bool = False  # do not kill processes without progress, for a debugger
    fork_servers: ForkServers | None = None
    halt: asyncio.Event = field(default_factory=asyncio.Event)
    # held while a process is being started, so that a stop misses none
    starting: asyncio.Lock = field(default_factory=asyncio.Lock)


@dataclass(frozen=True)
class Death:
    """An unexpected end."""

    text: str  # "ended with exit code 1"
    code: int | None = None  # None: it could not even be started
    up_s: float = 0.0  # since it was ready
    hopeless: str = ""  # why a restart would fail the same way


class ManagedProcess:
    """One process, from its first start until the supervisor stops or gives it up."""

    def __init__(self, spec: ProcessSpec, shared: Shared) -> None:
        self.spec, self.status, self.deaths = spec, ProcessStatus(spec.name), 0
        self.child: Child | None = None
        # ready, given up or stopping: processes that start after this one stop waiting
        self.settled = asyncio.Event()
        self._shared, self._restarts = shared, RestartPolicy(shared.backoff)
        self._started_s, self._silence = 0.0, heartbeat.Silence()
        self.stuck = False  # runs without progress
        self.was_ready = False  # at least once, with the same configuration

    async def run(self, after: Sequence["ManagedProcess"]) -> None:
        """Start once all of `after` are ready, then keep running until the supervisor stops."""
        await self._wait_for(after)
        halt = self._shared.halt
        while not halt.is_set():
            death = await self._run_once()
            if halt.is_set():
                break
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._next_start_s(death)):
                    await halt.wait()
            self.status.restarts += not halt.is_set()
        if self.status.state != "given up":
            self.status.state = "stopped"

    async def _wait_for(self, after: Sequence["ManagedProcess"]) -> None:
        while waiting := [other for other in after if not other.settled.is_set()]:
            await waiting[0].settled.wait()
        lost = [other.spec.name for other in after if other.status.state == "given up"]
        if lost and not self._shared.halt.is_set():
            self._report("error", "not started", f"is not started without {lost[0]}")
            await self._shared.halt.wait()

    async def _run_once(self) -> Death:
        """Run the process from start to end."""
        loop, status = asyncio.get_running_loop(), self.status
        status.state, status.ready_after_s, self._started_s = "starting", None, loop.time()
        try:
            child = await self._start()
        except (FileNotFoundError, PermissionError) as error:
            return Death(f"could not be started ({error})", hopeless="it cannot run here")
        except OSError as error:  # no more processes or memory for now
            return Death(f"could not be started ({error})")
        if child is None:
            return Death("was not started")
        ready_timer = loop.call_later(self.spec.ready_timeout_s, self._kill_if_not_ready)
        try:
            code = await child.wait()
        finally:
            ready_timer.cancel()
        self.child = status.pid = None
        self.stuck, status.last_exit = False, code
        ready_after_s = status.ready_after_s
        up_s = 0.0 if ready_after_s is None else loop.time() - self._started_s - ready_after_s
        hopeless = "its settings are wrong" if self.misconfigured else ""
        return Death(f"ended with {_in_words(code)}", code, up_s, hopeless)

    @property
    def misconfigured(self) -> bool:
        """Return whether its configuration is wrong: exit code 2, and it was never ready."""
        return self.status.last_exit == ConfigError.exit_code and not self.was_ready

    async def _start(self) -> Child | None:
        spec, shared = self.spec, self._shared
        if spec.fork and shared.fork_servers:
            await shared.fork_servers.imported(spec.fork)
        async with shared.starting:
            if shared.halt.is_set():
                return None
            child = None
            if spec.fork and shared.fork_servers:
                child = await shared.fork_servers.start(spec.name, spec.fork, self._handle_record)
            if child is None:
                environment = supervised_environment()
                child = await Child.start(
                    spec.name, spec.argv, environment, self._handle_record, spec.config
                )
            self.child, self.status.pid = child, child.pid
            return child

    def check_progress(self, passed_s: float) -> None:
        """Kill a process without progress; called every `heartbeat.LOOK_S`, or later."""
        if not self.spec.beats or self.status.state != "ready" or self._shared.halt.is_set():
            return
        before, self.stuck = self.stuck, self._silence.add(passed_s)
        if self.stuck and not before and self.child:
            action = "is left alone" if self._shared.keep_stuck else "is killed"
            limit_s = heartbeat.STALL_S
            self._report("error", "stuck", f"has made no progress for {limit_s:g} s and {action}")
            if not self._shared.keep_stuck:
                self._kill_stuck(self.child)

    def _kill_stuck(self, child: Child) -> None:
        """Kill a process that hangs; if it can, it first prints its stack."""
        if not self.spec.shows_stack:
            child.send_signal(signal.SIGKILL)
            return
        child.show_stack()
        later = asyncio.get_running_loop().call_later
        later(_STACK_PRINT_S, child.send_signal, signal.SIGKILL)

    def _handle_record(self, record: dict[str, Any]) -> None:
        if record["event"] == heartbeat.EVENT:
            self._progressed()
            return
        if record["event"] == "ready" and self.status.state == "starting":
            self.status.state, self.was_ready = "ready", True
            self.status.ready_after_s = asyncio.get_running_loop().time() - self._started_s
            self._progressed()
            self.settled.set()
        self._shared.on_record(self.spec.name, record)

    def _progressed(self) -> None:
        self._silence.end()
        self.stuck = False

    def _kill_if_not_ready(self) -> None:
        if self.status.state == "starting" and self.child and not self._shared.halt.is_set():
            limit_s = self.spec.ready_timeout_s
            self._report("error", "not ready", f"was not ready within {limit_s:g} s and is killed")
            self.child.send_signal(signal.SIGKILL)

    def _next_start_s(self, death: Death) -> float | None:
        """Return the pause before the next start [s]; None to give up."""
        self.deaths += 1
        now_s, backoff = asyncio.get_running_loop().time(), self._shared.backoff
        delay_s = None if death.hopeless else self._restarts.died(now_s, death.up_s)
        if delay_s is not None:
            self.status.state = "backing off"
            self.settled.clear()
            self._report(
                "warning", "died", f"{death.text}; next start in {delay_s:g} s", death.code
            )
            return delay_s
        reason = death.hopeless or f"{backoff.deaths} deaths within {backoff.window_s:g} s"
        self.status.state = "given up"
        self.settled.set()
        self._report("error", "given up", f"{death.text} and is given up: {reason}", death.code)
        return None

    def _report(self, level: str, event: str, text: str, exit_code: int | None = None) -> None:
        name = self.spec.name
        record = {"t": time.time_ns(), "level": level, "process": "supervisor", "event": event}
        about = {"text": f"{name} {text}", "child": name, "exit_code": exit_code}
        self._shared.on_record(name, record | about)

    def ask_to_end(self) -> None:
        """Send SIGTERM to the process and its descendants."""
        if self.child:
            self.child.send_signal(signal.SIGTERM)

    def force_to_end(self) -> None:
        """Send SIGKILL to the process and its descendants, also if they are stopped."""
        if self.child:
            self._report("warning", "killed", "did not end when asked and is killed")
            self.child.send_signal(signal.SIGKILL)


def _in_words(code: int) -> str:
    """Return `exit code 1` or `signal 9 (Killed)`."""
    return f"exit code {code}" if code >= 0 else f"signal {-code} ({signal.strsignal(-code)})"
