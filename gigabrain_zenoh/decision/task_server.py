"""Serves goals, missions and changes of tasks on the bus.

Goals are accepted from the start, while the planning kernels still compile.
"""

import asyncio
import contextlib
import logging
from collections.abc import Awaitable, Callable, Collection, Iterator
from typing import Any, NamedTuple

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Message
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
from gigabrain_schemas.topics import GOAL, MISSION, STATE, TASK, TASK_CHANGE, Service, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.freshness import PreviousTick
from gigabrain_zenoh.bus.input_log import log_accepted
from gigabrain_zenoh.decision.behaviours import (
    Command,
    Idle,
    StepOutcome,
    WaitReason,
    describe_end,
)
from gigabrain_zenoh.decision.context import ContextSource
from gigabrain_zenoh.decision.known_objects import (
    LabelSource,
    ObjectSource,
    Sought,
    Wanted,
    named,
    sought,
)
from gigabrain_zenoh.decision.tasks import arm_steps, mission_files
from gigabrain_zenoh.decision.tasks import mission as missions
from gigabrain_zenoh.decision.tasks.arm_steps import Held
from gigabrain_zenoh.decision.tasks.mission import Mission
from gigabrain_zenoh.decision.tasks.scripts import Scripts
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile, TaskQueue
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.logs import Fault

log = logging.getLogger(__name__)

STATUS_TICKS = 10  # robot/task is published at 5 Hz

# returns a text that says how the robot would reach a goal; without a goal, only checks that the
# pose in the map is known. Raises Refused
CheckGoal = Callable[[Goal | None], Awaitable[str]]


class StartMission(NamedTuple):
    """A mission that the robot begins by itself after a start."""

    mission: Mission  # parsed without the places of the map
    text: str
    label: str
    source: str  # file name, for errors


