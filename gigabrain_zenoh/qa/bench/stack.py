"""`gigabrain bench stack`: CPU, memory and start time of a whole robot, and its first goal."""

import asyncio
import statistics
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING

from msgspec import Struct
from msgspec.structs import replace

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent
from gigabrain_schemas.safety import Health
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, HEALTH, INTENT, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, LinkName, PerceptionConfig
from gigabrain_zenoh.decision.drive_kernels import DRIVE_KERNELS
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.kernels.precompile import ensure_compiled
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.perception.node import MAP_KERNELS
from gigabrain_zenoh.qa.arm_mission import repeated_mission
from gigabrain_zenoh.qa.judging import Figure, Limit, table_of
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    START_S,
    ProcessGroup,
    measured_robot,
    report_of,
)

if TYPE_CHECKING:
    from rich.console import Group

SETTLE_S = 2.0  # imports and first calls do not count
MIN_JOINT_SPEED = 0.2  # [rad/s] or [m/s], of a moving joint
PERIOD_S = 1.0  # of the health messages
SIMULATOR = "driver"  # process with MuJoCo
EMULATOR = "emulator"  # process with MuJoCo that answers the driver's bytes
AHEAD = GoalRequest(x=0.5, y=0.0, source="bench")
ASK_TIMEOUT_S, RETRY_S = 1.0, 0.02
MB = 1e6
READY = Figure("all ready after", "s").at_most(1.5)
CPU = Figure("CPU without physics", "%").at_most(30)
ARM_CPU = Figure("CPU without physics", "%").at_most(35)
ARM_HZ = 100.0  # rate of commands to an arm on its own bus; the simulation uses 50
PHYSICS = Figure("physics and lidar", "%").at_most(5)
FIRST_GOAL = Figure("first goal accepted after", "s").at_most(2)
MAX_RSS_MB = 70.0


class ProcessCost(Struct, frozen=True, kw_only=True):
    """CPU and memory of one process."""

    name: str
    cpu: float  # mean share of one core
    rss_bytes: int  # largest


class FirstGoal(Struct, frozen=True, kw_only=True):
    """Times from the start of the first process. CPU time is the sum of all processes."""

    accepted_s: float
    accepted_cpu_s: float
    answer: str  # text of the reply
    drives_s: float  # until the robot followed its first path
    drives_cpu_s: float


class StackResult(Struct, frozen=True, kw_only=True):
    """Cost of a whole robot."""

    body: str
    link: LinkName
    world: str
    seconds: float
    ready_s: float  # from the start of the first process until the last one is ready
    physics_cpu: float | None  # share of one core, with the lidar's rays; None without physics
    arm_hz: float = 0.0  # rate of commands to a moving arm; 0 for a robot that drives
    processes: tuple[ProcessCost, ...]
    first_goal: FirstGoal | None = None  # of the same robot, after a restart with a map

    @property
    def cpu_without_physics(self) -> float:
        """CPU of all processes except an emulator, without physics, as a share of one core."""
        own = [process.cpu for process in self.processes if process.name != EMULATOR]
        return sum(own) - (self.physics_cpu or 0.0)


def targets(result: StackResult) -> dict[Limit, float]:
    """Return the figures that have a limit. The memory's limit is for processes without MuJoCo."""
    cpu_percent = 100 * result.cpu_without_physics
    if result.arm_hz:  # decision and safety use MuJoCo, too
        return {READY: result.ready_s, ARM_CPU: cpu_percent}
    found = {READY: result.ready_s, CPU: cpu_percent}
    if result.physics_cpu is not None:
        found[PHYSICS] = 100 * result.physics_cpu
    if goal := result.first_goal:
        found[FIRST_GOAL] = goal.accepted_s
    without_mujoco = [
        p for p in result.processes if p.name != SIMULATOR or result.physics_cpu is None
    ]
    largest = max(without_mujoco, key=lambda process: process.rss_bytes)
    memory = Figure(f"largest without MuJoCo ({largest.name})", "MB").at_most(MAX_RSS_MB)
    return {**found, memory: largest.rss_bytes / MB}


async def measure_stack(
    body: str, link: LinkName, world: str | None, seconds: float, show: Callable[[str], None],
    *, goal: bool = False,
) -> StackResult:  # fmt: skip
    """Run a robot that avoids obstacles, or an arm that executes the mission of its demo.

    With `goal`, also run a robot that navigates, for its first goal. Raises ConfigError if it is an
    arm, and GigabrainError when a process dies.
    """
    robot = load_robot(body)
    is_arm = not robot.description().has_base
    if goal and is_arm:
        raise ConfigError(f"--goal: {body} does not drive")
    world = world or (robot.demo.world if is_arm else Deployment().world)
    deployment = Deployment(body=body, link=link, world=world, resume="auto", router=LOOPBACK)
    if is_arm:
        rate, decision = {"arm": {"rate_hz": ARM_HZ}}, DecisionConfig(behaviour="navigate")
        deployment = replace(deployment, robot=rate, decision=decision)
    show(f"starting {body} in {world}")
    async with measured_robot(deployment) as (group, bus), AsyncExitStack() as stack:
        if is_arm:
            mission = await stack.enter_async_context(repeated_mission(bus, body))
            await _until_it_moves(group, bus, mission)
        await group.run_for(SETTLE_S)
        show(f"ready after {group.ready_s:.2f} s; measuring for {seconds:g} s")
        names = list(group.supervisor.statuses)
        healths: defaultdict[str, list[Health]] = defaultdict(list)
        close = bus.subscribe(HEALTH, lambda _key, health: healths[health.process].append(health))
        before, begin_ns = await report_of(bus), bus.clock.now_ns()
        await group.run_for(max(seconds, 2 * PERIOD_S))
        close()
        after, ended_ns = await report_of(bus), bus.clock.now_ns()
        await group.until(lambda: len(healths) >= len(names), "health of all processes")
    first_goal = await measure_first_goal(body, world, show) if goal else None
    return StackResult(
        body=body,
        link=link,
        world=world,
        seconds=seconds,
        ready_s=group.ready_s,
        physics_cpu=physics_share(before, after, (ended_ns - begin_ns) / 1e9),
        processes=tuple(_cost(name, healths[name]) for name in names),
        arm_hz=ARM_HZ if is_arm else 0.0,
        first_goal=first_goal,
    )


