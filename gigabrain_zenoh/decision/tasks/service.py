"""Tasks on the bus: what is asked for is queued, what becomes of it is told and written down."""

import asyncio
import logging
from typing import Any, Protocol

from msgspec.structs import replace

from gigabrain_schemas.body import RobotState
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
from gigabrain_schemas.topics import GOAL, MISSION, TASK, TASK_CHANGE, Service
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.decision.tasks import checks
from gigabrain_zenoh.decision.tasks.executive import Executive, Saved
from gigabrain_zenoh.decision.tasks.mission import Mission
from gigabrain_zenoh.decision.tasks.orders import Order, Outcome, became
from gigabrain_zenoh.decision.tasks.scripts import Scripts
from gigabrain_zenoh.decision.tasks.store import TaskFile
from gigabrain_zenoh.decision.tasks.watching import Watched
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

TOLD_TICKS = 10  # from one robot/task to the next: 5 Hz


class Driver(Protocol):
    """Whoever carries out orders."""

    async def can_reach(self, goal: Goal) -> str:
        """How it would get there, in words. Raises Refused, and why."""
        ...

    async def can_drive(self) -> None:
        """Raises Refused where it does not know its way at all, with what to change."""
        ...


class TaskService:
    """Serves goals, missions and changes, and steps whatever is to be done."""

    def __init__(self, bus: Bus, driver: Driver, *, folder: str = "", scripts: str = "") -> None:
        self._bus, self._driver = bus, driver
        self._scripts, self._watched, file = Scripts(scripts), Watched(bus), TaskFile(folder)
        saved, problem = file.read()
        if problem:
            log.warning("%s", problem, extra={"data": {"event": "tasks"}})
        self._tasks = Executive(self._watched.read, self._scripts.start, saved)
        self._scribe: BackgroundWriter[Saved] = BackgroundWriter(file.write, 1)
        self._written, self._unwritable = saved, Fault(log)
        self._boot = self._tick = self._told_tick = self._basis = 0
        self._said: dict[str, str] = {}
        self._waits = ""  # what all wait for, before the first step
        bus.serve(GOAL, self._goal)
        bus.serve(MISSION, self._mission)
        bus.serve(TASK_CHANGE, self._change)

    def tell(self, waits: str) -> None:
        """Say how it stands before there is anybody to drive, and what that `waits` for."""
        self._waits = waits
        self._tell()

    def step(self, state: RobotState, outcome: Outcome | None, basis: int = 0) -> Order | None:
        """Go on, with the world of tick `basis`; what is wanted of whoever drives."""
        self._waits = ""
        again = state.boot == self._boot
        seconds = max(0, state.tick - self._tick) * 0.02 if again else 0.0
        self._boot, self._tick, self._basis = state.boot, state.tick, basis
        if not again:
            self._tasks.meet(state.boot)
            self._told_tick = 0
        self._watched.see(state)
        order = self._tasks.step(seconds, outcome)
        if not 0 <= state.tick - self._told_tick < TOLD_TICKS or self._ended():
            self._tell()
        return order

    @property
    def waits(self) -> str:
        """What the robot waits for where `step` wants nothing, in words."""
        return self._tasks.waits

    def begin(self, mission: Mission, label: str, boot: int) -> None:
        """Something to do where nobody has wanted anything yet since this start of the driver."""
        if self._tasks.idle and not self._tasks.knows(boot):
            self._tasks.carry_out(mission, label, "queue", "itself")

    async def close(self) -> None:
        """Once all is written down."""
        await self._scribe.close()

    def _ended(self) -> bool:
        done = self._tasks.status.done
        return bool(done) and done[0].id not in self._said

    def _tell(self) -> None:
        """Say how it stands, and write it down where it has changed."""
        self._told_tick = self._tick
        status = self._bus.publish(TASK, self._status())
        for task in reversed(status.done):
            if task.id not in self._said:
                data = {"event": "task", "task": task.id, "state": task.state}
                log.info("%s", became(task), extra={"data": data})
        self._said = {task.id: task.state for task in status.done}
        saved = self._tasks.saved
        if saved != self._written:
            self._written = saved
            self._scribe.put(saved).add_done_callback(lambda written: self._note(written.result()))

    def _status(self) -> TaskStatus:
        status = self._tasks.status
        if not self._waits or status.current is None or status.current.state != "active":
            return status
        return replace(status, current=replace(status.current, reason=self._waits))

    def _note(self, problem: str) -> None:
        if problem:
            self._unwritable.begin(problem)
        else:
            self._unwritable.end("tasks are written down again")

    async def _goal(self, request: GoalRequest) -> GoalReply:
        goal = Goal(x=request.x, y=request.y, yaw=request.yaw)
        try:
            way = await self._driver.can_reach(goal)
            name = self._tasks.go_to(goal, request.how, request.source)
        except GigabrainError as error:
            self._refuse("goal", request.source, error)
            return GoalReply(ok=False, text=str(error)[:500])
        self._accept(name, GOAL, request)
        return GoalReply(ok=True, text=f"{name}: {way}"[:500], goal=name)

    async def _mission(self, request: MissionRequest) -> MissionReply:
        label = request.label or "mission"
        try:
            # a long one takes a tenth of a second to read, which no scan should wait for
            mission = await asyncio.to_thread(checks.loads, request.mission, label)
            for script in checks.scripts(mission):
                self._scripts.path(script)
            if checks.drives(mission):
                await self._driver.can_drive()
            name = self._tasks.carry_out(mission, label, request.how, request.source)
        except GigabrainError as error:
            self._refuse("mission", request.source, error)
            return MissionReply(ok=False, text=str(error)[:500])
        self._accept(name, MISSION, request)
        return MissionReply(ok=True, text=f"{name}: {label}"[:500], task=name)

    async def _change(self, request: TaskRequest) -> TaskReply:
        try:
            if request.do == "cancel":
                text = self._tasks.cancel(request.task, request.source)
            elif request.do == "pause":
                text = self._tasks.pause(request.task, request.source)
            else:
                text = self._tasks.resume(request.task)
        except GigabrainError as error:
            return TaskReply(ok=False, text=str(error)[:500], task=request.task)
        log.info("%s, says %s", text, request.source, extra={"data": {"event": "task"}})
        self._grant(TASK_CHANGE, request)
        return TaskReply(ok=True, text=text[:500], task=request.task)

    def _accept(
        self, name: str, of: Service[Any, Any], request: GoalRequest | MissionRequest
    ) -> None:
        data = {"event": "task", "task": name, "source": request.source}
        log.info("%s is wanted by %s", name, request.source, extra={"data": data})
        self._grant(of, request)

    def _grant(
        self, of: Service[Any, Any], request: GoalRequest | MissionRequest | TaskRequest
    ) -> None:
        """Tell from when on a request counts, so that a recording holds all that we go by."""
        log_accepted(self._bus, of.key, request, self._basis)
        self._tell()

    def _refuse(self, what: str, source: str, error: GigabrainError) -> None:
        data = {"event": "task refused", "source": source}
        log.warning("%s refused to %s: %s", what, source, error, extra={"data": data})
