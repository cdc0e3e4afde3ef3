"""`gigabrain bench goals`: a robot explores an unknown world, then is sent to random places."""

import asyncio
import contextlib
import math
import shutil
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec
import numpy as np
import yaml
from msgspec import Struct

from gigabrain_drivers.driver.catalog import robot_path
from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import BODY, MAP, POSE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused
from gigabrain_zenoh.geometry.pose import compose, inverse, wrap_angle
from gigabrain_zenoh.navigation.costmap import costmap, inflation
from gigabrain_zenoh.navigation.global_planner import Point, warm_up
from gigabrain_zenoh.navigation.grid_search import GridSearch
from gigabrain_zenoh.qa.bench.slam_world import GrowthSampler, MapGrowth
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    ProcessGroup,
    driver_report,
    measured_robot,
    rss_mb,
)
from gigabrain_zenoh.runtime.deployment import Deployment

START_S = 600.0  # a robot's processes and its first map, on a busy machine
REACHED = 0.99  # of all goals
CAPACITY_AH = 1000.0  # of a body that drives for hours: in two, a burger's own battery is empty

Say = Callable[[str], None]


class GoalCourse(Struct, frozen=True, kw_only=True):
    """What a robot has to go through."""

    goals: int
    meetings: int = 0  # it is sent on until it has met the person so often
    hours: float = 0.0  # and for so long, of the robot's time
    speed: float = 5.0
    seed: int = 0
    logs: Path | None = None  # where the processes' logs are kept


class GoalFailure(Struct, frozen=True, kw_only=True):
    """A goal that was not reached."""

    goal: Goal
    at: Pose  # where the robot thinks that it is
    seconds: float  # of the robot's time, since its start
    reason: str


class GoalError(Struct, frozen=True):
    """How far from a goal the robot came to rest, by the physics."""

    m: float
    rad: float | None  # None where any heading would do


def missed_by(off: GoalError) -> str:
    """Why a robot that says that it is there is not; nothing if it is."""
    if off.m > THERE_M:
        return f"it said that it is there, {off.m:.2f} m from it"
    if off.rad is not None and off.rad > THERE_RAD:
        return f"it said that it is there, turned by {math.degrees(off.rad):.0f} degrees"
    return ""


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
    off: tuple[GoalError, ...]  # wherever it said that it was there
    contacts: int
    min_clearance_m: float
    met: int  # how often the person had to stand for the robot
    distance_m: float
    seconds: float  # of the robot's time, in all
    alone: int  # ticks that went on without the brain, on a host too busy for the speed
    failures: tuple[GoalFailure, ...]
    growth: MapGrowth  # of perception

    @property
    def worst_m(self) -> float:
        """How far from a goal it came to rest at most [m]."""
        return max((off.m for off in self.off), default=0.0)

    @property
    def worst_rad(self) -> float:
        """How far from a wanted heading it came to rest at most [rad]."""
        return max((off.rad for off in self.off if off.rad is not None), default=0.0)

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
    bodies: Sequence[str], worlds: Sequence[str], course: GoalCourse, say: Say
) -> GoalsResult:
    """Send each body through each world, on the same course.

    Raises GigabrainError when a process dies on the way.
    """
    warm_up()
    runs = []
    for world in worlds:
        for body in bodies:
            deployment = Deployment(
                body=body,
                world=world,
                seed=course.seed,
                speed=course.speed,
                resume="auto",
                router=LOOPBACK,
                perception=PerceptionConfig(mapping="slam"),
                decision=DecisionConfig(behaviour="navigate"),
            )
            runs.append(await _run(deployment, course, say))
    return GoalsResult(seed=course.seed, runs=tuple(runs))