async def _until_it_moves(group: ProcessGroup, bus: Bus, mission: asyncio.Task[None]) -> None:
    """Wait until a joint moves: the first plan may take long. Raises the mission's error."""
    moves = asyncio.Event()

    def on_state(_key: str, state: RobotState) -> None:
        if any(abs(joint.velocity) > MIN_JOINT_SPEED for joint in state.joints):
            moves.set()

    close = bus.subscribe(STATE, on_state)
    await group.until(lambda: moves.is_set() or mission.done(), "the arm moves", START_S)
    close()
    if mission.done():
        mission.result()


def physics_share(
    before: Mapping[str, object], after: Mapping[str, object], seconds: float
) -> float | None:
    """Return the physics thread's share of one core between two reports; None without physics."""
    spent = [report.get("physics_cpu_s") for report in (before, after)]
    if not all(isinstance(value, int | float) for value in spent):
        return None
    return (float(str(spent[1])) - float(str(spent[0]))) / seconds


def _cost(name: str, healths: Sequence[Health]) -> ProcessCost:
    return ProcessCost(
        name=name,
        cpu=statistics.fmean(health.cpu for health in healths),
        rss_bytes=max(health.rss_bytes for health in healths),
    )


async def measure_first_goal(body: str, world: str, show: Callable[[str], None]) -> FirstGoal:
    """Start a robot that makes a map, and send it a goal until it accepts and drives.

    Kernels are compiled before. Raises ConfigError if navigation is not installed, and
    GigabrainError when a process dies.
    """
    for warm_up in (MAP_KERNELS, DRIVE_KERNELS):
        await ensure_compiled(warm_up)
    deployment = Deployment(
        body=body, world=world, resume="auto", router=LOOPBACK,
        perception=PerceptionConfig(mapping="slam"), decision=DecisionConfig(behaviour="navigate"),
    )  # fmt: skip
    show(f"starting {body} in {world} for a first goal")
    async with measured_robot(deployment, ready_s=None) as (group, bus):
        follows = asyncio.Event()

        def on_intent(_key: str, intent: Intent) -> None:
            if intent.follow:
                follows.set()

        bus.subscribe(INTENT, on_intent)
        asking = asyncio.ensure_future(_send_until_accepted(group, bus))
        try:
            await group.until(lambda: asking.done() and follows.is_set(), "a first goal", START_S)
        finally:
            asking.cancel()
        accepted_s, accepted_cpu_s, text = asking.result()
        return FirstGoal(
            accepted_s=accepted_s,
            accepted_cpu_s=accepted_cpu_s,
            answer=text,
            drives_s=group.seconds,
            drives_cpu_s=group.cpu_s,
        )


async def _send_until_accepted(group: ProcessGroup, bus: Bus) -> tuple[float, float, str]:
    """Return the time and CPU time [s] until a goal is accepted, and the reply's text."""
    while True:
        replies = await bus.ask(GOAL, AHEAD, timeout_s=ASK_TIMEOUT_S)
        if replies and replies[0].ok:
            return group.seconds, group.cpu_s, replies[0].text
        await asyncio.sleep(RETRY_S)


def stack_page(result: StackResult) -> "Group":
    """Return the page that `gigabrain bench stack` prints."""
    from rich.console import Group
    from rich.text import Text

    costs = table_of("process", "CPU", "memory")
    for process in result.processes:
        costs.add_row(process.name, f"{process.cpu:.1%}", f"{process.rss_bytes / MB:.0f} MB")
    limits = table_of("figure", "measured", "at most", "")
    for limit, value in targets(result).items():
        figure, at_most = limit
        verdict = Text("ok", style="green") if limit.allows(value) else Text("over", style="yellow")
        value_text, limit_text = f"{value:.2f} {figure.unit}", f"{at_most:g} {figure.unit}"
        limits.add_row(figure.name, value_text, limit_text, verdict)
    rate = f", {result.arm_hz:g} commands a second to its arm" if result.arm_hz else ""
    title = f"\n{result.body} ({result.link}) in {result.world}, {result.seconds:g} s{rate}"
    page = Group(
        Text(title, style="bold"), costs,
        Text("\nTargets (CPU of one core)", style="bold"), limits,
    )  # fmt: skip
    if goal := result.first_goal:
        text = (
            f"The first goal was accepted after {goal.accepted_cpu_s:.2f} s of CPU "
            f"({goal.answer}). The robot drove to it after {goal.drives_s:.2f} s with "
            f"{goal.drives_cpu_s:.2f} s of CPU."
        )
        page.renderables.append(Text(text, style="dim"))
    return page
