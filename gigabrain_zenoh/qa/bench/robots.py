"""`gigabrain bench robots`: robots explore side by side at real time; measures the cost of each."""

import asyncio
import contextlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import psutil
from msgspec import Struct

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import TICK_S
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.decision.drive_kernels import DRIVE_KERNELS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.kernels.precompile import ensure_compiled
from gigabrain_zenoh.launch.demo import KEPT
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.perception.node import MAP_KERNELS
from gigabrain_zenoh.qa.bench.stack import physics_share
from gigabrain_zenoh.qa.judging import Failed, table_of
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    START_S,
    ProcessGroup,
    measured_robot,
    report_of,
)

if TYPE_CHECKING:
    from rich.console import Group

SETTLE_S = 5.0  # the first plan and the first map do not count
ANSWER_TIMEOUT_S = 20.0  # for a report, on a machine that is too small
MAX_P99_MS = 60.0  # from scan to command
MAX_STOOD = 0.05  # share of the time with a shut gate
MB = 1e6


class FleetRobot(Struct, frozen=True, kw_only=True):
    """Figures of one robot. Contacts and distance are true values of the physics."""

    number: int
    problem: str = ""  # reason for missing figures
    contacts: int = 0
    distance_m: float = 0.0
    real_time: float = 0.0  # the robot's time over wall time
    stood: float = 0.0  # share of the robot's time with a shut gate
    p50_ms: float | None = None  # scan to command, since the start; None before the first
    p99_ms: float | None = None
    cpu: float = 0.0  # share of one core, all processes, without physics
    physics_cpu: float = 0.0  # share of one core, with the lidar's rays
    pss_bytes: int = 0  # of all processes; shared memory is divided among its users

    @property
    def too_slow(self) -> str:
        """Why the machine is too small for this robot; empty if it is not."""
        if self.problem:
            return ""
        if self.real_time < KEPT:
            return f"its time ran at {self.real_time:.0%} of real time"
        if self.p99_ms is None:
            return "no scan was answered"
        if self.p99_ms > MAX_P99_MS:
            return f"scan to command took {self.p99_ms:.0f} ms (p99)"
        if self.stood > MAX_STOOD:
            return f"it stood for {self.stood:.0%} of the time, as its gate was shut"
        return ""


class RobotsResult(Struct, frozen=True, kw_only=True):
    """The figures of all robots."""

    body: str
    world: str
    seconds: float
    cores: int
    busy: float  # share of all cores that was busy while they drove
    robots: tuple[FleetRobot, ...]

    @property
    def verdict(self) -> str:
        """State in one line if the machine is large enough for the robots."""
        count = len(self.robots)
        slow = [f"robot {one.number}: {one.too_slow}" for one in self.robots if one.too_slow]
        failed = [f"robot {one.number}: {one.problem}" for one in self.robots if one.problem]
        reasons = "; ".join((*slow, *failed))
        if slow:
            return f"this machine is too small for {count} of these robots: {reasons}"
        if failed:
            return f"{len(failed)} of these {count} robots failed: {reasons}"
        if contacts := sum(one.contacts for one in self.robots):
            return f"this machine carries {count} of these robots, but they had {contacts} contacts"
        return f"this machine carries {count} of these robots"

    @property
    def ok(self) -> bool:
        """True if the machine is large enough for them, and there were no contacts."""
        return not any(one.too_slow or one.problem or one.contacts for one in self.robots)


class _Start:
    """Lets all robots begin together, when each is ready or has failed."""

    def __init__(self, count: int) -> None:
        self._missing, self.all = count, asyncio.Event()

    def settled(self) -> None:
        """Count a robot that is ready or has failed."""
        self._missing -= 1
        if not self._missing:
            self.all.set()

    async def wait(self, group: ProcessGroup) -> None:
        """Wait for the other robots. Raises Failed when a process of `group` dies."""
        await group.until(self.all.is_set, "the other robots are ready", 2 * START_S)


async def measure_robots(
    body: str, world: str, count: int, seconds: float, show: Callable[[str], None]
) -> RobotsResult:
    """Let robots explore, each in its own world, and measure all at once.

    Raises ConfigError for a body without a base or a lidar.
    """
    description = load_robot(body).description()
    if not description.has_base or description.lidar is None:
        raise ConfigError(f"{body} cannot explore: it needs a base and a lidar")
    for warm_up in (MAP_KERNELS, DRIVE_KERNELS):
        await ensure_compiled(warm_up)
    show(f"starting {count} x {body} in {world}")
    start = _Start(count)
    watching = asyncio.ensure_future(_busy_share(start, seconds, show))
    deployments = (
        Deployment(
            body=body, world=world, seed=number, resume="auto", router=LOOPBACK,
            perception=PerceptionConfig(mapping="slam"),
            decision=DecisionConfig(behaviour="navigate", settings={"start": "explore"}),
        )
        for number in range(count)
    )  # fmt: skip
    running = [
        asyncio.ensure_future(_run_robot(number, one, seconds, start))
        for number, one in enumerate(deployments, 1)
    ]
    try:
        robots, busy = await asyncio.gather(*running), await watching
    finally:  # an error of one robot ends all
        for task in (watching, *running):
            task.cancel()
        await asyncio.gather(watching, *running, return_exceptions=True)
    return RobotsResult(
        body=body,
        world=world,
        seconds=seconds,
        cores=psutil.cpu_count() or 1,
        busy=busy,
        robots=tuple(robots),
    )