async def _run(deployment: Deployment, course: GoalCourse, say: Say) -> GoalFigures:
    """One body in one world, from its start to its end."""
    who = deployment.body
    name = f"{who} in {deployment.world}"
    with _folder(course, name.replace(" ", "-")) as folder:
        if course.hours:
            body = str(with_capacity(robot_path(deployment.body), folder / "body"))
            deployment = msgspec.structs.replace(deployment, body=body)
        say(f"{name}: starting")
        began_s = asyncio.get_running_loop().time()
        async with measured_robot(deployment, folder, START_S) as (group, bus):
            sender = GoalSender(bus, group, deployment.seed)
            await group.until(lambda: sender.is_localized, "a map, and the robot in it", START_S)
            say(f"{name}: exploring")
            explored = await sender.explore()
            explored_s = sender.seconds
            while not await sender.done(course.goals, course.meetings, course.hours):
                await sender.send()
                say(f"{name}: {sender.reached} of {sender.sent} reached")
            report, growth = await sender.report(), sender.growth()
    return GoalFigures(
        body=who,
        world=deployment.world,
        speed=deployment.speed,
        accepted_s=round(sender.accepted_s - began_s, 2),
        explored=explored,
        explored_s=explored_s,
        goals=sender.sent,
        reached=sender.reached,
        off=tuple(sender.off),
        contacts=int(report["contacts"]),
        min_clearance_m=report["min_clearance_m"],
        met=int(report["person_stood"]),
        distance_m=report["distance_m"],
        seconds=report["sim_seconds"],
        alone=int(report["lockstep_timeouts"]),
        failures=tuple(sender.failures),
        growth=growth,
    )


def with_capacity(robot: Path, folder: Path) -> Path:
    """Copy a robot's folder and give its simulation a large battery; return the new file."""
    shutil.copytree(robot.parent, folder, dirs_exist_ok=True)
    described = yaml.safe_load(robot.read_text("utf-8"))
    described["sim"] = (described.get("sim") or {}) | {"battery_capacity": CAPACITY_AH}
    copy = folder / robot.name
    copy.write_text(yaml.safe_dump(described), "utf-8")
    return copy


@contextlib.contextmanager
def _folder(course: GoalCourse, name: str) -> Iterator[Path]:
    """Where the logs of one run go."""
    if course.logs:
        folder = course.logs / name
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as temporary:
        yield Path(temporary)


MAX_GOAL_COST = 5.0  # a goal's cost at most: the body turns there as well
MAX_SILENCE_S = 60.0  # without an answer or a word of the tasks: a host may stand still for seconds
MIN_DISTANCE_M = 1.0  # from the robot to its next goal, at least
THERE_M, THERE_RAD = 0.5, math.radians(15)  # by the physics; farther off it is not there

T = TypeVar("T")


