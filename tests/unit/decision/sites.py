"""Task execution in memory: the task queue and the task server, with time set by the test."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.tasks import (
    Goal,
    GoalReply,
    GoalRequest,
    MissionReply,
    MissionRequest,
    TaskReply,
    TaskRequest,
    TaskStatus,
)
from gigabrain_schemas.topics import GOAL, MISSION, STATE, TASK, TASK_CHANGE, Topic
from gigabrain_zenoh.decision.behaviours import DriveCommand, StepOutcome
from gigabrain_zenoh.decision.context import ContextSource
from gigabrain_zenoh.decision.task_server import TaskServer
from gigabrain_zenoh.decision.tasks import mission_files
from gigabrain_zenoh.decision.tasks.mission import Script
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskQueue
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.testing.in_memory import Net
from gigabrain_zenoh.testing.samples import BOOT, state
from gigabrain_zenoh.testing.waiting import settle

PLACES = "places: {dock: [0, 0, 1.5], a: [1, 0], b: [2, 0], c: [3, 0]}\n"


class Program:
    """A program of the host that the test ends by its `result`."""

    def __init__(self, script: Script) -> None:
        self.script, self.stopped, self.paused = script, False, False
        self.result: tuple[bool, str] | None = None

    def pause(self) -> None:
        self.paused = True

    def resume(self) -> None:
        self.paused = False

    def stop(self) -> None:
        self.stopped = True


class Robot:
    """A task queue with time and outcomes set by the test."""

    def __init__(self, saved: Saved | None = None) -> None:
        self.charge, self.programs = 100.0, list[Program]()
        self.pose: PoseInMap | None = None
        self.tasks = TaskQueue(self._read, self._start, saved or Saved())
        self.command: DriveCommand | None = None
        self.outcome: StepOutcome | None = None

    def carry_out(self, text: str, how: Any = "replace") -> str:
        return self.tasks.add_mission(mission_files.loads(PLACES + text, "m"), "m", how, "ann")

    def step(self, seconds: float = 0.1) -> float | str | None:
        """Step once; return the x of the goal, the kind of another command, or None."""
        self.command, _ = self.tasks.step(seconds, self.outcome)
        self.outcome = None
        return _short(self.command)

    def reached(self) -> float | str | None:
        """Report that the robot arrived, and return the result of the next step."""
        return self._report("done", "it is there")

    def failed(self, why: str = "no way") -> float | str | None:
        """Report that the robot cannot arrive, and return the result of the next step."""
        return self._report("failed", why)

    @property
    def status(self) -> TaskStatus:
        return self.tasks.status

    @property
    def last(self) -> tuple[str, str]:
        """Return the state and the reason of the task that ended last."""
        return self.status.done[0].state, self.status.done[0].reason

    def _report(self, state: Any, reason: str) -> float | str | None:
        assert self.command
        self.outcome = StepOutcome(number=self.command.number, state=state, reason=reason)
        return self.step()

    def _read(self, topic: Topic[Any]) -> Message | None:
        return state(1, battery=self.charge) if topic is STATE else self.pose

    def _start(self, script: Script) -> Program:
        self.programs.append(Program(script))
        return self.programs[-1]


def _short(command: DriveCommand | None) -> float | str | None:
    if command and command.goal:
        return command.goal.x
    return command.kind if command else None


@contextmanager
def one_robot() -> Iterator[Robot]:
    """Yield a robot, and check that all its programs are stopped at the end."""
    made = Robot()
    yield made
    assert all(program.stopped for program in made.programs)


class Site:
    """A task server on a bus, with a client and outcomes set by the test."""

    def __init__(self, folder: Path, *, scripts: str = "") -> None:
        self.net = Net()
        self.wall, self.lost = "", ""
        zones = ZoneSource(self.net.one)
        self.service = TaskServer(
            self.net.one, self._check, zones, ContextSource(self.net.one, zones),
            folder=str(folder), scripts=scripts,
        )  # fmt: skip
        self.told: list[TaskStatus] = []
        self.net.two.subscribe(TASK, lambda _key, status: self.told.append(status))
        self.tick, self.command, self.outcome = 0, None, None
        self.command: DriveCommand | None
        self.outcome: StepOutcome | None

    async def _check(self, goal: Goal | None) -> str:
        if self.lost:
            raise Refused(self.lost)
        if goal and self.wall:
            raise Refused(self.wall)
        return "on the way, 4.2 m"

    async def go(self, x: float, **how: str) -> GoalReply:
        request = msgspec.convert({"x": x, "y": 0.0, "source": "ann"} | how, GoalRequest)
        return (await self.net.two.ask(GOAL, request))[0]

    async def carry_out(self, text: str) -> MissionReply:
        request = MissionRequest(mission=text, source="ann", label="tea")
        return (await self.net.two.ask(MISSION, request))[0]

    async def change(self, do: str, task: str = "") -> TaskReply:
        request = msgspec.convert({"do": do, "task": task, "source": "bob"}, TaskRequest)
        return (await self.net.two.ask(TASK_CHANGE, request))[0]

    async def step(self, ticks: int = 5, boot: int = BOOT) -> None:
        self.tick += ticks
        self.net.one.time.observe(state(self.tick, boot=boot))
        self.command, _ = self.service.step(state(self.tick, boot=boot), self.outcome)
        self.outcome = None
        await settle()

    async def end(self) -> None:
        await self.service.close()
