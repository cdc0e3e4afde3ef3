"""Runs the processes of one host: starts them in order of dependency, and stops them all."""

import asyncio
import contextlib
import graphlib
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Self

from gigabrain_zenoh import errors
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.runtime import forking, heartbeat
from gigabrain_zenoh.runtime.managed_process import (
    Backoff,
    ManagedProcess,
    OnRecord,
    ProcessSpec,
    ProcessStatus,
    Shared,
    State,
)

__all__ = ["Backoff", "OnRecord", "ProcessSpec", "ProcessStatus", "State", "Supervisor"]

# Fractions of the time limit of a stop. Where processes stop last, as the router does, the others
# are killed after _KILL_FIRST and no longer awaited after _LEAVE_FIRST.
_KILL_FIRST, _LEAVE_FIRST, _KILL_LAST = 0.55, 0.65, 0.85


class Supervisor:
    """Runs processes until stopped; used once. No process remains, also after an error."""

    def __init__(
        self,
        specs: Sequence[ProcessSpec],
        on_record: OnRecord,
        backoff: Backoff | None = None,
        *,
        keep_stuck: bool = False,
    ) -> None:
        _check(specs)
        self._shared = Shared(on_record, backoff or Backoff(), keep_stuck)
        forks = {spec.name: spec.fork for spec in specs if spec.fork}
        if len(forks) > 1 and forking.works_here():  # one process would share nothing
            self._shared.fork_servers = forking.ForkServers(forks, self._on_fork_failure)
        else:
            forking.end_early()
        self._processes = {spec.name: ManagedProcess(spec, self._shared) for spec in specs}
        self.statuses: Mapping[str, ProcessStatus] = {
            name: process.status for name, process in self._processes.items()
        }
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._stopping: asyncio.Task[None] | None = None

    @property
    def deaths(self) -> int:
        """Return how often processes ended unexpectedly."""
        return sum(process.deaths for process in self._processes.values())

    @property
    def given_up(self) -> tuple[str, ...]:
        """Return the names of processes that are no longer restarted."""
        return tuple(name for name, status in self.statuses.items() if status.state == "given up")

    @property
    def lost(self) -> tuple[str, ...]:
        """Return the names of processes given up that are not optional."""
        return tuple(name for name in self.given_up if not self._processes[name].spec.optional)

    @property
    def misconfigured(self) -> tuple[str, ...]:
        """Return the names of lost processes whose configuration is wrong."""
        return tuple(name for name in self.lost if self._processes[name].misconfigured)

    @property
    def stuck(self) -> tuple[str, ...]:
        """Return the names of processes that run without progress."""
        return tuple(name for name, process in self._processes.items() if process.stuck)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    async def run(self) -> None:
        """Keep all processes running until `stop()` or cancellation; either stops them all."""
        if self._shared.fork_servers:
            self._shared.fork_servers.open()
        self._tasks = {
            name: asyncio.create_task(process.run([self._processes[n] for n in process.spec.after]))
            for name, process in self._processes.items()
        }
        halted = asyncio.create_task(self._shared.halt.wait())
        watching = asyncio.create_task(self._watch())
        try:
            # a task ends only when all are stopped, or with an exception; it may never end if the
            # kernel does not release its process
            ends = [halted, watching, *self._tasks.values()]
            await asyncio.wait(ends, return_when="FIRST_COMPLETED")
        finally:
            try:
                await self.stop()
                await halted
                await watching
            finally:  # a second Ctrl-C may cancel the stop before it starts
                self._abandon()

    def _on_fork_failure(self, text: str) -> None:
        about = {"level": "warning", "process": "supervisor", "event": "fork server", "text": text}
        self._shared.on_record("supervisor", {"t": time.time_ns(), **about})

    async def _watch(self) -> None:
        """Check for processes without progress, until all are stopped."""
        loop, halt = asyncio.get_running_loop(), self._shared.halt
        checked_s = loop.time()
        while not halt.is_set():
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(heartbeat.LOOK_S):
                    await halt.wait()
            passed_s, checked_s = loop.time() - checked_s, loop.time()
            for process in self._processes.values():
                process.check_progress(passed_s)

    async def stop(self, within_s: float = 1.5) -> None:
        """Stop all processes within `within_s`: first by request, then by force."""
        if self._stopping is None:
            self._stopping = asyncio.create_task(self._stop(within_s))
        await asyncio.shield(self._stopping)

    async def _stop(self, within_s: float) -> None:
        begin_s, processes = asyncio.get_running_loop().time(), self._processes.values()
        self._shared.halt.set()
        for process in processes:
            process.settled.set()
        try:
            async with self._shared.starting:  # wait until a process being started has its pid
                running = [process for process in processes if process.child]
            last = [process for process in running if process.spec.stop_last]
            first = [process for process in running if not process.spec.stop_last]
            if last:
                kill_s, leave_s = (
                    begin_s + _KILL_FIRST * within_s,
                    begin_s + _LEAVE_FIRST * within_s,
                )
                await self._end(first, kill_s, leave_s)
            await self._end(last or first, begin_s + _KILL_LAST * within_s, begin_s + within_s)
            for task in self._tasks.values():
                if task.done():
                    task.result()
        finally:
            self._abandon()

    def _abandon(self) -> None:
        """Kill every process that still runs, without waiting for it."""
        if self._shared.fork_servers:
            self._shared.fork_servers.close()
        for name, process in self._processes.items():
            if process.child:
                process.child.abandon()
                self._tasks[name].cancel()

    async def _end(
        self, processes: Sequence[ManagedProcess], kill_s: float, leave_s: float
    ) -> None:
        """Request the end, kill at `kill_s`, and stop waiting at `leave_s` (both loop times)."""
        for process in processes:
            process.ask_to_end()
        await self._wait_for(processes, kill_s)
        for process in processes:
            process.force_to_end()
        await self._wait_for(processes, leave_s)

    async def _wait_for(self, processes: Sequence[ManagedProcess], until_s: float) -> None:
        tasks = [self._tasks[process.spec.name] for process in processes]
        if tasks:
            left_s = until_s - asyncio.get_running_loop().time()
            await asyncio.wait(tasks, timeout=max(left_s, 0.0))


def _check(specs: Sequence[ProcessSpec]) -> None:
    """Raise an error for duplicate names, unknown names in `after`, and circular dependencies."""
    after = {spec.name: spec.after for spec in specs}
    for name, times in Counter(spec.name for spec in specs).items():
        if times > 1:
            raise ConfigError(f"{times} processes are called {name!r}; expected one")
    for others in after.values():
        for other in others:
            if other not in after:
                raise errors.unknown("process", other, after)
    try:
        graphlib.TopologicalSorter(after).prepare()
    except graphlib.CycleError as error:
        circle = " after ".join(reversed(error.args[1]))
        raise ConfigError(f"no process can be first: {circle}; expected an order") from None
