"""`gigabrain bench clutter`: whole robots drive to goals in cluttered worlds, judged by physics."""

import asyncio
import contextlib
import math
import tempfile
from collections.abc import Awaitable, Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

import msgspec
from msgspec import Struct

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.topics import BODY, MAP, POSE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.errors import BodyLost, ConfigError, Refused
from gigabrain_zenoh.geometry.pose import ORIGIN, compose, inverse
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.navigation.global_planner import warm_up
from gigabrain_zenoh.qa.bench.cluttered_worlds import (
    GOALS,
    ClutteredWorld,
    Point,
    draw_cluttered,
    write_world,
)
from gigabrain_zenoh.qa.judging import Failed
from gigabrain_zenoh.qa.robot_under_test import (
    LOOPBACK,
    ProcessGroup,
    measured_robot,
    report_of,
)

START_TIMEOUT_S = 600.0  # for a robot's processes and its first map, on a busy machine
LOCKSTEP_TIMEOUT_S = 3.0  # shorter than the timeout of a stuck process
MAX_SILENCE_S = 120.0  # of the task queue and of the driver
SETTLED_S = 3.0  # after the first goal; before, refused goals are sent again
REACHED_M = 0.3  # from the goal, at rest, by the true pose
MIN_REACHED = 8  # goals per world
POLLS_PER_LOOK = 5  # polls of the processes per request of the true pose

Progress = Callable[[str], None]
T = TypeVar("T")


class ClutterCourse(Struct, frozen=True, kw_only=True):
    """The settings of a run through cluttered worlds."""

    body: str = "turtlebot3_waffle"
    cameras: bool = True
    speed: float = 3.0  # simulated over real time
    seconds: float = 120.0  # in each world, of the robot's time
    logs: Path | None = None  # folder of the worlds and of the processes' logs


class Incident(Struct, frozen=True, kw_only=True):
    """A contact or a fall, by the physics."""

    what: str  # contact or fall
    near: str  # kind of the nearest object
    at: Pose  # in the world
    seconds: float  # since the first goal


class MissedGoal(Struct, frozen=True, kw_only=True):
    """A goal that was not reached."""

    number: int
    at: Pose  # of the robot, in the world
    goal: Point  # in the world
    seconds: float  # since the first goal
    reason: str


class ClutterRun(Struct, frozen=True, kw_only=True):
    """Results of one world, with cameras or with lidar alone."""

    seed: int
    cameras: bool
    reached: int
    contacts: int
    falls: int
    min_clearance_m: float
    distance_m: float
    seconds: float  # from the first goal to the end
    alone: int  # ticks that did not wait for the brain
    incidents: tuple[Incident, ...] = ()
    missed: tuple[MissedGoal, ...] = ()

    @property
    def unharmed(self) -> bool:
        """True without contacts and falls."""
        return not (self.contacts or self.falls)

    @property
    def ok(self) -> bool:
        """True if the robot also reached most goals."""
        return self.unharmed and self.reached >= MIN_REACHED


class ClutterResult(Struct, frozen=True, kw_only=True):
    """Results of all worlds so far."""

    body: str
    speed: float
    seconds: float
    runs: tuple[ClutterRun, ...] = ()

    def of(self, cameras: bool) -> list[ClutterRun]:
        """Return the runs with or without cameras."""
        return [one for one in self.runs if one.cameras == cameras]

    def has(self, seed: int, cameras: bool) -> bool:
        """Return whether there is a run in the world of a seed."""
        return any((one.seed, one.cameras) == (seed, cameras) for one in self.runs)


def seeds_of(text: str) -> tuple[int, ...]:
    """Return the seeds of a text such as `0-9` or `3,5,20-22`. Raises ConfigError."""
    found: list[int] = []
    for part in text.split(","):
        low, dash, high = part.strip().partition("-")
        high = high if dash else low
        if not (low.isdecimal() and high.isdecimal() and int(low) <= int(high)):
            raise ConfigError(f"--seeds: expected numbers as in 0-9 or 3,5,20-22, got {text!r}")
        found += range(int(low), int(high) + 1)
    return tuple(dict.fromkeys(found))


def earlier(path: Path | None, course: ClutterCourse) -> ClutterResult:
    """Read earlier results, or return empty ones. Raises ConfigError for another course."""
    fresh = ClutterResult(body=course.body, speed=course.speed, seconds=course.seconds)
    if path is None or not path.exists():
        return fresh
    try:
        found = msgspec.json.decode(path.read_bytes(), type=ClutterResult)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(f"{path}: no results of `gigabrain bench clutter`: {error}") from None
    if msgspec.structs.replace(found, runs=()) != fresh:
        raise ConfigError(
            f"{path}: it has results of {found.body} at speed {found.speed:g}, "
            f"{found.seconds:g} s each; name another file"
        )
    return found


