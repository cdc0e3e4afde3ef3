"""A group of processes that runs for one measurement, under the supervisor that `up` uses."""

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager
from typing import Any

import psutil

from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.config.settings import Endpoint
from gigabrain_zenoh.errors import ConfigError, GigabrainError
from gigabrain_zenoh.runtime.managed_process import ProcessSpec
from gigabrain_zenoh.runtime.supervisor import Supervisor

LOOK_S = 0.02
STOP_S = 1.5
ASK_S = 0.5
PATIENCE_S = 30.0  # longer than anything takes to start on a busy machine


class Group:
    """Processes that all have to stay alive, and what they say."""

    def __init__(self, specs: Sequence[ProcessSpec]) -> None:
        self.supervisor = Supervisor(specs, self._take)
        self.said: dict[str, Mapping[str, Any]] = {}  # newest record, by event
        self.ready_s = 0.0  # from the first start until all were ready
        self._began_s = asyncio.get_running_loop().time()
        self._fault = ""

    def _take(self, _name: str, record: Mapping[str, Any]) -> None:
        self.said[str(record["event"])] = record
        if record.get("level") in ("error", "critical") and not self._fault:
            self._fault = str(record.get("text", ""))
        if not self.ready_s and self.ready:
            self.ready_s = self.seconds

    @property
    def seconds(self) -> float:
        """Since the first start."""
        return asyncio.get_running_loop().time() - self._began_s

    @property
    def cpu_s(self) -> float:
        """CPU time that all processes have used so far."""
        pids = (status.pid for status in self.supervisor.statuses.values())
        return sum(cpu_s(pid) for pid in pids if pid)

    @property
    def ready(self) -> bool:
        """Whether all processes are ready."""
        return all(status.state == "ready" for status in self.supervisor.statuses.values())

    async def until(self, done: Callable[[], bool], within_s: float = PATIENCE_S) -> None:
        """Wait. Raises GigabrainError when a process dies, or when it takes too long."""
        try:
            async with asyncio.timeout(within_s):
                while not done():
                    await self.look()
        except TimeoutError:
            raise GigabrainError(f"nothing to measure within {within_s:g} s") from None

    async def go_on(self, seconds: float) -> None:
        """Let the processes run. Raises GigabrainError when one dies."""
        end_s = asyncio.get_running_loop().time() + seconds
        while asyncio.get_running_loop().time() < end_s:
            await self.look()

    async def look(self) -> None:
        """Wait a little. Raises GigabrainError when a process dies, and ConfigError."""
        await asyncio.sleep(LOOK_S)
        if self.supervisor.misconfigured:
            raise ConfigError(self._fault)
        if self.supervisor.deaths:
            raise GigabrainError(f"a process died while it was measured: {self._fault}")


def cpu_s(pid: int) -> float:
    """Return the CPU time that a process has used so far; 0 where there is none."""
    try:
        times = psutil.Process(pid).cpu_times()
    except psutil.Error:
        return 0.0
    return times.user + times.system


def rss_bytes(pid: int) -> int:
    """Return the memory that a process holds; 0 where there is none."""
    try:
        return psutil.Process(pid).memory_info().rss
    except psutil.Error:
        return 0


@asynccontextmanager
async def starting(specs: Sequence[ProcessSpec]) -> AsyncIterator[Group]:
    """Run `specs` while the block lasts, which begins with their start; none is left after it."""
    group = Group(specs)
    async with group.supervisor:
        work = asyncio.create_task(group.supervisor.run())
        try:
            yield group
        finally:
            await group.supervisor.stop(STOP_S)
            await work


@asynccontextmanager
async def running(
    specs: Sequence[ProcessSpec], within_s: float = PATIENCE_S
) -> AsyncIterator[Group]:
    """Run `specs` while the block lasts; all are ready when it begins, none is left after it."""
    async with starting(specs) as group:
        await group.until(lambda: group.ready, within_s)
        yield group


@asynccontextmanager
async def client(endpoint: Endpoint) -> AsyncIterator[Bus]:
    """A session of our own, which costs the others nothing until it listens to something."""
    bus = Bus(await ZenohTransport.open(endpoint), Clock(), "bench")
    try:
        yield bus
    finally:
        await bus.close()


async def driver_report(bus: Bus) -> dict[str, float | int | str | None]:
    """What the driver says of the run so far; empty while it does not answer."""
    answers = await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=ASK_S, name="driver")
    return dict(answers[0].report) if answers else {}