async def _busy_share(start: _Start, seconds: float, show: Callable[[str], None]) -> float:
    """Return the share of all cores that was busy while the robots drove."""
    await start.all.wait()
    await asyncio.sleep(SETTLE_S)
    show(f"all started; measuring for {seconds:g} s")
    psutil.cpu_percent()
    await asyncio.sleep(seconds)
    return psutil.cpu_percent() / 100


async def _run_robot(
    number: int, deployment: Deployment, seconds: float, start: _Start
) -> FleetRobot:
    async with contextlib.AsyncExitStack() as stack:
        try:
            robot = measured_robot(deployment, ready_s=START_S)
            group, bus = await stack.enter_async_context(robot)
        except Failed as error:
            return FleetRobot(number=number, problem=str(error))
        finally:
            start.settled()
        try:
            await start.wait(group)
            return await _measure(number, group, bus, seconds)
        except Failed as error:
            return FleetRobot(number=number, problem=str(error))


async def _measure(number: int, group: ProcessGroup, bus: Bus, seconds: float) -> FleetRobot:
    await group.run_for(SETTLE_S)
    loop = asyncio.get_running_loop()
    before, cpu_s, begin_s = await _report(group, bus), group.cpu_s, loop.time()
    await group.run_for(seconds)
    after, passed_s = await _report(group, bus), loop.time() - begin_s
    physics = physics_share(before, after, passed_s) or 0.0
    gained = {
        key: float(after[key]) - float(before[key])
        for key in ("sim_seconds", "distance_m", "contacts")
    }
    window = float(before["sim_seconds"]), float(after["sim_seconds"])
    return FleetRobot(
        number=number,
        contacts=int(gained["contacts"]),
        distance_m=round(gained["distance_m"], 2),
        real_time=gained["sim_seconds"] / passed_s,
        stood=shut_share(group.records, *window),
        p50_ms=after["scan_to_cmd_p50_ms"],
        p99_ms=after["scan_to_cmd_p99_ms"],
        cpu=(group.cpu_s - cpu_s) / passed_s - physics,
        physics_cpu=physics,
        pss_bytes=sum(map(_pss_bytes, group.pids.values())),
    )


async def _report(group: ProcessGroup, bus: Bus) -> Mapping[str, Any]:
    """Return the driver's report. Raises Failed if it does not arrive."""
    found: dict[str, Any] = {}

    async def ask() -> None:
        while not found:
            found.update(await report_of(bus))

    asking = asyncio.ensure_future(ask())
    try:
        await group.until(lambda: bool(found), "a report of the driver", ANSWER_TIMEOUT_S)
    finally:
        asking.cancel()
    return found


def shut_share(records: Sequence[Mapping[str, Any]], begin_s: float, end_s: float) -> float:
    """Return the share of the robot's time with a shut gate, by the driver's log."""
    shut_s, since_s, is_shut = 0.0, begin_s, True
    for record in records:
        if record.get("event") != "gate":
            continue
        at_s = min(max(float(record["tick"]) * TICK_S, begin_s), end_s)
        shut_s += (at_s - since_s) * is_shut
        since_s, is_shut = at_s, record["mode"] != "enabled"
    return (shut_s + (end_s - since_s) * is_shut) / (end_s - begin_s)


def _pss_bytes(pid: int) -> int:
    """Return a process's PSS [bytes], or its USS where the system has no PSS; 0 if it is gone."""
    with contextlib.suppress(psutil.Error):
        memory = psutil.Process(pid).memory_full_info()
        return int(getattr(memory, "pss", memory.uss))
    return 0


def robots_page(result: RobotsResult) -> "Group":
    """Return the page that `gigabrain bench robots` prints."""
    from rich.console import Group
    from rich.text import Text

    table = table_of("#", "driven", "contacts", "pace", "stood", "p50 / p99 [ms]", "CPU", "PSS")
    for one in result.robots:
        if one.problem:
            table.add_row(str(one.number), "-")
            continue
        table.add_row(
            str(one.number), f"{one.distance_m:.1f} m", str(one.contacts), f"{one.real_time:.0%}",
            f"{one.stood:.0%}", f"{one.p50_ms or 0:.1f} / {one.p99_ms or 0:.1f}",
            f"{one.cpu:.0%} + {one.physics_cpu:.0%}", f"{one.pss_bytes / MB:.0f} MB",
        )  # fmt: skip
    title = (
        f"\n{len(result.robots)} x {result.body} in {result.world} at real time, "
        f"{result.seconds:g} s; {result.busy:.0%} of {result.cores} cores busy"
    )
    about = (
        "Pace: of the robot's time, in parts of real time. Stood: share of it with a shut gate. "
        "p50 / p99: scan to command. CPU: of one core, without physics and of physics."
    )
    colour = "green" if result.ok else "bold red"
    return Group(
        Text(title, style="bold"), table, Text(about, style="dim"),
        Text(result.verdict, style=colour),
    )  # fmt: skip
