"""One trial of BARN driven by the robot's own nodes: they, the gate and the safety process."""

import asyncio
import functools
import tempfile
from collections.abc import Callable

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import GoalRequest
from gigabrain_schemas.topics import GOAL, MAP, POSE, STATE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.bench.barn_worlds import World
from gigabrain_zenoh.qa.bench.course import Course, Trial
from gigabrain_zenoh.qa.bench.in_memory import InMemory
from gigabrain_zenoh.qa.bench.plant import JACKAL, Conditions
from gigabrain_zenoh.qa.planted import node_of
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.host import Host

WAKING_TICKS = 500  # until the gate is open and the robot knows where it is


class Watched:
    """A course, looked at in each tick. It stands still once the trial is over."""

    def __init__(self, course: Course) -> None:
        self._course = course

    def advance(self, velocity: Velocity) -> None:
        """See Plant in gigabrain_zenoh.qa.planted."""
        if not self._course.result:
            self._course.advance(velocity)
            self._course.look()

    def state(self) -> RobotState:
        """See Plant."""
        return self._course.state()

    def scan(self) -> LaserScan | None:
        """See Plant."""
        return self._course.scan()


def drive(world: World, trial: int, conditions: Conditions, samples: int) -> Trial:
    """One trial in one world; the same arguments give the same result."""
    with tempfile.TemporaryDirectory(prefix="barn-") as folder:
        return asyncio.run(_drive(Course(world, trial, conditions), samples, folder))


async def _drive(course: Course, samples: int, folder: str) -> Trial:
    async with InMemory(_nodes(Watched(course), samples, folder)) as robot:
        await _awake(robot)
        goal = GoalRequest(x=course.goal.x, y=course.goal.y, source="bench")
        (reply,) = await robot.ask(GOAL, goal)
        if not reply.ok:
            raise Refused(f"the goal is refused: {reply.text}")
        while not course.result:
            await robot.tick()
    return course.ended()


def _nodes(plant: Watched, samples: int, folder: str) -> dict[str, Node]:
    """With the settings of a robot that drives where nobody has been."""
    anywhere = DecisionConfig(behaviour="navigate", unknown="allow", samples=samples)
    return {
        "perception": functools.partial(perception.run, PerceptionConfig(mapping="slam")),
        "decision": functools.partial(decision.run, anywhere),
        "control": control.run,
        "safety": _safety,
        "driver": node_of(JACKAL, plant, folder),
    }


async def _safety(bus: Bus, ready: Callable[[], None]) -> None:
    """No outcome may depend on how busy this computer is."""
    await safety.run(bus, ready, lambda _now_ns: Host())


async def _awake(robot: InMemory) -> None:
    """Let time pass until it can be sent. Raises Refused when it never can."""
    states, places = robot.operator.latest(STATE), robot.operator.latest(POSE)
    maps = robot.operator.latest(MAP)
    for _ in range(WAKING_TICKS):
        await robot.tick()
        state, place = states.current, places.current
        if state and state.gate.mode == "enabled" and _known(place) and maps.current:
            return
    raise Refused("the robot has not woken up")


def _known(place: PoseInMap | None) -> bool:
    return place is not None and place.localized
