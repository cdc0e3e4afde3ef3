"""`gigabrain bench barn`: drives a Jackal through the worlds of BARN and DynaBARN."""

import asyncio
import functools
import gc
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.base import TICK_S, Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import Goal, GoalRequest
from gigabrain_schemas.topics import GOAL, MAP, POSE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.decision.actuation_model import ActuationEstimator
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import ZERO, SentCommand, clamp, limits_of, ramp
from gigabrain_zenoh.host.bounded import percentile
from gigabrain_zenoh.host.signals import end_on_interrupt
from gigabrain_zenoh.navigation.local_planner import LocalPlanner, LocalSettings, PlanRequest
from gigabrain_zenoh.navigation.warm_up import warm_up_local_planner
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.perception.obstacle_tracker import ObstacleTracker
from gigabrain_zenoh.qa.bench.barn_course import (
    HARD,
    IDEAL,
    JACKAL,
    LIDAR,
    MUJOCO,
    BarnCourse,
    BarnTrial,
    BarnWorld,
    Conditions,
)
from gigabrain_zenoh.qa.in_memory_robot import InMemoryRobot, node_of
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.health import Host

PLANTS = {"hard": HARD, "ideal": IDEAL, "mujoco": MUJOCO}


class BarnResult(Struct, frozen=True, kw_only=True):
    """All trials, and their means."""

    plant: Conditions
    samples: int  # plans per cycle
    trials: tuple[BarnTrial, ...]

    def share(self, result: str) -> float:
        """Return the share of the trials with this result."""
        return sum(one.result == result for one in self.trials) / len(self.trials)

    @property
    def score(self) -> float:
        """The mean score by the rules of 2024 and later, 0.5 at most."""
        return statistics.fmean(one.score for one in self.trials)

    @property
    def seconds(self) -> float | None:
        """Mean time of the successes, unclipped [s]."""
        times = [one.seconds for one in self.trials if one.result == "success"]
        return statistics.fmean(times) if times else None

    @property
    def clearances(self) -> tuple[float, float]:
        """Smallest and median of each trial's least clearance [m]."""
        least = [one.least_clearance for one in self.trials]
        return min(least), statistics.median(least)

    def cycle_ms(self, share: float) -> float | None:
        """Return a percentile of the planning times [ms]."""
        return percentile(sorted(ms for one in self.trials for ms in one.cycles_ms), share)


def measure_barn(
    worlds: Iterable[BarnWorld],
    trials: int,
    plant: str,
    samples: int,
    jobs: int,
    progress: Callable[[BarnTrial], None],
    *,
    nodes: bool,
) -> BarnResult:
    """Drive `trials` times in each of `worlds`, in `jobs` processes.

    The robot runs its own `nodes`, or only the functions that they call.
    """
    drive = drive_nodes if nodes else drive_functions
    trials_done = []
    context = get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=end_on_interrupt) as pool:
        waiting = [
            pool.submit(_when_warm, drive, world, trial, PLANTS[plant], samples)
            for world in worlds
            for trial in range(trials)
        ]
        try:
            for one in as_completed(waiting):
                trials_done.append(one.result())
                progress(trials_done[-1])
        finally:
            pool.shutdown(cancel_futures=True)  # after a failure, do not run the others
    trials_done.sort(key=lambda one: (one.world, one.trial))
    return BarnResult(plant=PLANTS[plant], samples=samples, trials=tuple(trials_done))


def _when_warm(drive: Callable[..., BarnTrial], *arguments: object) -> BarnTrial:
    _warm_up()
    return drive(*arguments)


@functools.cache
def _warm_up() -> None:
    """Compile kernels and freeze existing objects, as a robot's process does before it drives."""
    warm_up_local_planner(JACKAL)
    gc.collect()
    gc.freeze()


START_TIMEOUT_TICKS = 500  # until the robot is enabled and localized


class JudgedCourse(BarnCourse):
    """A course that judges each tick. It stands still once the trial is over."""

    def advance(self, velocity: Velocity) -> None:
        """Drive for a tick, and judge the trial."""
        if not self.result:
            super().advance(velocity)
            self.judge()


def drive_nodes(world: BarnWorld, trial: int, conditions: Conditions, samples: int) -> BarnTrial:
    """Drive one trial with the nodes; equal arguments give equal results."""
    with tempfile.TemporaryDirectory(prefix="barn-") as folder:
        return asyncio.run(_drive(JudgedCourse(world, trial, conditions), samples, folder))