class TaskServer:
    """Serves tasks on the bus: keeps the queue, publishes its status and writes it to disk."""

    def __init__(
        self,
        bus: Bus,
        check: CheckGoal,
        zones: ZoneSource,
        source: ContextSource,
        *,
        folder: str = "",
        scripts: str = "",
    ) -> None:
        self._bus, self._check, self._zones, self._source = bus, check, zones, source
        self._objects, self._labels = ObjectSource(bus), LabelSource(bus)
        self._scripts, self._topics, file = Scripts(scripts), TopicCache(bus), TaskFile(folder)
        saved, problem = file.read()
        if problem:
            log.warning("%s", problem, extra={"data": {"event": "tasks"}})
        self._queue = TaskQueue(self._topics.read, self._scripts.start, saved, self._seek)
        self._writer: BackgroundWriter[Saved] = BackgroundWriter(file.write, 1)
        self._written: Saved | None = saved  # None after a failed write
        self._write_fault = Fault(log)
        self._boot = self._tick = self._status_tick = self._basis = 0
        self._logged: set[str] = set()  # tasks whose end was logged
        # of the map that the tasks belong to: name and `maps_loaded`, see Zones
        self._map = None if saved.maps_loaded is None else (saved.map, saved.maps_loaded)
        self._from_disk = True  # `_map` was read from disk, and not compared with the bus yet
        self._starting_reason = ""  # why tasks wait before the first step; empty afterwards
        bus.serve(GOAL, self._on_goal)
        bus.serve(MISSION, self._on_mission)
        bus.serve(TASK_CHANGE, self._on_change)

    def publish_starting(self) -> None:
        """Publish the status before the robot can drive by a map."""
        self._starting_reason = f"waiting: {WaitReason.STARTING}"
        self._publish()

    def wait(self, state: RobotState) -> None:
        """Call `publish_starting` at the status rate, in every step that advances no tasks."""
        self._tick = state.tick
        self._observe_things()
        if not 0 <= state.tick - self._status_tick < STATUS_TICKS:
            self.publish_starting()

    @property
    def held(self) -> Held | None:
        """Return what the gripper holds; None if that is nothing or unknown."""
        return self._queue.held

    def unused(self, boot: int) -> bool:
        """Return whether there is no task, and was none since this start of the driver."""
        return self._queue.is_unused(boot)

    def step(
        self, state: RobotState, outcome: StepOutcome | None, basis: int = 0
    ) -> tuple[Command | None, Idle]:
        """Advance the queue, with the world model of tick `basis`.

        Return the next command, and the reason to stand still if there is none.
        """
        self._starting_reason = ""
        same_boot = state.boot == self._boot
        seconds = max(0, state.tick - self._tick) * TICK_S if same_boot else 0.0
        self._boot, self._tick, self._basis = state.boot, state.tick, basis
        if not same_boot:
            self._queue.restart(state.boot)
            self._status_tick = 0
        self._cancel_if_map_changed()
        self._topics.observe(state)
        self._observe_things()
        command_or_idle = self._queue.step(seconds, outcome)
        if not 0 <= state.tick - self._status_tick < STATUS_TICKS or self._just_ended():
            self._publish()
        return command_or_idle

    def _cancel_if_map_changed(self) -> None:
        """Cancel all tasks if another map was loaded: their coordinates are of the old one."""
        loaded = self._zones.maps_loaded(self._boot, self._tick)
        if loaded is None:
            return
        name = self._zones.at(self._boot, self._tick).map
        before, self._map = self._map, (name, loaded)
        # saving also renames a map, but hardly ever while decision restarts
        renamed = before is not None and before[0] != name and self._from_disk
        self._from_disk = False
        changed = renamed or (before is not None and before[1] != loaded)
        if changed and self._queue.status.current:
            text = self._queue.cancel("all", "loading another map")
            log.warning("%s: another map was loaded", text, extra={"data": {"event": "task"}})

    def begin(self, start: StartMission, state: RobotState) -> bool:
        """Begin a mission, unless there were tasks since this start of the driver.

        A mission that is refused is logged. Return False while the body, or the places of the map
        that the mission names, are unknown.
        """
        now = state.boot, state.tick
        if not self.unused(state.boot):
            return True
        if self._source.body is None:
            return False
        try:
            self._check_feasible(start.mission)
            if any(missions.map_places(start.mission)) and self._zones.maps_loaded(*now) is None:
                return False
            mission = mission_files.loads(start.text, start.source, self._zones.at(*now).places)
            self._queue.add_mission(mission, start.label, "queue", "itself")
        except GigabrainError as error:
            _log_refusal("mission", "itself", error)
        return True

    def _observe_things(self) -> None:
        """Subscribe to things and their labels once the body is known to have cameras."""
        self._objects.observe(self._source.body)
        self._labels.observe(self._source.body)

    async def close(self) -> None:
        """Wait until everything is written."""
        await self._writer.close()

    def _just_ended(self) -> bool:
        done = self._queue.status.done
        return bool(done) and done[0].id not in self._logged

    def _publish(self) -> None:
        """Publish the status, and write the queue to disk if it changed."""
        self._status_tick = self._tick
        status = self._bus.publish(TASK, self._status())
        for task in reversed(status.done):
            if task.id not in self._logged:
                data = {"event": "task", "task": task.id, "state": task.state}
                log.info("%s", describe_end(task), extra={"data": data})
        self._logged = {task.id for task in status.done}
        saved = self._queue.saved
        if saved.jobs and self._map:
            saved = replace(saved, map=self._map[0], maps_loaded=self._map[1])
        if saved != self._written:
            self._written = saved
            written = self._writer.put(saved)
            written.add_done_callback(lambda done: self._on_written(done.result()))

    def _status(self) -> TaskStatus:
        status = self._queue.status
        if not self._starting_reason or status.current is None or status.current.state != "active":
            return status
        return replace(status, current=replace(status.current, reason=self._starting_reason))

    def _on_written(self, problem: str) -> None:
        if problem:  # the next status tries again: a cancelled task must not return after a restart
            self._written = None
            self._write_fault.begin(problem)
        else:
            self._write_fault.end("tasks are saved again")

    @contextlib.contextmanager
    def _in_one_map(self) -> Iterator[None]:
        """Raise Refused if another map was loaded during the block."""
        before = self._zones.newest_loaded
        yield
        if before not in (None, self._zones.newest_loaded):
            raise Refused("another map was loaded meanwhile; send the goal again for this map")

    async def _on_goal(self, request: GoalRequest) -> GoalReply:
        try:
            if request.object or request.tag is not None:
                name, path = await self._find(request)
            else:
                with self._in_one_map():
                    goal = self._goal_of(request)
                    path = await self._check(goal)
                name = self._queue.add_goal(goal, request.how, request.source, request.place)
        except GigabrainError as error:
            _log_refusal("goal", request.source, error)
            return GoalReply(ok=False, text=str(error)[:500])
        self._accept(name, GOAL, request)
        return GoalReply(ok=True, text=f"{name}: {path}"[:500], goal=name)

    def _goal_of(self, request: GoalRequest) -> Goal:
        """Return the requested goal. Raises Refused for an unknown place."""
        if request.x is None or request.y is None:
            labels = {known.label for known in self._objects.newest.objects}
            places = {place.name for place in self._zones.newest.places}
            if request.place in labels - places:
                command = f"gigabrain goto --object {request.place}"
                raise Refused(f"no place is called {request.place!r}; an object is: {command}")
            return self._zones.goal(request.place, request.yaw)
        return Goal(x=request.x, y=request.y, yaw=request.yaw)

    async def _find(self, request: GoalRequest) -> tuple[str, str]:
        """Add a goal in front of an object or a tag.

        Return its name and a text for users. Raises Refused.
        """
        wanted: Wanted = request.object if request.tag is None else request.tag
        self._check_cameras()
        self._labels.check([request.object] if request.object else [], self._objects.newest)
        await self._check(None)
        known = self._seek(wanted, (), None).target
        at = f"{known.name} is at ({known.x:.2f}, {known.y:.2f})" if known else ""
        name = self._queue.add_find(wanted, request.how, request.source)
        return name, at or f"{named(wanted)} is not known yet; looking for it"

    def _check_cameras(self) -> None:
        """Raise Refused if the body has no cameras to look around with."""
        body = self._source.body
        if body and not body.cameras:
            raise Refused("the robot has no cameras; start it with --cameras, or `cameras: on`")
        if body and not body.fixed_cameras:
            raise Refused("the robot has a camera on its arm only; finding needs one on its base")

    def _seek(self, wanted: Wanted, without: Collection[int], preferred: int | None) -> Sought:
        """Return what is known of a wanted object or tag at the current step."""
        boot, tick = self._bus.time.boot, self._bus.time.tick + 1
        if self._basis:
            boot, tick = self._boot, self._basis
        known, here = self._objects.at(boot, tick), self._source.here(boot, tick)
        return sought(known, here, wanted, without, preferred)

    async def _on_mission(self, request: MissionRequest) -> MissionReply:
        label = request.label or "mission"
        try:
            # parsing a long mission takes 0.1 s, and would delay a scan
            with self._in_one_map():
                places = self._zones.newest.places
                mission = await asyncio.to_thread(
                    mission_files.loads, request.mission, label, places
                )
                self._check_feasible(mission)
                if mission.drives:
                    await self._check(None)
            name = self._queue.add_mission(mission, label, request.how, request.source)
        except GigabrainError as error:
            _log_refusal("mission", request.source, error)
            return MissionReply(ok=False, text=str(error)[:500])
        self._accept(name, MISSION, request)
        return MissionReply(ok=True, text=f"{name}: {label}"[:500], task=name)

    def _check_feasible(self, mission: Mission) -> None:
        """Raise Refused or UnknownName for steps that this robot cannot carry out."""
        body = self._source.body
        if body and mission.drives and not body.has_base:
            raise Refused(f"{body.robot_type} has no base to drive")
        for script in mission.scripts:
            self._scripts.path(script)
        if mission.looks:
            self._check_cameras()
        self._labels.check(mission.labels, self._objects.newest)
        if body and (actions := mission.arm_actions):
            arm_steps.check(body, actions, mission.things.values())

    async def _on_change(self, request: TaskRequest) -> TaskReply:
        try:
            if request.do == "cancel":
                text = self._queue.cancel(request.task, request.source)
            elif request.do == "pause":
                text = self._queue.pause(request.task, request.source)
            else:
                text = self._queue.resume(request.task)
        except GigabrainError as error:
            return TaskReply(ok=False, text=str(error)[:500], task=request.task)
        log.info("%s, by %s", text, request.source, extra={"data": {"event": "task"}})
        self._record(TASK_CHANGE, request)
        return TaskReply(ok=True, text=text[:500], task=request.task)

    def _accept(
        self, name: str, service: Service[Any, Any], request: GoalRequest | MissionRequest
    ) -> None:
        data = {"event": "task", "task": name, "source": request.source}
        log.info("accepted %s from %s", name, request.source, extra={"data": data})
        self._record(service, request)

    def _record(
        self, service: Service[Any, Any], request: GoalRequest | MissionRequest | TaskRequest
    ) -> None:
        """Publish that a request takes effect now, so that a recording can be replayed."""
        log_accepted(self._bus, service.key, request, self._basis)
        self._publish()


class TopicCache:
    """Newest messages before the current tick, of topics that conditions read."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._received: dict[str, PreviousTick[Any]] = {}
        self._state: RobotState | None = None

    def observe(self, state: RobotState) -> None:
        """Record the current state."""
        self._state = state

    def read(self, topic: Topic[Any]) -> Message | None:
        """Return the newest message if it is fresh; the first call subscribes."""
        state = self._state
        if state is None or topic.key == STATE.key:
            return state
        if topic.key not in self._received:
            earlier: PreviousTick[Any] = PreviousTick()
            self._received[topic.key] = earlier
            self._bus.subscribe(topic, lambda _key, message: earlier.receive(message))
        found: Message | None = self._received[topic.key].at(
            state.boot, state.tick, topic.stale_after_ns
        )
        return found


def _log_refusal(what: str, source: str, error: GigabrainError) -> None:
    data = {"event": "task refused", "source": source}
    log.warning("refused a %s from %s: %s", what, source, error, extra={"data": data})
