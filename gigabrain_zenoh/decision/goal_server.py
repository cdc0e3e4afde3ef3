"""Input source that steps the task queue, the navigator and the manipulator.

The robot can drive before the planning kernels are compiled.
"""

import asyncio
from typing import TYPE_CHECKING

from msgspec.structs import replace

from gigabrain_schemas.body import BodyDescription, RobotState
from gigabrain_schemas.brain import Intent, WorldModel
from gigabrain_schemas.safety import SafetyState
from gigabrain_schemas.tasks import Goal
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig
from gigabrain_zenoh.decision.behaviours import (
    ArmCommand,
    Behaviour,
    Command,
    DriveCommand,
    Idle,
    Inputs,
    NavigationConfig,
    StepOutcome,
    StepResult,
    WaitReason,
    battery_nearly_empty,
)
from gigabrain_zenoh.decision.behaviours.avoid import Avoid, AvoidConfig
from gigabrain_zenoh.decision.context import ContextSource
from gigabrain_zenoh.decision.detected_objects import ObjectsByPerceptor
from gigabrain_zenoh.decision.drive_kernels import DriveKernels
from gigabrain_zenoh.decision.node import InputSource
from gigabrain_zenoh.decision.seen_things import SeenThings
from gigabrain_zenoh.decision.task_server import StartMission, TaskServer
from gigabrain_zenoh.decision.tasks import arm_steps, mission_files
from gigabrain_zenoh.decision.tasks import mission as missions
from gigabrain_zenoh.decision.zones import ZoneSource
from gigabrain_zenoh.errors import GigabrainError, Refused
from gigabrain_zenoh.geometry.pose import to_parent
from gigabrain_zenoh.host.files import expanded

if TYPE_CHECKING:
    from gigabrain_zenoh.decision.manipulator import Manipulator
    from gigabrain_zenoh.decision.navigator import Navigator

NOT_BEGUN = Idle("waiting", "waiting: the mission needs the body and the map's places first")
COMPILING = "mapping and planning compile meanwhile, once per installation"
FIRST_MAP_TICKS = 3000  # wait for a first map, once the kernels are loaded
STARTING_STATUS_NS = 200_000_000  # period of the status while the kernels compile
POSE_TIMEOUT_NS, POLL_NS = 700_000_000, 50_000_000  # wait for a first pose in the map


