"""A whole robot in memory and fake time, with a shipped body in MuJoCo and a world of boxes."""

import functools
import math
from collections.abc import Callable
from pathlib import Path

import msgspec

from gigabrain_drivers.driver.catalog import load_robot, robot_path
from gigabrain_drivers.driver.robot import Run
from gigabrain_drivers.sim.body import MujocoOptions, sim_body
from gigabrain_drivers.sim.driver import STEPS_PER_TICK, scan_message, state_message
from gigabrain_drivers.sim.physics import Simulation
from gigabrain_drivers.sim.world import Pose, World
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.sensors import LaserScan
from gigabrain_schemas.tasks import GoalRequest, TaskStatus
from gigabrain_schemas.topics import GOAL, STATE, TASK
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import DecisionConfig, PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision import node as decision
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.qa.in_memory_robot import InMemoryRobot, node_of
from gigabrain_zenoh.runtime.replay import Node
from gigabrain_zenoh.safety import node as safety
from gigabrain_zenoh.safety.health import Host

SCAN_TICKS, START_TICKS = 5, 100


class MujocoPlant:
    """A body in MuJoCo that advances by one tick at a time."""

    def __init__(self, name: str, world: World) -> None:
        self.robot = load_robot(name)
        assert self.robot.sim
        options = msgspec.convert(self.robot.sim, MujocoOptions)
        body = sim_body(self.robot, options, Run(folder=robot_path(name).parent))
        self.simulation = Simulation(body, world, 0)
        self.poses: list[Pose] = []  # the true pose at each tick
        self.speeds: list[Velocity] = []  # the commanded velocity at each tick

    @property
    def tick(self) -> int:
        return len(self.poses)

    def advance(self, velocity: Velocity) -> None:
        self.simulation.drive(velocity.linear_x, velocity.linear_y, velocity.angular_z)
        for _ in range(STEPS_PER_TICK):
            self.simulation.advance()
        self.poses.append(self.simulation.truth.pose())
        self.speeds.append(velocity)

    def state(self) -> RobotState:
        return state_message(self.simulation, self.robot.robot_type)

    def scan(self) -> LaserScan | None:
        assert self.robot.lidar
        due = self.tick % SCAN_TICKS == 0
        return scan_message(self.robot.lidar, self.simulation.scan()) if due else None


async def _safety(bus: Bus, ready: Callable[[], None]) -> None:
    await safety.run(bus, ready, lambda _now_ns: Host())


def _nodes(plant: MujocoPlant, folder: Path) -> dict[str, Node]:
    settings = DecisionConfig(
        behaviour="navigate", settings={"unknown_space": "allow"}, compile_first=True
    )
    mapping = PerceptionConfig(mapping="slam", compile_first=True)
    return {
        "perception": functools.partial(perception.run, mapping),
        "decision": functools.partial(decision.run, settings),
        "control": control.run,
        "safety": _safety,
        "driver": node_of(plant.robot.description(), plant, str(folder)),
    }


async def send_to(
    plant: MujocoPlant, goal: tuple[float, float, float], folder: Path, seconds: float
) -> TaskStatus:
    """Send the body to a goal (x, y, yaw) relative to its start; return the last status."""
    async with InMemoryRobot(_nodes(plant, folder)) as robot:
        states = robot.operator.latest(STATE)
        statuses: list[TaskStatus] = []
        robot.operator.subscribe(TASK, lambda _, status: statuses.append(status))
        while not (states.current and states.current.gate.mode == "enabled") or (
            plant.tick < START_TICKS
        ):
            await robot.tick()
        x, y, yaw = goal
        (reply,) = await robot.ask(GOAL, GoalRequest(x=x, y=y, yaw=yaw, source="test"))
        assert reply.ok, reply.text
        begin = plant.tick
        while not statuses[-1].done and plant.tick - begin < 50 * seconds:
            await robot.tick()
    return statuses[-1]


def heading_difference(first: float, second: float) -> float:
    """Return the angle between two headings [rad]."""
    return abs(math.remainder(first - second, math.tau))
