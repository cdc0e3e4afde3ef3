"""One supervised process: its child process, its restarts after failures, and its end."""

import asyncio
import contextlib
import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, cast

import msgspec

from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.host.terminal import LineSplitter
from gigabrain_zenoh.runtime import heartbeat


@dataclass(frozen=True)
class Backoff:
    """Pauses after a death, and the number of deaths at which a process is given up."""

    first_s: float = 0.2
    factor: float = 2.0
    longest_s: float = 5.0
    deaths: int = 5  # this many ...
    window_s: float = 60.0  # ... within this time, and it is given up
    reset_after_s: float = 10.0  # up this long, and the next wait is the first again


# own code: tenacity retries a call; a process that ran well for 10 s begins at 0.2 s again
class RestartPolicy:
    """Decides when one process is started again, and when it is given up."""

    def __init__(self, backoff: Backoff) -> None:
        self._backoff = backoff
        self._deaths: deque[float] = deque()
        self._next_s = backoff.first_s

    def died(self, now_s: float, up_s: float) -> float | None:
        """Return the seconds before the next start, None to give up; `up_s` is since ready."""
        backoff = self._backoff
        self._deaths.append(now_s)
        while now_s - self._deaths[0] > backoff.window_s:
            self._deaths.popleft()
        if len(self._deaths) >= backoff.deaths:
            return None
        delay_s = backoff.first_s if up_s >= backoff.reset_after_s else self._next_s
        self._next_s = min(delay_s * backoff.factor, backoff.longest_s)
        return delay_s


_DRAIN_S = 0.2  # what a dead child has written arrives at once; someone else may hold its pipe
_STACK_S = 0.2  # how long a stuck process has to print where it is
_REAP_S = 0.2  # a killed process ends at once, unless the kernel waits for a device


def as_record(line: bytes, process: str) -> dict[str, Any]:
    """Return the log record in a line of output; other lines become the text of a record."""
    known = {"t": time.time_ns(), "level": "info", "process": process, "event": "output"}
    with contextlib.suppress(msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        found = msgspec.json.decode(line)
        if isinstance(found, dict) and isinstance(found.get("event"), str):
            fit = {k: v for k, v in found.items() if type(v) is type(known.get(k, v))}
            return known | fit
    return known | {"level": "error", "text": line.decode(errors="replace").rstrip()}


class Child(asyncio.SubprocessProtocol):
    """A running process. Its pipes are always drained, whatever comes out of them."""

    def __init__(self, name: str, on_record: Callable[[dict[str, Any]], None]) -> None:
        self._name, self._on_record = name, on_record
        self._lines = {1: LineSplitter(), 2: LineSplitter()}
        self._ended, self._drained = asyncio.Event(), asyncio.Event()
        self._transport: asyncio.SubprocessTransport | None = None
        self.pid = 0

    @classmethod
    async def start(
        cls,
        name: str,
        argv: Sequence[str],
        env: Mapping[str, str],
        on_record: Callable[[dict[str, Any]], None],
    ) -> "Child":
        """Start a process; raises OSError when that cannot be done."""
        _, child = await asyncio.get_running_loop().subprocess_exec(
            lambda: cls(name, on_record),
            *argv,
            stdin=subprocess.DEVNULL,
            env=dict(env),
            start_new_session=True,  # a terminal's Ctrl-C is for the supervisor alone
        )
        return child

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Note that the process runs and its pipes are open (asyncio calls this)."""
        self._transport = cast(asyncio.SubprocessTransport, transport)
        self.pid = self._transport.get_pid()

    def pipe_data_received(self, fd: int, data: bytes) -> None:
        """Split output into records (asyncio calls this)."""
        for line in self._lines[fd].feed(data):
            self._on_record(as_record(line, self._name))

    def pipe_connection_lost(self, fd: int, exc: Exception | None) -> None:
        """Handle the end of output on `fd` (asyncio calls this)."""
        if rest := self._lines.pop(fd).end():
            self._on_record(as_record(rest, self._name))
        if not self._lines:
            self._drained.set()

    def process_exited(self) -> None:
        """Kill what the process has started, once it is reaped (asyncio calls this)."""
        self._signal_group(signal.SIGKILL)  # and all that it has started
        self._ended.set()

    def send_signal(self, number: int) -> None:
        """Send a signal to the process and all that it has started, unless it has ended."""
        if not self._ended.is_set():
            self._signal_group(number)

    def show_stack(self) -> None:
        """Have the process print where it is; see `this_process.show_stack_on_request`."""
        if this_process.STACK_SIGNAL and not self._ended.is_set():
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(self.pid, this_process.STACK_SIGNAL)

    def _signal_group(self, number: int) -> None:
        # macOS answers EPERM where Linux answers ESRCH for a group that is gone
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.pid, number)

    async def wait(self) -> int:
        """Wait for its end and last output; return the exit code, or minus the signal's number."""
        await self._ended.wait()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_DRAIN_S):
                await self._drained.wait()
        transport = cast(asyncio.SubprocessTransport, self._transport)
        transport.close()
        return cast(int, transport.get_returncode())

    def abandon(self) -> None:
        """Kill and reap it without the event loop, which is being torn down."""
        self.send_signal(signal.SIGKILL)
        if self._transport:
            if process := self._transport.get_extra_info("subprocess"):  # uvloop has none
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_REAP_S)
            self._transport.close()


