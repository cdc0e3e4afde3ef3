"""A robot that knows nothing explores its world, then is sent to places drawn at random.

All processes run as under `gigabrain up`; contacts and clearance are the simulation's truth.
"""

import asyncio
import tempfile
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from msgspec import Struct

from gigabrain_schemas.base import TICK_NS
from gigabrain_schemas.topics import BODY, MAP, POSE, STATE
from gigabrain_zenoh.bench.group import Group, client, driver_report, running
from gigabrain_zenoh.bench.runs import LOOPBACK
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.deployment import Deployment, client_endpoint, with_free_port
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.navigation.costmap import costmap, inflation
from gigabrain_zenoh.navigation.planner import Point, warm_up
from gigabrain_zenoh.navigation.search import Search
from gigabrain_zenoh.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.specs import process_specs
from gigabrain_zenoh.task_client import Tasks

EASY = 5.0  # a goal's cost at most: the body turns there as well
START_S = 600.0  # a robot's processes and its first map, on a busy machine
FAR_M = 1.0  # from the robot to its next goal, at least
REACHED = 0.99  # of all goals

T = TypeVar("T")


class Failure(Struct, frozen=True, kw_only=True):
    """A goal that was not reached."""

    x: float  # [m], in the robot's map
    y: float  # [m]
    reason: str


class GoalFigures(Struct, frozen=True, kw_only=True):
    """How one body fared in one world."""

    body: str
    world: str
    speed: float
    accepted_s: float  # of the host's time, from the start of the processes to the first task
    explored: str  # how exploring ended
    explored_s: float  # of the robot's time
    goals: int
    reached: int
    contacts: int
    min_clearance_m: float
    met: int  # how often the person had to stand for the robot
    distance_m: float
    seconds: float  # of the robot's time, in all
    alone: int  # ticks that went on without the brain, on a host too busy for the speed
    failures: tuple[Failure, ...]

    @property
    def seconds_per_goal(self) -> float:
        """Mean of the robot's time from one goal to the next [s]."""
        return (self.seconds - self.explored_s) / self.goals

    @property
    def ok(self) -> bool:
        """Whether it touched nothing and got to nearly all of its goals."""
        return self.contacts == 0 and self.reached >= REACHED * self.goals


class GoalsResult(Struct, frozen=True, kw_only=True):
    """All bodies in all worlds."""

    seed: int
    runs: tuple[GoalFigures, ...]

    @property
    def ok(self) -> bool:
        """Whether all did well."""
        return all(run.ok for run in self.runs)


async def measure_goals(
    bodies: Sequence[str],
    worlds: Sequence[str],
    goals: int,
    meetings: int,
    speed: float,
    seed: int,
    say: Callable[[str], None],
) -> GoalsResult:
    """Send each body through each world: to so many goals, and on until so often it met the person.

    Raises GigabrainError when a process dies on the way.
    """
    warm_up()
    runs = []
    for world in worlds:
        for body in bodies:
            deployment = Deployment(
                body=body,
                world=world,
                seed=seed,
                speed=speed,
                resume="auto",
                router=LOOPBACK,
                perception=PerceptionConfig(mapping="slam"),
                decision=DecisionConfig(behaviour="navigate"),
            )
            runs.append(await _run(with_free_port(deployment), goals, meetings, say))
    return GoalsResult(seed=seed, runs=tuple(runs))


async def _run(
    deployment: Deployment, goals: int, meetings: int, say: Callable[[str], None]
) -> GoalFigures:
    """One body in one world, from its start to its end."""
    name = f"{deployment.body} in {deployment.world}"
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as folder:
        specs = process_specs(deployment, "robot", Path(folder), Path(folder) / "state")
        say(f"{name}: starting")
        began_s = asyncio.get_running_loop().time()
        async with (
            running(specs, START_S) as group,
            client(client_endpoint(deployment)) as bus,
        ):
            sender = _Sender(bus, group, deployment.seed)
            await group.until(lambda: sender.knows_its_place, START_S)
            say(f"{name}: exploring")
            explored = await sender.explore()
            accepted_s = sender.accepted_s - began_s
            explored_s = sender.seconds
            while not await sender.done(goals, meetings):
                await sender.send()
                say(f"{name}: {sender.reached} of {sender.sent} reached")
            report = await sender.report()
    return GoalFigures(
        body=deployment.body,
        world=deployment.world,
        speed=deployment.speed,
        accepted_s=round(accepted_s, 2),
        explored=explored,
        explored_s=explored_s,
        goals=sender.sent,
        reached=sender.reached,
        contacts=int(report["contacts"]),
        min_clearance_m=report["min_clearance_m"],
        met=int(report["person_stood"]),
        distance_m=report["distance_m"],
        seconds=report["sim_seconds"],
        alone=int(report["lockstep_timeouts"]),
        failures=tuple(sender.failures),
    )


