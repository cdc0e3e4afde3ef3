"""Serves goals, missions and changes of tasks, and steps what they want.

Goals are accepted from the start, while the planning kernels still compile.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any

from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Message
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
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
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import (
    Behaviour,
    DriveCommand,
    Idle,
    Inputs,
    NavigationConfig,
    StepOutcome,
    StepResult,
    WaitReason,
    battery_nearly_empty,
    describe_end,
)
from gigabrain_zenoh.decision.behaviours.avoid import Avoid, AvoidConfig
from gigabrain_zenoh.decision.context import ContextSource
from gigabrain_zenoh.decision.detected_objects import ObjectsByPerceptor
from gigabrain_zenoh.decision.drive_kernels import DriveKernels
from gigabrain_zenoh.decision.node import InputSource
from gigabrain_zenoh.decision.tasks import mission as missions
from gigabrain_zenoh.decision.tasks.mission import Mission
from gigabrain_zenoh.decision.tasks.scripts import Scripts
from gigabrain_zenoh.decision.tasks.task_queue import Saved, TaskFile, TaskQueue
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.host.threads import BackgroundWriter
from gigabrain_zenoh.logs import Fault

if TYPE_CHECKING:
    from gigabrain_zenoh.decision.navigator import Navigator

log = logging.getLogger(__name__)

COMPILING = "mapping and planning compile meanwhile, once per installation"
FIRST_MAP_TICKS = 3000  # how long after the kernels a first map may come
STATUS_TICKS = 10  # robot/task is published at 5 Hz
STARTING_STATUS_NS = 200_000_000  # the same while the kernels compile
POSE_TIMEOUT_NS, POLL_NS = 700_000_000, 50_000_000  # wait for a first pose in the map


# returns how the robot would reach a goal, for people; without a goal, checks only that its pose in
# the map is known. Raises Refused
CheckGoal = Callable[[Goal | None], Awaitable[str]]


class TaskServer:
    """Serves tasks on the bus: keeps the queue, publishes its status and writes it to disk."""

    def __init__(
        self, bus: Bus, check: CheckGoal, zones: ZoneSource, *, folder: str = "", scripts: str = ""
    ) -> None:
        self._bus, self._check, self._zones = bus, check, zones
        self._scripts, self._topics, file = Scripts(scripts), TopicCache(bus), TaskFile(folder)
        saved, problem = file.read()
        if problem:
            log.warning("%s", problem, extra={"data": {"event": "tasks"}})
        self._queue = TaskQueue(self._topics.read, self._scripts.start, saved)
        self._writer: BackgroundWriter[Saved] = BackgroundWriter(file.write, 1)
        self._written, self._write_fault = saved, Fault(log)
        self._boot = self._tick = self._status_tick = self._basis = 0
        self._logged: set[str] = set()  # tasks whose end was logged
        self._maps_loaded: int | None = None  # see Zones
        self._waits = ""  # what all tasks wait for, before the first step
        bus.serve(GOAL, self._on_goal)
        bus.serve(MISSION, self._on_mission)
        bus.serve(TASK_CHANGE, self._on_change)

    def publish_starting(self) -> None:
        """Publish the status while nothing can drive by a map yet."""
        self._waits = f"waiting: {WaitReason.STARTING}"
        self._publish()

    def wait(self, state: RobotState) -> None:
        """Publish that status at its rate; called with every step that does not advance tasks."""
        self._tick = state.tick
        if not 0 <= state.tick - self._status_tick < STATUS_TICKS:
            self.publish_starting()

    def unused(self, boot: int) -> bool:
        """Return whether there is no task, nor was there one in this start of the driver."""
        return self._queue.is_unused(boot)

    def step(
        self, state: RobotState, outcome: StepOutcome | None, basis: int = 0
    ) -> tuple[DriveCommand | None, Idle]:
        """Advance the queue, with the world of tick `basis`.

        Return the next command, and why the robot stands if there is none.
        """
        self._waits = ""
        same_boot = state.boot == self._boot
        seconds = max(0, state.tick - self._tick) * TICK_S if same_boot else 0.0
        self._boot, self._tick, self._basis = state.boot, state.tick, basis
        if not same_boot:
            self._queue.restart(state.boot)
            self._status_tick = 0
        self._drop_if_moved()
        self._topics.observe(state)
        wanted = self._queue.step(seconds, outcome)
        if not 0 <= state.tick - self._status_tick < STATUS_TICKS or self._just_ended():
            self._publish()
        return wanted

    def _drop_if_moved(self) -> None:
        """Cancel all tasks if another map was loaded: their coordinates mean other places."""
        loaded = self._zones.maps_loaded(self._boot, self._tick)
        if loaded is None or loaded == self._maps_loaded:
            return
        before, self._maps_loaded = self._maps_loaded, loaded
        if before is not None and self._queue.status.current:
            text = self._queue.cancel("all", "loading another map")
            log.warning("%s: another map was loaded", text, extra={"data": {"event": "task"}})

    def begin(self, mission: Mission, label: str, boot: int) -> None:
        """Start a mission, unless there were tasks in this start of the driver."""
        if self.unused(boot):
            self._queue.add_mission(mission, label, "queue", "itself")

    async def close(self) -> None:
        """Return once all is written."""
        await self._writer.close()

    def _just_ended(self) -> bool:
        done = self._queue.status.done
        return bool(done) and done[0].id not in self._logged

    def _publish(self) -> None:
        """Publish the status, and write the queue where it has changed."""
        self._status_tick = self._tick
        status = self._bus.publish(TASK, self._status())
        for task in reversed(status.done):
            if task.id not in self._logged:
                data = {"event": "task", "task": task.id, "state": task.state}
                log.info("%s", describe_end(task), extra={"data": data})
        self._logged = {task.id for task in status.done}
        saved = self._queue.saved
        if saved != self._written:
            self._written = saved
            written = self._writer.put(saved)
            written.add_done_callback(lambda done: self._on_written(done.result()))

    def _status(self) -> TaskStatus:
        status = self._queue.status
        if not self._waits or status.current is None or status.current.state != "active":
            return status
        return replace(status, current=replace(status.current, reason=self._waits))

    def _on_written(self, problem: str) -> None:
        if problem:
            self._write_fault.begin(problem)
        else:
            self._write_fault.end("tasks are saved again")

    async def _on_goal(self, request: GoalRequest) -> GoalReply:
        try:
            goal = self._goal_of(request)
            path = await self._check(goal)
            name = self._queue.add_goal(goal, request.how, request.source, request.place)
        except GigabrainError as error:
            _log_refusal("goal", request.source, error)
            return GoalReply(ok=False, text=str(error)[:500])
        self._accept(name, GOAL, request)
        return GoalReply(ok=True, text=f"{name}: {path}"[:500], goal=name)

    def _goal_of(self, request: GoalRequest) -> Goal:
        """Return the goal that is asked for. Raises Refused for a place that is not there."""
        if request.x is None or request.y is None:
            return self._zones.goal(request.place, request.yaw)
        return Goal(x=request.x, y=request.y, yaw=request.yaw)

    async def _on_mission(self, request: MissionRequest) -> MissionReply:
        label = request.label or "mission"
        try:
            # a long one takes a tenth of a second to parse, which no scan should wait for
            places = self._zones.newest.places
            mission = await asyncio.to_thread(missions.loads, request.mission, label, places)
            for script in mission.scripts:
                self._scripts.path(script)
            if mission.drives:
                await self._check(None)
            name = self._queue.add_mission(mission, label, request.how, request.source)
        except GigabrainError as error:
            _log_refusal("mission", request.source, error)
            return MissionReply(ok=False, text=str(error)[:500])
        self._accept(name, MISSION, request)
        return MissionReply(ok=True, text=f"{name}: {label}"[:500], task=name)

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
        """Publish when a request takes effect, so that a recording can be replayed."""
        log_accepted(self._bus, service.key, request, self._basis)
        self._publish()


class GoalServer(InputSource):
    """Input source of behaviours that drive by a map: the task queue and the navigator.

    At the first start of an installation the robot can drive before the kernels are compiled: with
    `start: explore` it then roams by `avoid`, until there is a map or somebody gives it a task.
    """

    def __init__(self, settings: NavigationConfig, bus: Bus, config: DecisionConfig) -> None:
        self._bus, self._config, self._name = bus, settings, config.behaviour
        self._zones = ZoneSource(bus)
        self._tasks = TaskServer(
            bus, self.check, self._zones, folder=config.state_dir, scripts=settings.scripts
        )
        self._source = ContextSource(bus, self._zones)
        self._kernels = DriveKernels(bus.input_log.in_time)
        self._compile_first = config.compile_first or not bus.input_log.live
        self._avoid = Avoid(_roaming(settings))  # drives without a map
        self._loaded = False  # the kernels that this body needs
        self._began_late = False  # there were steps without the kernels
        self._loaded_tick: int | None = None  # of the first step with them
        self._navigator: Navigator | None = None  # once the kernels are loaded
        self._outcome: StepOutcome | None = None  # of the last command
        self._started = False

    async def prepare(self) -> None:
        """Load the kernels, or begin to compile them. Raises ConfigError."""
        publishing = asyncio.ensure_future(self._publish_starting())
        try:
            self._loaded = await self._kernels.load(wait=self._compile_first)
        finally:
            publishing.cancel()
        if self._loaded:
            self._make_navigator()

    async def finish_preparing(self) -> None:
        """Return once the kernels are loaded. Raises ConfigError."""
        await self._kernels.finish()

    def configure(self, config: NavigationConfig) -> None:
        """Use another speed limit from now on."""
        self._config = config
        self._avoid.configure(_roaming(config))
        if self._navigator:
            self._navigator.configure(config)

    def observe(self, state: RobotState) -> None:
        """Record a robot state; to be called with every state."""
        self._source.observe(state)

    def step(
        self,
        behaviour: Behaviour,
        state: RobotState,
        world: WorldModel | None,
        verdict: SafetyState | None,
        objects: ObjectsByPerceptor,
    ) -> StepResult:
        """Advance the queue and step the behaviour with the command that it wants."""
        self._loaded = self._kernels.loaded(self._source.body)
        if not self._loaded or self._awaits_map(state):
            return self._start_up(state, world, verdict)
        navigator = self._make_navigator()
        if self._config.start == "explore" and not self._started:
            self._tasks.begin(missions.explore_mission(), "roaming", state.boot)
        self._started = True
        tick = world.basis if world else state.tick
        command, idle = self._tasks.step(state, self._outcome, tick)
        context = navigator.at_scan(state, world, verdict)
        intent, outcome = behaviour.step(
            Inputs(
                world=world,
                pose=context.pose,
                must_charge=context.must_charge,
                objects=objects,
                command=command,
                drive=lambda wanted: navigator.drive(wanted, idle),
            )
        )
        self._outcome = outcome if command else None
        return intent, outcome

    def _make_navigator(self) -> "Navigator":
        if self._navigator is None:
            from gigabrain_zenoh.decision.navigator import Navigator  # imports numba

            self._navigator = Navigator(
                self._config, self._bus, self._source, self._name, self._zones
            )
        return self._navigator

    def _awaits_map(self, state: RobotState) -> bool:
        """Return whether perception may still be compiling: then there is no first map."""
        if self._loaded_tick is None:
            self._loaded_tick = state.tick
        late = state.tick - self._loaded_tick
        if self._began_late and 0 <= late < FIRST_MAP_TICKS:
            self._began_late = not self._source.oriented(state)
            return self._began_late
        return False

    def _start_up(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> StepResult:
        """Roam without a map, if the robot may explore and has no task; else stand.

        A car stands as well: it cannot turn away on the spot.
        """
        self._began_late = True
        self._tasks.wait(state)
        body = self._source.body
        car = body is not None and body.turning_radius > 0.0
        if self._config.start != "explore" or not self._tasks.unused(state.boot) or car:
            text = f"waiting: {WaitReason.STARTING}"
            intent = Intent(behaviour=self._name, reason=text)
            return intent, StepOutcome(activity="waiting", reason=text)
        must_charge = battery_nearly_empty(verdict)
        inputs = Inputs(world=world, pose=state.pose, must_charge=must_charge)
        intent, outcome = self._avoid.step(inputs)
        return replace(intent, reason=f"{intent.reason}; {COMPILING}"), outcome

    @property
    def hung(self) -> bool:
        """Whether the plan in the worker thread will never finish."""
        return self._navigator is not None and self._navigator.hung

    async def close(self) -> None:
        """Close the task server after its last write, then stop all work beside the loop."""
        await self._kernels.close()
        await self._tasks.close()
        if self._navigator:
            self._navigator.close()

    async def check(self, goal: Goal | None) -> str:
        """Return how the robot would reach `goal`, for people; see CheckGoal. Raises Refused."""
        for _ in range(POSE_TIMEOUT_NS // POLL_NS):
            if (waits := self._waits) or self._navigator is None:
                return f"accepted; {waits}"
            if self._navigator.located:
                break
            await self._bus.clock.sleep_ns(POLL_NS)
        else:
            raise Refused(self._source.lost or WaitReason.NO_MAP)
        if goal is None:
            return ""
        found = await self._navigator.check(goal)
        offset = f"; {found.offset}" if found.offset else ""
        return f"on the way, {found.length_m:.1f} m{offset}"

    @property
    def _waits(self) -> WaitReason | None:
        if self._navigator is None or not self._loaded:
            return WaitReason.STARTING
        return self._navigator.waits

    async def _publish_starting(self) -> None:
        while True:
            self._tasks.publish_starting()
            await self._bus.clock.sleep_ns(STARTING_STATUS_NS)


def _roaming(config: NavigationConfig) -> AvoidConfig:
    """Return settings for driving without a map, within the speed limit."""
    slow = AvoidConfig(turn="clearer")
    limit = config.max_linear_speed
    return (
        slow if limit is None else replace(slow, max_linear_speed=min(slow.max_linear_speed, limit))
    )


class TopicCache:
    """The newest message of each topic that conditions read, as of before the present tick."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._received: dict[str, PreviousTick[Any]] = {}
        self._state: RobotState | None = None

    def observe(self, state: RobotState) -> None:
        """Record the present state."""
        self._state = state

    def read(self, topic: Topic[Any]) -> Message | None:
        """Return the newest message while it is fresh; the first call subscribes."""
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
