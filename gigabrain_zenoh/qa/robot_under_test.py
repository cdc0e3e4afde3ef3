"""Boots robots for faults and benchmarks: groups of processes, and a whole robot with a probe."""

import asyncio
import contextlib
import os
import signal
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import msgspec
import psutil

from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.robot import Robot
from gigabrain_zenoh.config.settings import Endpoint, ProcessConfig
from gigabrain_zenoh.decision.behaviours import needs_map
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.launch.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.judging import Failed
from gigabrain_zenoh.qa.probe import Probe, probing, until
from gigabrain_zenoh.runtime.connect import connect
from gigabrain_zenoh.runtime.managed_process import Backoff, ProcessSpec
from gigabrain_zenoh.runtime.supervisor import Supervisor

LOOPBACK = "tcp/127.0.0.1:0"
Change = Callable[[list[ProcessSpec]], list[ProcessSpec]]
# restart a process after each of its many kills; another test checks giving up
NEVER_GIVE_UP = Backoff(factor=1.0, deaths=10_000)
FAULTS_FILE = "faults.json"  # read by the emulator's process
STOP_S = 1.5
BENCH_START_S = 30.0  # longer than any start on a busy machine
START_S = 300.0  # far longer than compiling a navigating robot's kernels
ASK_S = 0.5
PROMPT_S = 0.005  # age limit of a prompt answer
POLL_S = 0.02
# largest turn rate that counts as straight, and least share of the speed that counts as full
STRAIGHT_RAD_S, FULL_SPEED = 0.1, 0.96
STRAIGHT_ON_ROUTE_RAD_S, FULL_SPEED_ON_ROUTE = 0.3, 0.6  # routes bend; a busy host drives slower


class ProcessGroup:
    """Processes under the supervisor that `up` uses. Use it in `async with`.

    With `strict`, any death of a process ends the measurement.
    """

    def __init__(
        self, specs: Sequence[ProcessSpec], backoff: Backoff | None = None,
        *, strict: bool = True, keep_stuck: bool = False,
    ) -> None:  # fmt: skip
        self.supervisor = Supervisor(
            specs, self._record, backoff or Backoff(), keep_stuck=keep_stuck
        )
        self.records: list[Mapping[str, Any]] = []  # log records of all processes
        self.ready_s = 0.0  # from the first start until all are ready
        self._strict = strict
        self._begin_s = 0.0
        self._running: asyncio.Task[None] | None = None
        self._stack = AsyncExitStack()

    async def __aenter__(self) -> Self:
        self._begin_s = asyncio.get_running_loop().time()
        await self._stack.enter_async_context(self.supervisor)
        self._running = asyncio.create_task(self.supervisor.run())
        self._stack.push_async_callback(self._end)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def _end(self) -> None:
        await self.supervisor.stop(STOP_S)
        if self._running:
            await self._running

    def _record(self, _name: str, record: Mapping[str, Any]) -> None:
        self.records.append(record)
        if not self.ready_s and self.ready:
            self.ready_s = self.seconds

    @property
    def seconds(self) -> float:
        """Time since the first start [s]."""
        return asyncio.get_running_loop().time() - self._begin_s

    @property
    def pids(self) -> dict[str, int]:
        """Pids of all running processes, by name."""
        return {name: one.pid for name, one in self.supervisor.statuses.items() if one.pid}

    @property
    def cpu_s(self) -> float:
        """CPU time of all processes so far [s]."""
        used = 0.0
        for pid in self.pids.values():
            with contextlib.suppress(psutil.Error):
                times = psutil.Process(pid).cpu_times()
                used += times.user + times.system
        return used

    @property
    def ready(self) -> bool:
        """True while all processes are ready."""
        return all(status.state == "ready" for status in self.supervisor.statuses.values())

    def check_processes(self) -> None:
        """Raise ConfigError for a refused configuration, Failed for a dead process."""
        if wrong := self.supervisor.misconfigured:
            raise ConfigError(self._complaint(wrong) or "a process refuses its configuration")
        if self.supervisor.given_up:
            raise Failed(f"{', '.join(self.supervisor.given_up)} cannot be started")
        if self._strict and self.supervisor.deaths:
            reason = self._complaint(self.supervisor.statuses)
            raise Failed(f"a process died during the measurement: {reason}")

    def _complaint(self, names: Collection[str]) -> str:
        """Return the error text of these processes; empty if there is none."""
        records = [r for r in self.records if r.get("child", r["process"]) in names]
        failed = [r for r in records if r.get("event") == "failed"]
        errors = [r for r in records if r.get("level") in ("error", "critical")]
        return str((failed[-1:] or errors[:1] or [{}])[0].get("text", ""))

    async def until(
        self, done: Callable[[], bool], what: str, within_s: float = BENCH_START_S
    ) -> None:
        """Wait for `done`. Raises Failed when a process dies or time is up, and ConfigError."""

        def checked() -> bool:
            self.check_processes()
            return done()

        await until(checked, what, within_s)

    async def until_ready(self, within_s: float = START_S) -> None:
        """Wait until every process is ready. Raises like `until`."""
        await self.until(lambda: self.ready, "all processes are ready", within_s)

    async def poll(self) -> None:
        """Wait 20 ms. Raises like `until`."""
        await asyncio.sleep(POLL_S)
        self.check_processes()

    async def run_for(self, seconds: float) -> None:
        """Let the processes run. Raises like `until`."""
        end_s = asyncio.get_running_loop().time() + seconds
        while asyncio.get_running_loop().time() < end_s:
            await self.poll()


