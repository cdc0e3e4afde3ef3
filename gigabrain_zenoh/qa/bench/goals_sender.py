"""Sends a robot to places drawn at random, and keeps account of what becomes of it."""

import asyncio
import math
from collections.abc import Awaitable
from typing import TypeVar

import numpy as np
from msgspec import Struct

from gigabrain_schemas.base import TICK_NS, Pose
from gigabrain_schemas.tasks import Goal
from gigabrain_schemas.topics import BODY, MAP, POSE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.errors import BodyLost, GigabrainError, Refused
from gigabrain_zenoh.geometry.planar import compose, inverse, wrapped
from gigabrain_zenoh.navigation.costmap import costmap, inflation
from gigabrain_zenoh.navigation.planner import Point
from gigabrain_zenoh.navigation.search import Search
from gigabrain_zenoh.qa.bench.group import Group, driver_report, rss_bytes
from gigabrain_zenoh.qa.bench.growth import Growth, Watch

EASY = 5.0  # a goal's cost at most: the body turns there as well
SILENT_S = 60.0  # without an answer or a word of the tasks: a host may stand still for seconds
FAR_M = 1.0  # from the robot to its next goal, at least
THERE_M, THERE_RAD = 0.5, math.radians(15)  # by the physics; farther off it is not there

T = TypeVar("T")


class Failure(Struct, frozen=True, kw_only=True):
    """A goal that was not reached."""

    goal: Goal
    at: Pose  # where the robot thinks that it is
    seconds: float  # of the robot's time, since its start
    reason: str


class Off(Struct, frozen=True):
    """How far from a goal the robot came to rest, by the physics."""

    m: float
    rad: float | None  # None where any heading would do


def elsewhere(off: Off) -> str:
    """Why a robot that says that it is there is not; nothing if it is."""
    if off.m > THERE_M:
        return f"it said that it is there, {off.m:.2f} m from it"
    if off.rad is not None and off.rad > THERE_RAD:
        return f"it said that it is there, turned by {math.degrees(off.rad):.0f} degrees"
    return ""


class Sender:
    """Sends a robot about. Every other goal has a heading."""

    def __init__(self, bus: Bus, group: Group, seed: int) -> None:
        self._bus, self._group, self._tasks = bus, group, Tasks(bus, silent_s=SILENT_S)
        self._maps, self._poses, self._bodies = bus.latest(MAP), bus.latest(POSE), bus.latest(BODY)
        self._states = bus.latest(STATE)  # also: which start of the driver all else has to be of
        self._random, self._search = np.random.default_rng(seed), Search()
        self._world_from_map: Pose | None = None
        self._watch = Watch()
        self.sent = self.reached = 0
        self.accepted_s = 0.0  # when, by the host's clock, the first task was
        self.failures: list[Failure] = []
        self.off: list[Off] = []  # wherever it said that it was there

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
            reason = elsewhere(off)
        if reason:
            seconds, here = round(self.seconds, 2), self._here()
            self.failures.append(Failure(goal=goal, at=here, seconds=seconds, reason=reason))
        else:
            self.reached += 1

    async def done(self, goals: int, meetings: int, hours: float) -> bool:
        """Whether it was sent often and long enough, and has met the person often enough."""
        if self.sent < goals or self.seconds < hours * 3600:
            return False
        return not meetings or (await self.report())["person_stood"] >= meetings

    def growth(self) -> Growth:
        """What perception's memory and map have come to."""
        assert self._maps.current
        return self._watch.growth(self._maps.current)

    def _sample(self) -> None:
        """Take a sample of perception each minute of the robot's time."""
        pid, grid = self._group.supervisor.statuses["perception"].pid, self._maps.current
        if pid and grid and self.seconds >= (self._watch.minutes + 1) * 60:
            self._watch.minute(rss_bytes(pid), grid)

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
        until = now() + SILENT_S
        while True:
            try:
                return await self._tasks.go_to(goal.x, goal.y, goal.yaw)
            except BodyLost:
                if now() > until:
                    raise
            await self._group.look()

    async def _off(self, goal: Goal) -> Off:
        assert self._world_from_map
        there = compose(self._world_from_map, Pose(x=goal.x, y=goal.y, yaw=goal.yaw or 0.0))
        truth = await self._true_pose()
        turn = None if goal.yaw is None else abs(wrapped(truth.yaw - there.yaw))
        return Off(math.hypot(truth.x - there.x, truth.y - there.y), turn)

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
        until = now() + SILENT_S
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
        rows, columns = np.nonzero((made.cost < EASY) & (way > FAR_M) & np.isfinite(way))
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
