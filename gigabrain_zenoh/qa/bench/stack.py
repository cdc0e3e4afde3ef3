"""`gigabrain bench stack`: what a whole robot costs at real time, and how fast it is there."""

import statistics
import tempfile
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from msgspec import Struct

from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import HEALTH
from gigabrain_zenoh.launch.specs import process_specs
from gigabrain_zenoh.qa.bench.first_goal import ACCEPTED_S, FirstGoal, measure_first_goal
from gigabrain_zenoh.qa.bench.group import client, driver_report, running
from gigabrain_zenoh.qa.bench.runs import LOOPBACK
from gigabrain_zenoh.runtime.deployment import Deployment, client_endpoint, with_free_port

SETTLE_S = 2.0  # imports and first calls are no part of what a running robot costs
PERIOD_S = 1.0  # of the health messages
READY_S, CPU_PERCENT, PHYSICS_PERCENT, RSS_MB = 1.5, 30.0, 5.0, 70.0  # targets
SIMULATOR = "driver"  # the process that holds MuJoCo


class Process(Struct, frozen=True, kw_only=True):
    """What one process needs."""

    name: str
    cpu: float  # of one core, mean
    rss_bytes: int  # most


class StackResult(Struct, frozen=True, kw_only=True):
    """What all of them need."""

    body: str
    world: str
    seconds: float
    ready_s: float  # from the start of the first process until the last was ready
    physics_cpu: float | None  # of one core, with the lidar's rays; None for a body without physics
    processes: tuple[Process, ...]
    first_goal: FirstGoal | None = None  # of the same robot, started anew and making a map

    @property
    def cpu_without_physics(self) -> float:
        """Of one core, all processes together."""
        return sum(process.cpu for process in self.processes) - (self.physics_cpu or 0.0)


class Target(Struct, frozen=True, kw_only=True):
    """A figure and what it must not exceed."""

    name: str
    value: float
    limit: float
    unit: str

    @property
    def ok(self) -> bool:
        """Whether it is reached."""
        return self.value <= self.limit


def targets(result: StackResult) -> list[Target]:
    """The figures that have one. Memory counts in processes without MuJoCo."""
    found = [
        Target(name="all ready after", value=result.ready_s, limit=READY_S, unit="s"),
        Target(
            name="CPU without physics",
            value=100 * result.cpu_without_physics,
            limit=CPU_PERCENT,
            unit="%",
        ),
    ]
    if result.physics_cpu is not None:
        percent = 100 * result.physics_cpu
        found.append(
            Target(name="physics and lidar", value=percent, limit=PHYSICS_PERCENT, unit="%")
        )
    if goal := result.first_goal:
        name = "first goal accepted after"
        found.append(Target(name=name, value=goal.accepted_s, limit=ACCEPTED_S, unit="s"))
    small = [p for p in result.processes if p.name != SIMULATOR or result.physics_cpu is None]
    largest = max(small, key=lambda process: process.rss_bytes)
    found.append(
        Target(
            name=f"largest without MuJoCo ({largest.name})",
            value=largest.rss_bytes / 1e6,
            limit=RSS_MB,
            unit="MB",
        )
    )
    return found


async def measure_stack(
    body: str, world: str, seconds: float, say: Callable[[str], None], *, goal: bool = False
) -> StackResult:
    """Run a robot that avoids, and then perhaps one that navigates, for its first `goal`.

    Raises GigabrainError when a process dies on the way.
    """
    deployment = with_free_port(Deployment(body=body, world=world, resume="auto", router=LOOPBACK))
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        folder = Path(name)
        specs = process_specs(deployment, "robot", folder, folder / "state")
        say(f"starting {body} in {world}")
        async with running(specs) as group, client(client_endpoint(deployment)) as bus:
            await group.go_on(SETTLE_S)
            say(f"ready after {group.ready_s:.2f} s; measuring for {seconds:g} s")
            told: defaultdict[str, list[Health]] = defaultdict(list)
            close = bus.subscribe(HEALTH, lambda _key, health: told[health.process].append(health))
            before, began_ns = await driver_report(bus), bus.clock.now_ns()
            await group.go_on(max(seconds, 2 * PERIOD_S))
            close()
            after, ended_ns = await driver_report(bus), bus.clock.now_ns()
            await group.until(lambda: len(told) >= len(specs))
    first_goal = await measure_first_goal(body, world, say) if goal else None
    return StackResult(
        body=body,
        world=world,
        seconds=seconds,
        ready_s=group.ready_s,
        physics_cpu=physics_share(before, after, (ended_ns - began_ns) / 1e9),
        processes=tuple(_process(spec.name, told[spec.name]) for spec in specs),
        first_goal=first_goal,
    )


def physics_share(
    before: Mapping[str, object], after: Mapping[str, object], seconds: float
) -> float | None:
    """CPU time of the physics thread between two reports, of one core."""
    spent = [report.get("physics_cpu_s") for report in (before, after)]
    if not all(isinstance(value, int | float) for value in spent):
        return None
    return (float(str(spent[1])) - float(str(spent[0]))) / seconds


def _process(name: str, told: Sequence[Health]) -> Process:
    return Process(
        name=name,
        cpu=statistics.fmean(health.cpu for health in told),
        rss_bytes=max(health.rss_bytes for health in told),
    )
