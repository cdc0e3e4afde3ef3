"""`gigabrain bench goals`: a robot explores an unknown world, then drives to random goals."""

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

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.sim.worlds import load_world
from gigabrain_schemas.arrays import Floats
from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import BODY, MAP, POSE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.config.settings import DecisionConfig, LinkName, PerceptionConfig
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused
from gigabrain_zenoh.geometry.pose import compose, inverse, wrap_angle
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.navigation.costmap import costmap, inflation
from gigabrain_zenoh.navigation.global_planner import Point, warm_up
from gigabrain_zenoh.navigation.grid_search import GridSearch
from gigabrain_zenoh.qa.bench.reachable import reachable_poses
from gigabrain_zenoh.qa.bench.slam_world import GrowthSampler, MapGrowth
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    ProcessGroup,
    measured_robot,
    report_of,
    rss_mb,
)

START_TIMEOUT_S = 600.0  # for a robot's processes and its first map, on a busy machine
MIN_REACHED = 0.99  # share of all goals
CAPACITY_AH = 1000.0  # battery for runs of many hours; a burger's own one lasts two hours
MAX_GOAL_COST = 5.0  # low enough that the body can turn at a goal
MAX_SILENCE_S = 60.0  # of the task queue; a busy host may pause for seconds
MIN_DISTANCE_M = 1.0  # from the robot to its next goal
REACHED_M, REACHED_RAD = 0.5, math.radians(15)  # by the true pose

Progress = Callable[[str], None]
T = TypeVar("T")


class GoalCourse(Struct, frozen=True, kw_only=True):
    """Goals and duration of a run."""

    goals: int
    meetings: int = 0  # least number, with the person
    hours: float = 0.0  # least duration, of the robot's time
    speed: float = 5.0
    seed: int = 0
    headings: bool = False  # all goals have a heading, and the body's motions can reach them
    link: LinkName = "sim"
    logs: Path | None = None  # folder of the processes' logs


class GoalFailure(Struct, frozen=True, kw_only=True):
    """A goal that was not reached."""

    goal: Goal
    at: Pose  # estimated pose of the robot
    seconds: float  # of the robot's time, since its start
    reason: str


class GoalError(Struct, frozen=True):
    """True distance [m] and angle [rad] from a goal at rest."""

    m: float
    rad: float | None  # None without a wanted heading


def missed_by(off: GoalError) -> str:
    """Return why a goal that was reported as reached was not; empty if it was."""
    if off.m > REACHED_M:
        return f"reported as reached, {off.m:.2f} m from the goal"
    if off.rad is not None and off.rad > REACHED_RAD:
        return f"reported as reached, {math.degrees(off.rad):.0f} degrees from the heading"
    return ""


class GoalFigures(Struct, frozen=True, kw_only=True):
    """Figures of one body in one world."""

    body: str
    world: str
    speed: float
    accepted_s: float  # host's time from the start of the processes to the first accepted task
    explored: str  # end state of exploring
    explored_s: float  # of the robot's time
    goals: int
    reached: int
    off: tuple[GoalError, ...]  # of all goals reported as reached
    contacts: int
    min_clearance_m: float
    met: int  # how often the person stopped for the robot
    distance_m: float
    seconds: float  # total, of the robot's time
    alone: int  # ticks that did not wait for the brain, as the host was too busy
    failures: tuple[GoalFailure, ...]
    growth: MapGrowth  # of perception

    @property
    def worst_m(self) -> float:
        """Greatest distance from a goal at rest [m]."""
        return max((off.m for off in self.off), default=0.0)

    @property
    def worst_rad(self) -> float:
        """Greatest angle from a wanted heading at rest [rad]."""
        return max((off.rad for off in self.off if off.rad is not None), default=0.0)

    @property
    def seconds_per_goal(self) -> float | None:
        """Mean time from one goal to the next, by the robot's clock [s]; None without goals."""
        return (self.seconds - self.explored_s) / self.goals if self.goals else None

    @property
    def ok(self) -> bool:
        """True without contacts and with nearly all goals reached."""
        return self.contacts == 0 and self.reached >= MIN_REACHED * self.goals


class GoalsResult(Struct, frozen=True, kw_only=True):
    """Figures of all bodies in all worlds."""

    seed: int
    runs: tuple[GoalFigures, ...]

    @property
    def ok(self) -> bool:
        """True if every run is ok."""
        return all(run.ok for run in self.runs)