State = Literal["waiting", "starting", "ready", "backing off", "given up", "stopped"]
OnRecord = Callable[[str, Mapping[str, Any]], None]


@dataclass(frozen=True)
class ProcessSpec:
    """One process to keep running: what to run, and after which others are ready."""

    name: str
    argv: tuple[str, ...]
    after: tuple[str, ...] = ()
    ready_timeout_s: float = 10.0
    stop_last: bool = False  # what the others need in order to end well, such as the router
    optional: bool = False  # the robot goes on without it, also where its settings are wrong
    shows_stack: bool = False  # prints where it is on `this_process.STACK_SIGNAL`
    beats: bool = False  # reports progress once a second, and is killed without it


@dataclass
class ProcessStatus:
    """State of a process now."""

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
    keep_stuck: bool = False  # processes without progress are left alone, for a debugger
    halt: asyncio.Event = field(default_factory=asyncio.Event)
    # held while a process is being started, so that a stop misses none
    starting: asyncio.Lock = field(default_factory=asyncio.Lock)


@dataclass(frozen=True)
class Death:
    """An unexpected end."""

    text: str  # "ended with exit code 1"
    code: int | None = None  # None: it could not even be started
    up_s: float = 0.0  # since it was ready
    hopeless: str = ""  # why trying again would end the same way