async def measure_clutter(
    seeds: Sequence[int],
    course: ClutterCourse,
    result: ClutterResult,
    done: Callable[[ClutterResult], None],
    show: Progress,
) -> ClutterResult:
    """Drive in the worlds that `result` lacks; call `done` after each.

    Raises GigabrainError when a process dies on the way.
    """
    warm_up()
    description = load_robot(course.body).description()
    for seed in seeds:
        if result.has(seed, course.cameras):
            continue
        world = draw_cluttered(seed, description)
        with _folder(course, seed) as folder:
            run = await _drive(world, course, folder)
        runs = sorted((*result.runs, run), key=lambda one: (not one.cameras, one.seed))
        result = msgspec.structs.replace(result, runs=tuple(runs))
        done(result)
        show(in_words(run))
    return result


def in_words(run: ClutterRun) -> str:
    """Return the result of one world as text."""
    text = f"world {run.seed}{'' if run.cameras else ', lidar alone'}: {run.reached} of {GOALS}"
    text += f" goals, {run.contacts} contacts, {run.falls} falls, {run.distance_m:.1f} m"
    for one in run.incidents:
        text += f"; {one.what} after {one.seconds:.1f} s at ({one.at.x:.2f}, {one.at.y:.2f}, "
        text += f"{one.at.yaw:.2f}) near a {one.near}"
    for missed in run.missed:
        text += f"; goal {missed.number} at {missed.goal} after {missed.seconds:.0f} s: "
        text += missed.reason
    return text


@contextlib.contextmanager
def _folder(course: ClutterCourse, seed: int) -> Iterator[Path]:
    """Yield the folder for one world and its logs."""
    if course.logs:
        folder = course.logs / f"{seed}{'' if course.cameras else '-lidar'}"
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
        return
    with tempfile.TemporaryDirectory(prefix="gigabrain-") as temporary:
        yield Path(temporary)


def lock_stepped(
    body: str, world: Path, seed: int, speed: float, *, cameras: bool = True
) -> Deployment:
    """Return a deployment that maps a world in lock-step."""
    return Deployment(
        body=body,
        world=str(world),
        seed=seed,
        speed=speed,
        lockstep_timeout_s=LOCKSTEP_TIMEOUT_S,
        resume="auto",
        router=LOOPBACK,
        cameras=cameras,
        perception=PerceptionConfig(mapping="slam"),
        decision=DecisionConfig(behaviour="navigate", settings={"unknown_space": "allow"}),
    )


async def _drive(world: ClutteredWorld, course: ClutterCourse, folder: Path) -> ClutterRun:
    deployment = lock_stepped(
        course.body, write_world(world, folder), world.seed, course.speed, cameras=course.cameras
    )
    async with measured_robot(deployment, folder, START_TIMEOUT_S) as (group, bus):
        driver = CourseDriver(bus, group, world, course.seconds)
        await driver.drive()
        report = await driver.look()
    return ClutterRun(
        seed=world.seed,
        cameras=course.cameras,
        reached=driver.reached,
        contacts=int(report["contacts"]),
        falls=int(report["falls"]),
        min_clearance_m=report["min_clearance_m"],
        distance_m=report["distance_m"],
        seconds=round(driver.seconds, 2),
        alone=int(report["lockstep_timeouts"]),
        incidents=tuple(driver.incidents),
        missed=tuple(driver.missed),
    )


class Over(Exception):
    """Time is up, or the robot cannot drive on; the text is the reason."""