async def _drive(course: JudgedCourse, samples: int, folder: str) -> BarnTrial:
    async with InMemoryRobot(_nodes(course, samples, folder)) as robot:
        await _until_ready(robot)
        goal = GoalRequest(x=course.goal.x, y=course.goal.y, source="bench")
        (reply,) = await robot.ask(GOAL, goal)
        if not reply.ok:
            raise Refused(f"the goal is refused: {reply.text}")
        while not course.result:
            await robot.tick()
    return course.ended()


def _nodes(course: JudgedCourse, samples: int, folder: str) -> dict[str, Node]:
    """Return the nodes of a robot that may drive through unknown space."""
    mapping = PerceptionConfig(
        mapping="slam", compile_first=True
    )  # fake time does not wait for a compiler
    through_unknown = DecisionConfig(
        behaviour="navigate",
        settings={"unknown_space": "allow", "samples": samples},
        compile_first=True,
    )
    return {
        "perception": functools.partial(perception.run, mapping),
        "decision": functools.partial(decision.run, through_unknown),
        "control": control.run,
        "safety": _safety,
        "driver": node_of(JACKAL, course, folder),
    }


async def _safety(bus: Bus, ready: Callable[[], None]) -> None:
    """Run safety without watching this machine's load, so that results do not depend on it."""
    await safety.run(bus, ready, lambda _now_ns: Host())


async def _until_ready(robot: InMemoryRobot) -> None:
    """Wait until the robot is localized and enabled. Raises Refused after a timeout."""
    states, poses = robot.operator.latest(STATE), robot.operator.latest(POSE)
    maps = robot.operator.latest(MAP)
    for _ in range(START_TIMEOUT_TICKS):
        await robot.tick()
        state, pose = states.current, poses.current
        if state and state.gate.mode == "enabled" and (pose and pose.localized) and maps.current:
            return
    raise Refused("the robot was not enabled and localized in time")


BOOT = 1
SENT_TICKS = 30  # age of the oldest command that planning uses
DRIVING = GateStatus(mode="enabled", commander=BRAIN, enables=1)


class BarnBrain:
    """The functions that the robot's nodes call, without nodes."""

    def __init__(self, goal: Goal, settings: LocalSettings) -> None:
        self._goal = goal
        self._planner = LocalPlanner(JACKAL, settings)
        self._tracker = ObstacleTracker()
        self._response = ActuationEstimator()
        self._memory = control.ControlMemory()
        self._intent: Intent | None = None
        self._perception = PerceptionConfig(mapping="slam")
        self.cycles_ms: list[float] = []

    def tick(self, state: RobotState, scan: LaserScan | None) -> CmdVel:
        """Return the command of one tick."""
        self._response.add_state(state)
        if scan is not None:
            world = perception.step(self._perception, JACKAL, scan)
            world = self._tracker.add_obstacles(world, LIDAR, scan, state.pose)
            self._intent = self._decide(state, world)
        inputs = control.ControlInputs(state=state, intent=self._intent)
        self._memory, command = control.step(JACKAL, self._memory, inputs)
        command = replace(command, boot=BOOT, tick=state.tick)
        self._response.add_command(command)
        return command

    def _decide(self, state: RobotState, world: WorldModel) -> Intent:
        begin_s = time.thread_time()
        sent = self._response.sent(state.tick - SENT_TICKS, state.tick - 1)
        request = PlanRequest(
            tick=state.tick,
            pose=state.pose,
            velocity=state.velocity,
            goal=self._goal,
            hits=world.points().astype(np.float64),
            obstacles=world.obstacles,
            response=self._response.response,
            sent=tuple(SentCommand(tick, velocity) for tick, velocity in sent),
        )
        plan = self._planner.plan(request)
        self.cycles_ms.append((time.thread_time() - begin_s) * 1e3)
        return Intent(
            twist=plan.twist,
            trajectory=plan.trajectory,
            follow=bool(plan.trajectory),
            response=request.response,
            behaviour="navigate",
            reason=plan.reason,
            basis=state.tick,
        )


def drive_functions(
    world: BarnWorld, trial: int, conditions: Conditions, samples: int
) -> BarnTrial:
    """Drive one trial without nodes; equal arguments give equal results."""
    course = BarnCourse(world, trial, conditions)
    brain = BarnBrain(course.goal, LocalSettings(samples=samples))
    limits, output = limits_of(JACKAL), ZERO
    while True:
        course.judge()
        if course.result:
            return course.ended(tuple(brain.cycles_ms))
        scan, tick = course.scan(), course.tick
        state = replace(course.state(), gate=DRIVING, boot=BOOT, tick=tick)
        command = brain.tick(state, scan and replace(scan, boot=BOOT, tick=tick, basis=tick))
        asked = Velocity(linear_x=command.linear_x, angular_z=command.angular_z)
        output = ramp(output, clamp(asked, limits), limits, TICK_S)
        course.advance(output)