class ManagedProcess:
    """One process, from its first start until the supervisor stops or gives it up."""

    def __init__(self, spec: ProcessSpec, shared: Shared) -> None:
        self.spec, self.status, self.deaths = spec, ProcessStatus(spec.name), 0
        self.child: Child | None = None
        # ready, given up or stopping: processes after this one need not wait any longer
        self.settled = asyncio.Event()
        self._shared, self._patience = shared, RestartPolicy(shared.backoff)
        self._started_s, self._silence = 0.0, heartbeat.Silence()
        self.stuck = False  # it runs and makes no progress

    async def run(self, after: Sequence["ManagedProcess"]) -> None:
        """Start once all of `after` are ready, then keep running until the supervisor stops."""
        await self._wait_for(after)
        halt = self._shared.halt
        while not halt.is_set():
            death = await self._live()
            if halt.is_set():
                break
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._judge(death)):
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

    async def _live(self) -> Death:
        """Run the process once, from start to end."""
        loop, status = asyncio.get_running_loop(), self.status
        status.state, status.ready_after_s, self._started_s = "starting", None, loop.time()
        try:
            child = await self._start()
        except (FileNotFoundError, PermissionError) as error:
            return Death(f"could not be started ({error})", hopeless="it cannot run here")
        except OSError as error:  # out of processes or memory: that may pass
            return Death(f"could not be started ({error})")
        if child is None:
            return Death("was not started")
        late = loop.call_later(self.spec.ready_timeout_s, self._late)
        try:
            code = await child.wait()
        finally:
            late.cancel()
        self.child = status.pid = None
        self.stuck, status.last_exit = False, code
        ready_after_s = status.ready_after_s
        up_s = 0.0 if ready_after_s is None else loop.time() - self._started_s - ready_after_s
        bad = "what it was given is wrong" if code == ConfigError.exit_code else ""
        return Death(f"ended with {_in_words(code)}", code, up_s, bad)

    async def _start(self) -> Child | None:
        ours = {this_process.SUPERVISOR_VARIABLE: str(os.getpid()), "PYTHONUNBUFFERED": "1"}
        async with self._shared.starting:
            if self._shared.halt.is_set():
                return None
            self.child = await Child.start(
                self.spec.name, self.spec.argv, os.environ | ours, self._handle_record
            )
            self.status.pid = self.child.pid
            return self.child

    def check_progress(self, passed_s: float) -> None:
        """Kill a process without progress; called every `heartbeat.LOOK_S`, or later."""
        if not self.spec.beats or self.status.state != "ready" or self._shared.halt.is_set():
            return
        before, self.stuck = self.stuck, self._silence.add(passed_s)
        if self.stuck and not before and self.child:
            what = "is left alone" if self._shared.keep_stuck else "is killed"
            limit_s = heartbeat.STALL_S
            self._report("error", "stuck", f"has made no progress for {limit_s:g} s and {what}")
            if not self._shared.keep_stuck:
                self._kill_stuck(self.child)

    def _kill_stuck(self, child: Child) -> None:
        """Kill a process that hangs; it first prints where."""
        if not self.spec.shows_stack:
            child.send_signal(signal.SIGKILL)
            return
        child.show_stack()
        later = asyncio.get_running_loop().call_later
        later(_STACK_S, child.send_signal, signal.SIGKILL)

    def _handle_record(self, record: dict[str, Any]) -> None:
        if record["event"] == heartbeat.EVENT:
            self._progressed()
            return
        if record["event"] == "ready" and self.status.state == "starting":
            self.status.state = "ready"
            self.status.ready_after_s = asyncio.get_running_loop().time() - self._started_s
            self._progressed()
            self.settled.set()
        self._shared.on_record(self.spec.name, record)

    def _progressed(self) -> None:
        self._silence.end()
        self.stuck = False

    def _late(self) -> None:
        if self.status.state == "starting" and self.child and not self._shared.halt.is_set():
            limit_s = self.spec.ready_timeout_s
            self._report("error", "not ready", f"was not ready within {limit_s:g} s and is killed")
            self.child.send_signal(signal.SIGKILL)

    def _judge(self, death: Death) -> float | None:
        """Return the seconds until the next start; None to give up."""
        self.deaths += 1
        now_s, backoff = asyncio.get_running_loop().time(), self._shared.backoff
        delay_s = None if death.hopeless else self._patience.died(now_s, death.up_s)
        if delay_s is not None:
            self.status.state = "backing off"
            self.settled.clear()
            self._report(
                "warning", "died", f"{death.text}; next start in {delay_s:g} s", death.code
            )
            return delay_s
        why = death.hopeless or f"{backoff.deaths} deaths within {backoff.window_s:g} s"
        self.status.state = "given up"
        self.settled.set()
        self._report("error", "given up", f"{death.text} and is given up: {why}", death.code)
        return None

    def _report(self, level: str, event: str, text: str, exit_code: int | None = None) -> None:
        name = self.spec.name
        record = {"t": time.time_ns(), "level": level, "process": "supervisor", "event": event}
        about = {"text": f"{name} {text}", "child": name, "exit_code": exit_code}
        self._shared.on_record(name, record | about)

    def ask_to_end(self) -> None:
        """Send SIGTERM to the process and all that it has started."""
        if self.child:
            self.child.send_signal(signal.SIGTERM)

    def force_to_end(self) -> None:
        """Send SIGKILL, which also ends a process that is stopped."""
        if self.child:
            self._report("warning", "killed", "did not end when asked and is killed")
            self.child.send_signal(signal.SIGKILL)


def _in_words(code: int) -> str:
    """Return `exit code 1` or `signal 9 (Killed)`."""
    return f"exit code {code}" if code >= 0 else f"signal {-code} ({signal.strsignal(-code)})"