class CourseDriver:
    """Sends a robot to the goals of a world in turn, and records contacts and falls."""

    def __init__(
        self, bus: Bus, group: ProcessGroup, world: ClutteredWorld, seconds: float
    ) -> None:
        self._bus, self._group, self._world, self._longest_s = bus, group, world, seconds
        self.tasks = Tasks(bus, starting_s=MAX_SILENCE_S, silent_s=MAX_SILENCE_S)
        self._maps, self._poses, self._bodies = bus.latest(MAP), bus.latest(POSE), bus.latest(BODY)
        self._states = bus.latest(STATE)
        self._began_s = 0.0
        self._truth: dict[str, float] = {}
        self.world_from_map = ORIGIN  # pose of the map in the world
        self.reached = 0
        self.incidents: list[Incident] = []
        self.missed: list[MissedGoal] = []

    @property
    def seconds(self) -> float:
        """The robot's time since the first goal [s]."""
        return self._bus.time.tick * TICK_NS / 1e9 - self._began_s

    async def begin(self) -> None:
        """Wait until the robot has a map, and find the map's pose in the world."""
        await self._group.until(self._is_localized, "a map, and the robot in it", START_TIMEOUT_S)
        await self.look()
        here = self._poses.current
        assert here
        in_map = Pose(x=here.x, y=here.y, yaw=here.yaw)
        self.world_from_map = compose(self._true_pose(), inverse(in_map))
        self._began_s += self.seconds

    async def drive(self) -> None:
        """Send the robot to all goals, until time is up."""
        await self.begin()
        over, world_from_map = "", self.world_from_map
        for number, (x, y) in enumerate(self._world.goals, 1):
            goal = compose(inverse(world_from_map), Pose(x=x, y=y, yaw=0.0))
            try:
                reason = over or await self._go(goal.x, goal.y)
            except Over as end:
                reason = over = str(end)
            off = await self._distance_to(x, y)
            if not reason and off > REACHED_M:
                reason = f"reported as reached, {off:.2f} m from the goal"
            if not reason:
                self.reached += 1
                continue
            seconds, at = round(self.seconds, 2), self._true_pose()
            self.missed.append(
                MissedGoal(number=number, at=at, goal=(x, y), seconds=seconds, reason=reason)
            )

    async def look(self) -> dict[str, float]:
        """Return the simulation's true values, and record new contacts and falls."""
        before, truth = self._truth, dict[str, float]()
        end_s = asyncio.get_running_loop().time() + MAX_SILENCE_S
        while not truth:
            if asyncio.get_running_loop().time() > end_s:
                raise Failed("the driver does not answer")
            await self._group.poll()
            report = await report_of(self._bus)
            truth = {k: float(v) for k, v in report.items() if isinstance(v, int | float)}
        self._truth = truth
        for what in ("contact", "fall"):
            if truth[f"{what}s"] > before.get(f"{what}s", 0.0):
                at = self._true_pose()
                near = self._world.name_near(at.x, at.y)
                seconds = round(self.seconds, 2)
                self.incidents.append(Incident(what=what, near=near, at=at, seconds=seconds))
        return truth

    async def _go(self, x: float, y: float) -> str:
        """Drive to a goal in the map; return the reason of a failure, empty on success."""
        try:
            task = await self.accepted(lambda: self.tasks.go_to(x, y))
            ended = await self.while_running(self.tasks.result(task))
        except (Refused, BodyLost) as refusal:
            return f"refused: {refusal}"
        return "" if ended.state == "succeeded" else f"{ended.state}: {ended.reason}"

    async def accepted(self, ask: Callable[[], Awaitable[str]]) -> str:
        """Return the name of the accepted task. Ask again while the robot may not know its pose."""
        loop = asyncio.get_running_loop()
        end_s = loop.time() + MAX_SILENCE_S
        while True:
            try:
                return await self.while_running(ask())
            except Refused:
                if self.seconds > SETTLED_S:
                    raise
            if loop.time() > end_s:
                raise Failed("the robot's time stands still")

    async def while_running(self, work: Awaitable[T]) -> T:
        """Wait for `work`. Raises Over, and GigabrainError when a process dies."""
        waiting, polls = asyncio.ensure_future(work), 0
        try:
            while not waiting.done():
                await self._group.poll()
                polls += 1
                if polls % POLLS_PER_LOOK == 0:
                    await self.look()
                self._raise_if_over()
            return await waiting
        finally:
            waiting.cancel()

    def _raise_if_over(self) -> None:
        if self._truth.get("falls"):
            raise Over("it has fallen")
        if self.seconds > self._longest_s:
            raise Over(f"{self._longest_s:g} s are over: {self._current_activity()}")
        state = self._states.current
        latching = [cause.text for cause in state.gate.causes if cause.latching] if state else []
        if state and state.gate.mode == "latched" and latching:
            raise Over(f"it has latched: {', '.join(latching)}")

    def _current_activity(self) -> str:
        newest = self.tasks.newest
        return newest.current.reason if newest and newest.current else "no task"

    def _is_localized(self) -> bool:
        pose = self._poses.current
        return bool(self._maps.current and self._bodies.current and pose and pose.localized)

    def _true_pose(self) -> Pose:
        truth = self._truth
        return Pose(x=truth["true_x"], y=truth["true_y"], yaw=truth["true_yaw"])

    async def _distance_to(self, x: float, y: float) -> float:
        await self.look()
        here = self._true_pose()
        return math.hypot(here.x - x, here.y - y)