async def measure_goals(
    bodies: Sequence[str], worlds: Sequence[str], course: GoalCourse, show: Progress
) -> GoalsResult:
    """Run the same course with each body in each world.

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
                link=course.link,
                resume="auto",
                router=LOOPBACK,
                perception=PerceptionConfig(mapping="slam"),
                decision=DecisionConfig(behaviour="navigate"),
            )
            runs.append(await _run(deployment, course, show))
    return GoalsResult(seed=course.seed, runs=tuple(runs))


async def _run(deployment: Deployment, course: GoalCourse, show: Progress) -> GoalFigures:
    """Run one body in one world."""
    body_name = deployment.body
    name = f"{body_name} in {deployment.world}"
    with _folder(course, name.replace(" ", "-")) as folder:
        if course.hours:
            body = str(with_capacity(robot_path(deployment.body), folder / "body"))
            deployment = msgspec.structs.replace(deployment, body=body)
        poses = None
        if course.headings:
            robot, place = load_robot(body_name), load_world(deployment.world, deployment.seed)
            poses = reachable_poses(robot.description(), place)
            show(f"{name}: {len(poses)} poses that it reaches")
        show(f"{name}: starting")
        begin_s = asyncio.get_running_loop().time()
        async with measured_robot(deployment, folder, START_TIMEOUT_S) as (group, bus):
            judge = "driver" if deployment.link == "sim" else "emulator"
            sender = GoalSender(bus, group, deployment.seed, poses, judge)
            await group.until(
                lambda: sender.is_localized, "a map, and the robot in it", START_TIMEOUT_S
            )
            show(f"{name}: exploring")
            explored = await sender.explore()
            explored_s = sender.seconds
            while not await sender.done(course.goals, course.meetings, course.hours):
                await sender.send()
                show(f"{name}: {sender.reached} of {sender.sent} reached")
            report, growth = await sender.report(), sender.growth()
    return GoalFigures(
        body=body_name,
        world=deployment.world,
        speed=deployment.speed,
        accepted_s=round(sender.accepted_s - begin_s, 2),
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
        alone=int(report.get("lockstep_timeouts", 0)),
        failures=tuple(sender.failures),
        growth=growth,
    )


def with_capacity(robot: Path, folder: Path) -> Path:
    """Copy a robot's folder, with a large battery in its simulation; return the new robot file."""
    shutil.copytree(robot.parent, folder, dirs_exist_ok=True)
    described = yaml.safe_load(robot.read_text("utf-8"))
    described["sim"] = (described.get("sim") or {}) | {"battery_capacity": CAPACITY_AH}
    copy = folder / robot.name
    copy.write_text(yaml.safe_dump(described), "utf-8")
    return copy


@contextlib.contextmanager
def _folder(course: GoalCourse, name: str) -> Iterator[Path]:
    """Yield the folder for the logs of one run."""
    if course.logs:
        folder = course.logs / name
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as temporary:
        yield Path(temporary)