class GoalSender:
    """Sends a robot about. Every other goal has a heading."""

    def __init__(self, bus: Bus, group: ProcessGroup, seed: int) -> None:
        self._bus, self._group, self._tasks = bus, group, Tasks(bus, silent_s=MAX_SILENCE_S)
        self._maps, self._poses, self._bodies = bus.latest(MAP), bus.latest(POSE), bus.latest(BODY)
        self._states = bus.latest(STATE)  # also: which start of the driver all else has to be of
        self._random, self._search = np.random.default_rng(seed), GridSearch()
        self._world_from_map: Pose | None = None
        self._watch = GrowthSampler()
        self.sent = self.reached = 0
        self.accepted_s = 0.0  # when, by the host's clock, the first task was
        self.failures: list[GoalFailure] = []
        self.off: list[GoalError] = []  # wherever it said that it was there

    @property
    def seconds(self) -> float:
        """The robot's time [s]."""
        return self._bus.time.tick * TICK_NS / 1e9

    @property
    def is_localized(self) -> bool:
        """Whether there is a map, and the robot in it."""
        pose = self._poses.current
        return bool(self._maps.current and self._bodies.current and pose and pose.localized)

    async def explore(self) -> str:
        """Have it explore; in words, how that ended. It has to stand where its map begins."""
        truth = await self._true_pose()
        self._world_from_map = compose(truth, inverse(self._here()))
        task = await self._tasks.explore()
        self.accepted_s = asyncio.get_running_loop().time()
        ended = await self._while_all_live(self._tasks.result(task))
        return f"{ended.state}: {ended.reason}"

    async def send(self) -> None:
        """Send it to the next place, and wait until it is there or has given up."""
        x, y = await self._somewhere()
        yaw = float(self._random.uniform(-math.pi, math.pi)) if self.sent % 2 else None
        goal = Goal(x=x, y=y, yaw=yaw)
        self.sent += 1
        reason = await self._go(goal)
        if not reason:
            off = await self._off(goal)
            self.off.append(off)
            reason = missed_by(off)
        if reason:
            seconds, here = round(self.seconds, 2), self._here()
            self.failures.append(GoalFailure(goal=goal, at=here, seconds=seconds, reason=reason))
        else:
            self.reached += 1

    async def done(self, goals: int, meetings: int, hours: float) -> bool:
        """Whether it was sent often and long enough, and has met the person often enough."""
        if self.sent < goals or self.seconds < hours * 3600:
            return False
        return not meetings or (await self.report())["person_stood"] >= meetings

    def growth(self) -> MapGrowth:
        """What perception's memory and map have come to."""
        assert self._maps.current
        return self._watch.growth(self._maps.current)

    def _sample(self) -> None:
        """Take a sample of perception each minute of the robot's time."""
        pid, grid = self._group.supervisor.statuses["perception"].pid, self._maps.current
        if pid and grid and self.seconds >= (self._watch.minutes + 1) * 60:
            self._watch.minute(rss_mb(pid), grid)

    async def report(self) -> dict[str, float]:
        """The simulation's truth so far. Raises GigabrainError where it does not come."""
        told: dict[str, float] = {}
        while not told:
            await self._group.look()
            report = await driver_report(self._bus)
            told = {k: float(v) for k, v in report.items() if isinstance(v, int | float)}
        return told

    async def _go(self, goal: Goal) -> str:
        """Why it did not get there; nothing if it did."""
        try:
            task = await self._order(goal)
            ended = await self._while_all_live(self._tasks.result(task))
        except Refused as refusal:
            return f"refused: {refusal}"
        return "" if ended.state == "succeeded" else f"{ended.state}: {ended.reason}"

    async def _order(self, goal: Goal) -> str:
        """The task's name. A question that a host has slept through is asked again."""
        now = asyncio.get_running_loop().time
        until = now() + MAX_SILENCE_S
        while True:
            try:
                return await self._tasks.go_to(goal.x, goal.y, goal.yaw)
            except BodyLost:
                if now() > until:
                    raise
            await self._group.look()

    async def _off(self, goal: Goal) -> GoalError:
        assert self._world_from_map
        there = compose(self._world_from_map, Pose(x=goal.x, y=goal.y, yaw=goal.yaw or 0.0))
        truth = await self._true_pose()
        turn = None if goal.yaw is None else abs(wrap_angle(truth.yaw - there.yaw))
        return GoalError(math.hypot(truth.x - there.x, truth.y - there.y), turn)

    async def _true_pose(self) -> Pose:
        told = await self.report()
        return Pose(x=told["true_x"], y=told["true_y"], yaw=told["true_yaw"])

    def _here(self) -> Pose:
        pose = self._poses.current
        assert pose
        return Pose(x=pose.x, y=pose.y, yaw=pose.yaw)

    async def _somewhere(self) -> Point:
        """A place to go to; a person who has shut the robot in goes on after a while."""
        now = asyncio.get_running_loop().time
        until = now() + MAX_SILENCE_S
        while True:
            try:
                return self._anywhere()
            except GigabrainError:
                if now() > until:
                    raise
            await self._group.look()

    def _anywhere(self) -> Point:
        """A place in the known map that can be reached and where the body can turn."""
        grid, body, here = self._maps.current, self._bodies.current, self._here()
        assert grid
        assert body
        made = costmap(grid, inflation(body.description, "forbid"))
        start = made.cell(here.x, here.y)
        if start is None:
            raise GigabrainError("the robot has left its map: nowhere to send it")
        way = self._search.field(made.cost, start, "from") * made.resolution
        rows, columns = np.nonzero(
            (made.cost < MAX_GOAL_COST) & (way > MIN_DISTANCE_M) & np.isfinite(way)
        )
        if not len(rows):
            raise GigabrainError("no place can be reached from where the robot is")
        one = int(self._random.integers(len(rows)))
        x, y = made.points(rows[one : one + 1], columns[one : one + 1])[0].tolist()
        return x, y

    async def _while_all_live(self, work: Awaitable[T]) -> T:
        """Wait for `work`. Raises GigabrainError when a process dies or the gate latches."""
        waiting = asyncio.ensure_future(work)
        try:
            while not waiting.done():
                await self._group.look()
                self._refuse_latched()
                self._sample()
            return await waiting
        finally:
            waiting.cancel()

    def _refuse_latched(self) -> None:
        """Raise GigabrainError where only a person could have the robot drive again."""
        state = self._states.current
        latching = [cause.text for cause in state.gate.causes if cause.latching] if state else []
        if state and state.gate.mode == "latched" and latching:
            raise GigabrainError(f"the robot has latched: {', '.join(latching)}")