@asynccontextmanager
async def client(endpoint: Endpoint) -> AsyncIterator[Bus]:
    """Open a session; it does not load the robot until it subscribes to a topic."""
    async with connect(endpoint, "bench", timeout_s=None) as bus:
        yield bus


@asynccontextmanager
async def measured_robot(
    deployment: Deployment, folder: Path | None = None, ready_s: float | None = BENCH_START_S
) -> AsyncIterator[tuple[ProcessGroup, Bus]]:
    """Run a deployment for a benchmark; yield when all processes are ready within `ready_s`.

    If `ready_s` is None, yield right after the start. At the end, all processes end.
    """
    deployment = with_free_port(deployment)
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as temporary:
        folder = folder or Path(temporary)
        specs = process_specs(deployment, "robot", folder, folder / "state")
        async with ProcessGroup(specs) as group:
            if ready_s is not None:
                await group.until_ready(ready_s)
            async with client(client_endpoint(deployment)) as bus:
                yield group, bus


async def report_of(bus: Bus, process: str = "driver") -> dict[str, float | int | str | None]:
    """Return the report of a process; empty while it does not answer."""
    answers = await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=ASK_S, name=process)
    return dict(answers[0].report) if answers else {}


class RobotUnderTest(ProcessGroup):
    """A whole robot with a probe on its bus. Use it in `async with`, or call `close`."""

    probe: Probe
    operator: Robot

    def __init__(
        self, deployment: Deployment, folder: Path, change: Change | None = None,
        backoff: Backoff = NEVER_GIVE_UP, *, keep_stuck: bool = True,
    ) -> None:  # fmt: skip
        self.deployment, self.folder = with_free_port(deployment), folder
        specs = process_specs(self.deployment, "robot", folder / "run", folder / "state")
        # keep frozen processes: the test thaws them, unless it tests the restart
        super().__init__(
            change(specs) if change else specs, backoff, strict=False, keep_stuck=keep_stuck
        )
        self._frozen: set[int] = set()
        self._faulty = False
        self._contacts = 0
        self._judged = 0  # records that `check` has judged

    async def __aenter__(self) -> Self:
        try:
            await super().__aenter__()
            await self.until_ready()
            operator = client_endpoint(self.deployment, "operator")
            self.probe = await self._stack.enter_async_context(probing(operator, "suite"))
            self.operator = Robot(self.probe.bus)
        except BaseException:
            await self.close()
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End all processes. Further calls do nothing."""
        self.thaw()
        await self._stack.aclose()

    @property
    def reusable(self) -> bool:
        """True if another test can use this robot."""
        return bool(self._running and not (self.supervisor.given_up or self._running.done()))

    @property
    def endpoint(self) -> Endpoint:
        """The endpoint of a client without keys."""
        return client_endpoint(self.deployment)

    @property
    def ports(self) -> Path:
        """The folder of an emulated body's ports."""
        return self.folder / "run" / "ports"

    def ready_pids(self) -> list[int]:
        """Return the pids of all ready processes."""
        statuses = self.supervisor.statuses.values()
        return [status.pid for status in statuses if status.pid and status.state == "ready"]

    def pid(self, name: str) -> int:
        """Return the pid of a process. Raises Failed when it does not run."""
        pid = self.supervisor.statuses[name].pid
        if pid is None:
            raise Failed(f"{name} does not run")
        return pid

    def signal(self, name: str, number: signal.Signals) -> int:
        """Send a signal to a process, and return its pid. Raises Failed if it died by itself."""
        pid = self.pid(name)
        try:
            os.kill(pid, number)
        except ProcessLookupError:
            raise Failed(f"{name} has died by itself") from None
        return pid

    def kill(self, name: str) -> int:
        """Send SIGKILL, and return the pid."""
        return self.signal(name, signal.SIGKILL)

    def freeze(self, name: str) -> None:
        """Send SIGSTOP; the process is stopped until `thaw` or the end of the test."""
        self._frozen.add(self.signal(name, signal.SIGSTOP))

    def thaw(self) -> None:
        """Send SIGCONT to all frozen processes that still run."""
        for pid in self._frozen & set(self.pids.values()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._frozen.clear()

    async def until_restarted(self, name: str, pid: int) -> None:
        """Wait until the process is ready with another pid."""
        status = self.supervisor.statuses[name]
        await until(
            lambda: status.state == "ready" and status.pid != pid, f"{name}'s restart", START_S
        )

    async def kill_and_restart(self, name: str) -> None:
        """Send SIGKILL, and wait until the supervisor has restarted the process."""
        await self.until_restarted(name, self.kill(name))

    async def break_body(self, **faults: Mapping[str, Any]) -> None:
        """Set the faults of an emulated body, by station; wait until the emulator applies them."""
        path, begin = self.ports / FAULTS_FILE, len(self.records)
        fresh = path.with_suffix(".new")
        fresh.write_bytes(msgspec.json.encode(faults))
        fresh.replace(path)
        self._faulty = bool(faults)

        def applied() -> bool:
            texts = (str(record.get("text", "")) for record in self.records[begin:])
            logged = [text for text in texts if text.startswith("faults: ")]
            return bool(logged) and (logged[-1] == "faults: none") != bool(faults)

        await until(applied, "the emulator applies its faults")

    async def truth(self) -> dict[str, Any]:
        """Return the true values of the physics: contacts, distance_m, true_speed and more."""
        source = "emulator" if self.deployment.link == "emulated" else "driver"
        return dict((await self.probe.describe(source)).report)

    async def prompt_truth(self) -> dict[str, Any]:
        """Return true values that are at most 5 ms old, if the machine is fast enough."""
        for _ in range(50):
            begin_s = time.monotonic()
            truth = await self.truth()
            if time.monotonic() - begin_s < PROMPT_S:
                break
        return truth

    async def travelled(self) -> float:
        """Return the true length of the body's path so far [m]."""
        return float((await self.truth())["distance_m"])

    async def travel_within(self, ticks: int) -> float:
        """Return the true length of the body's path within `ticks` [m]."""
        before_m = await self.travelled()
        await self.probe.ticks(ticks)
        return await self.travelled() - before_m

    async def wait_simulated(self, seconds: float) -> dict[str, Any]:
        """Wait `seconds` of an emulated body's time; return the true values at the end."""
        truth = await self.truth()
        end_s = float(truth["sim_seconds"]) + seconds
        while float(truth["sim_seconds"]) < end_s:
            await asyncio.sleep(0.02)
            truth = await self.truth()
        return truth

    async def until_driving(self, room: float = 1.3, share: float = 1.0) -> None:
        """Enable the brain like a person, and wait until it drives straight at full speed.

        `share` of that speed is enough if the gate slows the robot down.
        """
        probe, decision = self.probe, self.deployment.decision
        await self.release()
        await until(lambda: probe.bodies.current, "robot/body")
        body = probe.bodies.current
        fastest = body.description.max_linear_speed if body else 0.0
        straight, full = STRAIGHT_RAD_S, FULL_SPEED
        if needs_map(decision.behaviour):
            straight, full = STRAIGHT_ON_ROUTE_RAD_S, FULL_SPEED_ON_ROUTE
        speed = share * full * min(decision.settings["max_linear_speed"], fastest)
        await probe.driving_straight(speed, room, straight, by_hand=True)

    async def release(self) -> None:
        """Release a latched gate like a person; repeat until it agrees."""
        probe = self.probe
        while probe.state.gate.mode == "latched":
            try:
                await self.operator.release()
            except Refused:
                await probe.ticks(5)
            else:
                await until(lambda: probe.state.gate.mode != "latched", "released")

    async def settle(self) -> None:
        """Wait until all processes are ready, the body answers and the gate is released."""
        self.thaw()
        if self._faulty:
            await self.break_body()
        await self.until_ready()
        boot = self.probe.state.boot
        await until(lambda: self.probe.state.link.connected, "the body answers")
        if self.probe.state.boot == boot:
            await self.release()
        self._contacts = int((await self.truth())["contacts"])
        self._judged = len(self.records)

    async def check(self) -> None:
        """Raise Failed for a new contact, or for a process that died by itself."""
        contacts = int((await self.truth())["contacts"])
        if contacts > self._contacts:
            raise Failed(f"{contacts - self._contacts} contacts")
        for record in self.records[self._judged :]:
            if record.get("level") == "critical":
                raise Failed(f"{record.get('process')}: {record.get('text')}")


def reconfigured(
    spec: ProcessSpec, change: Callable[[ProcessConfig], ProcessConfig]
) -> ProcessSpec:
    """Return the same process with another configuration."""
    config = change(msgspec.json.decode(spec.config, type=ProcessConfig))
    return replace(spec, config=msgspec.json.encode(config).decode())


def rss_mb(pid: int) -> float:
    """Return the memory of a process [MB]. Raises Failed if it has ended."""
    with _existing(pid) as process:
        return process.memory_info().rss / 1e6


def open_files(pid: int) -> int:
    """Return the number of open files and sockets of a process. Raises Failed if it has ended."""
    with _existing(pid) as process:
        return process.num_fds()


@contextlib.contextmanager
def _existing(pid: int) -> Iterator[psutil.Process]:
    try:
        yield psutil.Process(pid)
    except psutil.Error:
        raise Failed(f"process {pid} has ended") from None