class GoalSender:
    """Sends a robot to random goals; every other one has a heading.

    With `poses` (n, 3) in the world, the goals are drawn from them, all with a heading. The
    process `judge` reports the true pose.
    """

    def __init__(
        self,
        bus: Bus,
        group: ProcessGroup,
        seed: int,
        poses: Floats | None = None,
        judge: str = "driver",
    ) -> None:
        self._reachable, self._judge = poses, judge
        self._bus, self._group, self._tasks = bus, group, Tasks(bus, silent_s=MAX_SILENCE_S)
        self._maps, self._poses, self._bodies = bus.latest(MAP), bus.latest(POSE), bus.latest(BODY)
        self._states = bus.latest(STATE)  # the others accept only messages of its boot
        self._random, self._search = np.random.default_rng(seed), GridSearch()
        self._world_from_map: Pose | None = None
        self._growth_sampler = GrowthSampler()
        self.sent = self.reached = 0
        self.accepted_s = 0.0  # of the first task, by the host's clock
        self.failures: list[GoalFailure] = []
        self.off: list[GoalError] = []  # of all goals reported as reached

    @property
    def seconds(self) -> float:
        """The robot's time [s]."""
        return self._bus.time.tick * TICK_NS / 1e9

    @property
    def is_localized(self) -> bool:
        """True once the robot is localized in a map."""
        pose = self._poses.current
        return bool(self._maps.current and self._bodies.current and pose and pose.localized)

    async def explore(self) -> str:
        """Explore from the origin of the map; return the end state and its reason."""
        truth = await self._true_pose()
        self._world_from_map = compose(truth, inverse(self._estimated_pose()))
        task = await self._tasks.explore()
        self.accepted_s = asyncio.get_running_loop().time()
        ended = await self._while_running(self._tasks.result(task))
        return f"{ended.state}: {ended.reason}"

    async def send(self) -> None:
        """Send the robot to a random goal, and wait for the result."""
        # retry: a person who blocks all ways walks on after a while
        goal = await self._retry(GigabrainError, self.random_goal)
        self.sent += 1
        reason = await self._go(goal)
        if not reason:
            off = await self._error_at(goal)
            self.off.append(off)
            reason = missed_by(off)
        if reason:
            seconds, here = round(self.seconds, 2), self._estimated_pose()
            self.failures.append(GoalFailure(goal=goal, at=here, seconds=seconds, reason=reason))
        else:
            self.reached += 1

    async def done(self, goals: int, meetings: int, hours: float) -> bool:
        """Return whether there were enough goals, hours and meetings."""
        if self.sent < goals or self.seconds < hours * 3600:
            return False
        return not meetings or (await self.report())["person_stood"] >= meetings

    def growth(self) -> MapGrowth:
        """Return the growth of perception's memory and map."""
        assert self._maps.current
        return self._growth_sampler.growth(self._maps.current)

    def _sample(self) -> None:
        """Sample perception once per minute of the robot's time."""
        pid, grid = self._group.supervisor.statuses["perception"].pid, self._maps.current
        if pid and grid and self.seconds >= (self._growth_sampler.minutes + 1) * 60:
            self._growth_sampler.minute(rss_mb(pid), grid)

    async def report(self) -> dict[str, float]:
        """Return the simulation's true values. Raises GigabrainError if they never arrive."""
        truth: dict[str, float] = {}
        while not truth:
            await self._group.poll()
            report = await report_of(self._bus, self._judge)
            truth = {k: float(v) for k, v in report.items() if isinstance(v, int | float)}
        return truth

    async def _go(self, goal: Goal) -> str:
        """Drive to a goal; return the reason of a failure, empty on success."""
        try:
            task = await self._send_goal(goal)
            ended = await self._while_running(self._tasks.result(task))
        except Refused as refusal:
            return f"refused: {refusal}"
        return "" if ended.state == "succeeded" else f"{ended.state}: {ended.reason}"

    async def _send_goal(self, goal: Goal) -> str:
        """Send a goal and return the task's name; repeat while a busy host does not answer."""
        return await self._retry(BodyLost, lambda: self._tasks.go_to(goal.x, goal.y, goal.yaw))

    async def _retry(self, error: type[GigabrainError], work: Callable[[], Awaitable[T]]) -> T:
        """Repeat `work` for up to a minute while it raises `error`."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + MAX_SILENCE_S
        while True:
            try:
                return await work()
            except error:
                if loop.time() > end_s:
                    raise
            await self._group.poll()

    async def _error_at(self, goal: Goal) -> GoalError:
        assert self._world_from_map
        target = compose(self._world_from_map, Pose(x=goal.x, y=goal.y, yaw=goal.yaw or 0.0))
        truth = await self._true_pose()
        turn = None if goal.yaw is None else abs(wrap_angle(truth.yaw - target.yaw))
        return GoalError(math.hypot(truth.x - target.x, truth.y - target.y), turn)

    async def _true_pose(self) -> Pose:
        truth = await self.report()
        return Pose(x=truth["true_x"], y=truth["true_y"], yaw=truth["true_yaw"])

    def _estimated_pose(self) -> Pose:
        pose = self._poses.current
        assert pose
        return Pose(x=pose.x, y=pose.y, yaw=pose.yaw)

    async def random_goal(self) -> Goal:
        """Return a random reachable goal. Raises GigabrainError if there is none."""
        if self._reachable is not None:
            return await self._reachable_goal(self._reachable)
        x, y = await self._random_place()
        yaw = float(self._random.uniform(-math.pi, math.pi)) if self.sent % 2 else None
        return Goal(x=x, y=y, yaw=yaw)

    async def _reachable_goal(self, poses: Floats) -> Goal:
        """Return one of `poses` in the map, away from the robot."""
        assert self._world_from_map
        here = await self._true_pose()
        far = poses[np.hypot(poses[:, 0] - here.x, poses[:, 1] - here.y) > MIN_DISTANCE_M]
        if not len(far):
            raise GigabrainError("the body's own motions lead nowhere from where it starts")
        x, y, yaw = far[int(self._random.integers(len(far)))].tolist()
        in_map = compose(inverse(self._world_from_map), Pose(x=x, y=y, yaw=yaw))
        return Goal(x=in_map.x, y=in_map.y, yaw=wrap_angle(in_map.yaw))

    async def _random_place(self) -> Point:
        """Return a reachable place in the map where the body can turn."""
        grid, body, here = self._maps.current, self._bodies.current, self._estimated_pose()
        assert grid
        assert body
        costs = costmap(grid, inflation(body.description, "forbid"))
        start = costs.cell(here.x, here.y)
        if start is None:
            raise GigabrainError("the robot is outside its map, so it has no goal")
        way = self._search.field(costs.cost, start, "from") * costs.resolution
        rows, columns = np.nonzero(
            (costs.cost < MAX_GOAL_COST) & (way > MIN_DISTANCE_M) & np.isfinite(way)
        )
        if not len(rows):
            raise GigabrainError("no place can be reached from the robot's pose")
        one = int(self._random.integers(len(rows)))
        x, y = costs.points(rows[one : one + 1], columns[one : one + 1])[0].tolist()
        return x, y

    async def _while_running(self, work: Awaitable[T]) -> T:
        """Wait for `work`. Raises GigabrainError when a process dies or the gate latches."""
        waiting = asyncio.ensure_future(work)
        try:
            while not waiting.done():
                await self._group.poll()
                self._raise_if_latched()
                self._sample()
            return await waiting
        finally:
            waiting.cancel()

    def _raise_if_latched(self) -> None:
        """Raise GigabrainError if only a person can make the robot drive again."""
        state = self._states.current
        latching = [cause.text for cause in state.gate.causes if cause.latching] if state else []
        if state and state.gate.mode == "latched" and latching:
            raise GigabrainError(f"the robot has latched: {', '.join(latching)}")