class GoalServer(InputSource):
    """Input source of behaviours that drive by a map: the task queue and the navigator.

    The kernels are compiled at the first start of an installation. Meanwhile, with
    `start: explore`, the robot roams by `avoid` until it gets a map or a task.
    """

    moves_arms = True

    def __init__(self, settings: NavigationConfig, bus: Bus, config: DecisionConfig) -> None:
        self._bus, self._config, self._name = bus, settings, config.behaviour
        self._zones, self._seen = ZoneSource(bus), SeenThings(bus)
        self._source = ContextSource(bus, self._zones)
        self._tasks = TaskServer(
            bus, self.check, self._zones, self._source,
            folder=config.state_dir, scripts=settings.scripts,
        )  # fmt: skip
        self._kernels = DriveKernels(bus.input_log.in_time)
        self._compile_first = config.compile_first or not bus.input_log.live
        self._avoid = Avoid(_roaming(settings))  # drives without a map
        self._loaded = False  # the kernels for this body
        self._stepped_unloaded = False  # before the kernels were loaded
        self._loaded_tick: int | None = None  # of the first step with kernels
        self._navigator: Navigator | None = None  # once the kernels are loaded
        self._manipulator: Manipulator | None = None  # once an arm needs it
        self._outcome: StepOutcome | None = None  # of the last command
        self._start_mission = _start_mission(settings)
        self._start_mission_begun = False
        self._checked_number = 0  # of the last command that the arm can carry out

    async def prepare(self) -> None:
        """Load the kernels, or start to compile them. Raises ConfigError."""
        publishing = asyncio.ensure_future(self._publish_starting())
        try:
            self._loaded = await self._kernels.load(wait=self._compile_first)
        finally:
            publishing.cancel()
        if self._loaded:
            self._make_navigator()

    async def finish_preparing(self) -> None:
        """Wait until the kernels are loaded. Raises ConfigError."""
        await self._kernels.finish()

    def configure(self, config: NavigationConfig) -> None:
        """Replace the settings."""
        self._config = config
        self._avoid.configure(_roaming(config))
        if self._navigator:
            self._navigator.configure(config)

    def observe(self, state: RobotState) -> None:
        """Record a robot state; to be called with every state."""
        self._source.observe(state)
        self._seen.observe(self._source.body, state)

    def step(
        self,
        behaviour: Behaviour,
        state: RobotState,
        world: WorldModel | None,
        verdict: SafetyState | None,
        objects: ObjectsByPerceptor,
    ) -> StepResult:
        """Advance the queue, and step the behaviour with its command."""
        body = self._source.body
        if body and not body.has_base:
            self._begin(state, body)
            command, idle = self._tasks.step(state, self._outcome, state.tick)
            step = self._move_arm(state, body, command, idle)
            self._outcome = step[1] if command else None
            return step
        self._loaded = self._kernels.loaded(body)
        if not self._loaded or self._awaits_map(state):
            return self._start_up(state, world, verdict)
        navigator = self._make_navigator()
        tick = world.basis if world else state.tick
        if self._begin(state, body):
            command, idle = self._tasks.step(state, self._outcome, tick)
        else:
            self._tasks.wait(state)
            command, idle = None, NOT_BEGUN
        context = navigator.at_scan(state, world, verdict)
        intent, outcome = behaviour.step(
            Inputs(
                world=world,
                pose=context.pose,
                must_charge=context.must_charge,
                objects=objects,
                command=command if isinstance(command, DriveCommand) else None,
                drive=lambda drive_command: navigator.drive(drive_command, idle),
            )
        )
        if body and (isinstance(command, ArmCommand) or self._manipulator or self._may_hold(body)):
            arm_intent, arm_outcome = self._move_arm(state, body, command, idle)
            if isinstance(command, ArmCommand):
                outcome = arm_outcome
                intent = replace(arm_intent, twist=intent.twist, response=intent.response)
            else:
                intent = replace(intent, joints=arm_intent.joints)
        self._outcome = outcome if command else None
        return intent, outcome

    def _begin(self, state: RobotState, body: BodyDescription | None) -> bool:
        """Begin the start mission once, if there was no task and the body can carry it out.

        Return False while it has to wait.
        """
        if self._start_mission_begun or self._start_mission is None:
            return True
        cannot_roam = body is not None and not body.has_base and not self._config.mission
        begun = cannot_roam or self._tasks.begin(self._start_mission, state)
        self._start_mission_begun = begun
        return begun

    def _move_arm(
        self, state: RobotState, body: BodyDescription, command: Command | None, idle: Idle
    ) -> StepResult:
        """Carry out a command for the arm; without one, the arm holds still."""
        arm_command = command if isinstance(command, ArmCommand) else None
        number = command.number if command else 0
        if arm_command and number != self._checked_number:  # before importing optional packages
            try:
                arm_steps.check(body, [arm_command.do], arm_command.things.values())
            except GigabrainError as error:
                return self._refused(number, str(error))
            self._checked_number = number
        if arm_command is None and command and not body.has_base:
            return self._refused(number, f"{body.robot_type} has no base to drive")
        load_arm = self._manipulator is None and (arm_command or self._may_hold(body))
        if load_arm and self._kernels.arm_loaded():
            from gigabrain_zenoh.decision.manipulator import Manipulator  # imports MuJoCo

            self._manipulator = Manipulator(self._bus, self._name, self._tasks.held)
        if self._manipulator is None:
            if arm_command is None:
                return Intent(behaviour=self._name, reason=idle.reason), StepOutcome()
            text, holds = f"waiting: {WaitReason.STARTING}", self._tasks.held
            outcome = StepOutcome(number=number, activity="waiting", reason=text, holds=holds)
            return Intent(behaviour=self._name, reason=text), outcome
        held, seen = self._source.held(state), self._seen.at(state)
        intent, outcome = self._manipulator.step(state, body, arm_command, idle, held, seen)
        return intent, self._on_map(outcome, state)

    def _may_hold(self, body: BodyDescription) -> bool:
        """Return whether the gripper may still hold something that it held before a restart."""
        if self._tasks.held is None:
            return False
        try:
            arm_steps.check(body, [arm_steps.Gripper("close")])
        except GigabrainError:
            return False
        return True

    def _on_map(self, outcome: StepOutcome, state: RobotState) -> StepOutcome:
        """Return `outcome` with its `approach` moved from the body's frame to the map."""
        target = outcome.approach
        if target is None:
            return outcome
        here = self._source.here(state.boot, state.tick)
        if here is None:
            return replace(outcome, approach=None)
        x, y = to_parent(here, target.x, target.y)
        return replace(outcome, approach=replace(target, x=x, y=y))

    def _refused(self, number: int, reason: str) -> StepResult:
        """Return the failure of a command that cannot be carried out."""
        intent = Intent(behaviour=self._name, reason=reason)
        held = self._tasks.held
        return intent, StepOutcome(number=number, state="failed", reason=reason, holds=held)

    def _make_navigator(self) -> "Navigator":
        if self._navigator is None:
            from gigabrain_zenoh.decision.navigator import Navigator  # imports numba

            self._navigator = Navigator(
                self._config, self._bus, self._source, self._name, self._zones
            )
        return self._navigator

    def _awaits_map(self, state: RobotState) -> bool:
        """Return whether perception may still be compiling, and so has no first map yet."""
        if self._loaded_tick is None:
            self._loaded_tick = state.tick
        loaded_ticks = state.tick - self._loaded_tick
        if self._stepped_unloaded and 0 <= loaded_ticks < FIRST_MAP_TICKS:
            self._stepped_unloaded = not self._source.oriented(state)
            return self._stepped_unloaded
        return False

    def _start_up(
        self, state: RobotState, world: WorldModel | None, verdict: SafetyState | None
    ) -> StepResult:
        """Roam without a map, if the robot may explore and has no task; else stand still.

        A car always stands still: it cannot turn on the spot.
        """
        self._stepped_unloaded = True
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
        """Return whether the plan in the worker thread will never finish."""
        return self._navigator is not None and self._navigator.hung

    async def close(self) -> None:
        """Close the task server after its last write, then stop all worker threads."""
        await self._kernels.close()
        await self._tasks.close()
        if self._navigator:
            self._navigator.close()
        if self._manipulator:
            self._manipulator.close()

    async def check(self, goal: Goal | None) -> str:
        """Describe how the robot would reach `goal`; see CheckGoal. Raises Refused."""
        body = self._source.body
        if body and not body.has_base:
            raise Refused(f"{body.robot_type} has no base to drive")
        for _ in range(POSE_TIMEOUT_NS // POLL_NS):
            if (reason := self._wait_reason) or self._navigator is None:
                return f"accepted; {reason}"
            if self._navigator.located:
                break
            await self._bus.clock.sleep_ns(POLL_NS)
        else:
            raise Refused(self._source.lost or WaitReason.NO_MAP)
        if goal is None:
            return ""
        path = await self._navigator.check(goal)
        offset = f"; {path.offset}" if path.offset else ""
        return f"on the way, {path.length_m:.1f} m{offset}"

    @property
    def _wait_reason(self) -> WaitReason | None:
        if self._navigator is None or not self._loaded:
            return WaitReason.STARTING
        return self._navigator.waits

    async def _publish_starting(self) -> None:
        while True:
            self._tasks.publish_starting()
            await self._bus.clock.sleep_ns(STARTING_STATUS_NS)


def _start_mission(config: NavigationConfig) -> StartMission | None:
    """Return the configured start mission, if there is one. Raises ConfigError."""
    if config.mission:
        path = expanded(config.mission)
        return StartMission(*mission_files.load(path), label=path.stem, source=str(path))
    if config.start != "explore":
        return None
    roaming = missions.explore_mission()
    return StartMission(roaming, missions.text_of(roaming), label="roaming", source="roaming")


def _roaming(config: NavigationConfig) -> AvoidConfig:
    """Return the settings for driving without a map, within the speed limit."""
    roaming = AvoidConfig(turn="clearer")
    limit = config.max_linear_speed
    if limit is None:
        return roaming
    return replace(roaming, max_linear_speed=min(roaming.max_linear_speed, limit))
