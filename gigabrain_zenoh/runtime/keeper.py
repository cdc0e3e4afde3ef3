"""Keeps one process running: starts it when others are ready, restarts it, gives it up."""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from gigabrain_zenoh.bus import heartbeat
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.host import lifeline
from gigabrain_zenoh.host.backoff import Backoff, Patience
from gigabrain_zenoh.host.child import Child

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
    beats: bool = False  # says once a second that it makes progress, and is killed when it does not


@dataclass
class ProcessStatus:
    """How a process is doing now."""

    name: str
    pid: int | None = None
    state: State = "waiting"
    restarts: int = 0
    last_exit: int | None = None  # exit code, or minus the signal's number
    ready_after_s: float | None = None  # from its last start


@dataclass
class Shared:
    """What the keepers of one supervisor have in common."""

    on_record: OnRecord
    backoff: Backoff
    keep_stuck: bool = False  # processes without progress are left alone, for a debugger
    halt: asyncio.Event = field(default_factory=asyncio.Event)
    # held while a process is being started, so that a stop misses none
    starting: asyncio.Lock = field(default_factory=asyncio.Lock)


@dataclass(frozen=True)
class Death:
    """An end that nobody asked for."""

    text: str  # "ended with exit code 1"
    code: int | None = None  # None: it could not even be started
    up_s: float = 0.0  # since it was ready
    hopeless: str = ""  # why trying again would end the same way


class Keeper:
    """One process, from its first start until the supervisor stops or gives it up."""

    def __init__(self, spec: ProcessSpec, shared: Shared) -> None:
        self.spec, self.status, self.deaths = spec, ProcessStatus(spec.name), 0
        self.child: Child | None = None
        # ready, given up or stopping: whoever comes after this one need not wait any longer
        self.settled = asyncio.Event()
        self._shared, self._patience = shared, Patience(shared.backoff)
        self._started_s, self._silence = 0.0, heartbeat.Silence()
        self.stuck = False  # it runs and makes no progress

    async def run(self, after: Sequence["Keeper"]) -> None:
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

    async def _wait_for(self, after: Sequence["Keeper"]) -> None:
        while waiting := [other for other in after if not other.settled.is_set()]:
            await waiting[0].settled.wait()
        lost = [other.spec.name for other in after if other.status.state == "given up"]
        if lost and not self._shared.halt.is_set():
            self._say("error", "not started", f"is not started without {lost[0]}")
            await self._shared.halt.wait()

    async def _live(self) -> Death:
        """One life, from start to end."""
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
        ours = {lifeline.VARIABLE: str(os.getpid()), "PYTHONUNBUFFERED": "1"}
        async with self._shared.starting:
            if self._shared.halt.is_set():
                return None
            self.child = await Child.start(
                self.spec.name, self.spec.argv, os.environ | ours, self._take
            )
            self.status.pid = self.child.pid
            return self.child

    def look(self, passed_s: float) -> None:
        """Kill a process without progress; called every `heartbeat.LOOK_S`, or later."""
        if not self.spec.beats or self.status.state != "ready" or self._shared.halt.is_set():
            return
        before, self.stuck = self.stuck, self._silence.look(passed_s)
        if self.stuck and not before and self.child:
            what = "is left alone" if self._shared.keep_stuck else "is killed"
            limit_s = heartbeat.STALL_S
            self._say("error", "stuck", f"has made no progress for {limit_s:g} s and {what}")
            if not self._shared.keep_stuck:
                self.child.send_signal(signal.SIGKILL)

    def _take(self, record: dict[str, Any]) -> None:
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
            self._say("error", "not ready", f"was not ready within {limit_s:g} s and is killed")
            self.child.send_signal(signal.SIGKILL)

    def _judge(self, death: Death) -> float | None:
        """Seconds until the next start; None when there will be none."""
        self.deaths += 1
        now_s, backoff = asyncio.get_running_loop().time(), self._shared.backoff
        delay_s = None if death.hopeless else self._patience.died(now_s, death.up_s)
        if delay_s is not None:
            self.status.state = "backing off"
            self.settled.clear()
            self._say("warning", "died", f"{death.text}; next start in {delay_s:g} s", death.code)
            return delay_s
        why = death.hopeless or f"{backoff.deaths} deaths within {backoff.window_s:g} s"
        self.status.state = "given up"
        self.settled.set()
        self._say("error", "given up", f"{death.text} and is given up: {why}", death.code)
        return None

    def _say(self, level: str, event: str, text: str, exit_code: int | None = None) -> None:
        name = self.spec.name
        record = {"t": time.time_ns(), "level": level, "process": "supervisor", "event": event}
        about = {"text": f"{name} {text}", "child": name, "exit_code": exit_code}
        self._shared.on_record(name, record | about)

    def ask_to_end(self) -> None:
        """SIGTERM to the process and what it has started."""
        if self.child:
            self.child.send_signal(signal.SIGTERM)

    def force_to_end(self) -> None:
        """SIGKILL where SIGTERM was not enough; also ends a process that is stopped."""
        if self.child:
            self._say("warning", "killed", "did not end when asked and is killed")
            self.child.send_signal(signal.SIGKILL)


def _in_words(code: int) -> str:
    """`exit code 1`, `signal 9 (Killed)`."""
    return f"exit code {code}" if code >= 0 else f"signal {-code} ({signal.strsignal(-code)})"