class _Sender:
    """Sends a robot about, and keeps account."""

    def __init__(self, bus: Bus, group: Group, seed: int) -> None:
        self._bus, self._group, self._tasks = bus, group, Tasks(bus)
        self._maps, self._poses, self._bodies = bus.latest(MAP), bus.latest(POSE), bus.latest(BODY)
        bus.latest(STATE)  # which start of the driver all else has to be of
        self._random, self._search = np.random.default_rng(seed), Search()
        self.sent = self.reached = 0
        self.accepted_s = 0.0  # when, by the host's clock, the first task was
        self.failures: list[Failure] = []

    @property
    def seconds(self) -> float:
        """The robot's time [s]."""
        return self._bus.time.tick * TICK_NS / 1e9

    @property
    def knows_its_place(self) -> bool:
        """Whether there is a map, and the robot in it."""
        pose = self._poses.current
        return bool(self._maps.current and self._bodies.current and pose and pose.localized)

    async def explore(self) -> str:
        """Have it explore; in words, how that ended."""
        task = await self._tasks.explore()
        self.accepted_s = asyncio.get_running_loop().time()
        ended = await self._while_all_live(self._tasks.result(task))
        return f"{ended.state}: {ended.reason}"

    async def send(self) -> None:
        """Send it to the next place, and wait until it is there or has given up."""
        x, y = self._anywhere()
        self.sent += 1
        try:
            task = await self._tasks.go_to(x, y)
            ended = await self._while_all_live(self._tasks.result(task))
            reason = "" if ended.state == "succeeded" else f"{ended.state}: {ended.reason}"
        except Refused as refusal:
            reason = f"refused: {refusal}"
        if reason:
            self.failures.append(Failure(x=round(x, 2), y=round(y, 2), reason=reason))
        else:
            self.reached += 1

    async def done(self, goals: int, meetings: int) -> bool:
        """Whether it was sent often enough, and has met the person often enough."""
        if self.sent < goals:
            return False
        return not meetings or (await self.report())["person_stood"] >= meetings

    async def report(self) -> dict[str, float]:
        """The simulation's truth so far. Raises GigabrainError where it does not come."""
        told: dict[str, float] = {}
        while not told:
            await self._group.look()
            report = await driver_report(self._bus)
            told = {k: float(v) for k, v in report.items() if isinstance(v, int | float)}
        return told

    def _anywhere(self) -> Point:
        """A place in the known map that can be reached and where the body can turn."""
        grid, pose, body = self._maps.current, self._poses.current, self._bodies.current
        assert grid
        assert pose
        assert body
        made = costmap(grid, inflation(body.description, "forbid"))
        here = made.cell(pose.x, pose.y)
        if here is None:
            raise GigabrainError("the robot has left its map: nowhere to send it")
        way = self._search.field(made.cost, here, "from") * made.resolution
        rows, columns = np.nonzero((made.cost < EASY) & (way > FAR_M) & np.isfinite(way))
        if not len(rows):
            raise GigabrainError("no place can be reached from where the robot is")
        one = int(self._random.integers(len(rows)))
        x, y = made.points(rows[one : one + 1], columns[one : one + 1])[0].tolist()
        return x, y

    async def _while_all_live(self, work: Awaitable[T]) -> T:
        """Wait for `work`. Raises GigabrainError when a process dies meanwhile."""
        waiting = asyncio.ensure_future(work)
        try:
            while not waiting.done():
                await self._group.look()
            return await waiting
        finally:
            waiting.cancel()
