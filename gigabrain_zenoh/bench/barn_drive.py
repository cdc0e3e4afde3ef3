"""One trial: perception, decision's planning, control and the gate's limits, tick by tick.

They are the functions that the processes call, in the order in which messages wake them. The robot
hears of nothing but scans, odometry and its measured speed.
"""

import math
import time

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from gigabrain_schemas.arrays import hits, ranges_bytes
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import GateStatus, Lidar, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh import control, perception
from gigabrain_zenoh.bench.barn_worlds import World
from gigabrain_zenoh.bench.plant import FIELD_OF_VIEW, JACKAL, LIDAR, Conditions, Plant
from gigabrain_zenoh.gate import BRAIN
from gigabrain_zenoh.limits import ZERO, clamp, limits_of, ramp
from gigabrain_zenoh.navigation.local import Goal, LocalPlanner, LocalSettings, Moment, Sent
from gigabrain_zenoh.obstacles.surroundings import Surroundings
from gigabrain_zenoh.response import ResponseEstimator
from gigabrain_zenoh.settings import PerceptionConfig

Floats = NDArray[np.float64]

TICK_S = TICK_NS / 1e9
BOOT = 1
SCAN_TICKS = 2  # from scan to scan
SENT_TICKS = 30  # of commands, that planning looks back on
LIMIT_S = 100.0
REACHED_M, BEGUN_M = 1.0, 0.1  # [m], from the goal and from the start
APART_S = 7.3  # between the times at which trials of a moving world begin
SEED = 1000


class Trial(Struct, frozen=True, kw_only=True):
    """How one trial ended."""

    world: int
    trial: int
    result: str  # success, collision or timeout
    seconds: float  # since it left the start
    least_clearance: float  # [m], over all ticks
    score: float  # by the rules of 2024 and later, 0.5 at most
    cycles_ms: tuple[float, ...]  # of planning, as long as this thread worked


class Brain:
    """The robot's nodes in one piece."""

    def __init__(self, goal: Goal, settings: LocalSettings) -> None:
        self._goal = goal
        self._planner = LocalPlanner(JACKAL, settings)
        self._surroundings = Surroundings()
        self._response = ResponseEstimator()
        self._memory = control.Memory()
        self._intent: Intent | None = None
        self._perception = PerceptionConfig(mapping="slam")
        self.cycles_ms: list[float] = []

    def tick(self, state: RobotState, scan: LaserScan | None) -> CmdVel:
        """The command of one tick."""
        self._response.state(state)
        if scan is not None:
            world = perception.step(self._perception, JACKAL, scan)
            world = self._surroundings.add(world, LIDAR, scan, state.pose)
            self._intent = self._decide(state, world)
        inputs = control.Inputs(state=state, intent=self._intent)
        self._memory, command = control.step(JACKAL, self._memory, inputs)
        command = replace(command, boot=BOOT, tick=state.tick)
        self._response.command(command)
        return command

    def _decide(self, state: RobotState, world: WorldModel) -> Intent:
        began = time.thread_time()
        sent = self._response.sent(state.tick - SENT_TICKS, state.tick - 1)
        moment = Moment(
            tick=state.tick,
            pose=state.pose,
            velocity=state.velocity,
            goal=self._goal,
            hits=hits(world).astype(np.float64),
            obstacles=world.obstacles,
            response=self._response.response,
            sent=tuple(Sent(tick, velocity) for tick, velocity in sent),
        )
        plan = self._planner.plan(moment)
        self.cycles_ms.append((time.thread_time() - began) * 1e3)
        return Intent(
            twist=plan.twist,
            trajectory=plan.trajectory,
            follow=bool(plan.trajectory),
            response=moment.response,
            behaviour="navigate",
            reason=plan.reason,
            basis=state.tick,
        )


def drive(world: World, trial: int, conditions: Conditions, settings: LocalSettings) -> Trial:
    """One trial in one world; the same arguments give the same result."""
    plant = Plant(conditions, world.start, SEED * world.number + trial)
    brain = Brain(_as_seen_from(world.start, world.goal), settings)
    limits, output = limits_of(JACKAL), ZERO
    least, begun, tick, result = math.inf, 0, 0, ""
    while not result:
        tick += 1
        discs = world.discs(APART_S * trial + tick * TICK_S)
        least = min(least, plant.clearance(discs))
        if not begun and math.dist((plant.x, plant.y), world.start[:2]) > BEGUN_M:
            begun = tick
        result = _result(plant, world, least, (tick - begun) * TICK_S)
        command = brain.tick(_state(plant, tick), _scan(plant, LIDAR, discs, tick))
        asked = Velocity(linear_x=command.linear_x, angular_z=command.angular_z)
        output = ramp(output, clamp(asked, limits), limits, TICK_S)
        plant.tick(output)
    seconds = (tick - begun) * TICK_S
    best = world.length / 2.0
    return Trial(
        world=world.number,
        trial=trial,
        result=result,
        seconds=seconds,
        least_clearance=least,
        score=(result == "success") * best / min(max(seconds, 2 * best), 8 * best),
        cycles_ms=tuple(brain.cycles_ms),
    )


def _result(plant: Plant, world: World, least: float, seconds: float) -> str:
    if least <= 0.0:
        return "collision"
    if math.dist((plant.x, plant.y), world.goal) < REACHED_M:
        return "success"
    return "timeout" if seconds > LIMIT_S else ""


def _as_seen_from(start: tuple[float, float, float], goal: tuple[float, float]) -> Goal:
    """Where odometry begins, there is the robot's origin."""
    dx, dy = goal[0] - start[0], goal[1] - start[1]
    cosine, sine = math.cos(start[2]), math.sin(start[2])
    return Goal(x=cosine * dx + sine * dy, y=cosine * dy - sine * dx)


def _state(plant: Plant, tick: int) -> RobotState:
    return RobotState(
        robot_type=JACKAL.robot_type,
        pose=plant.odometry,
        velocity=plant.velocity,
        gate=GateStatus(mode="enabled", commander=BRAIN, enables=1),
        boot=BOOT,
        tick=tick,
    )


def _scan(plant: Plant, lidar: Lidar, discs: Floats, tick: int) -> LaserScan | None:
    if tick % SCAN_TICKS:
        return None
    return LaserScan(
        angle_min=-FIELD_OF_VIEW / 2,
        angle_increment=FIELD_OF_VIEW / (lidar.beams - 1),
        range_min=lidar.range_min,
        range_max=lidar.range_max,
        ranges=ranges_bytes(plant.scan(lidar, discs)),
        boot=BOOT,
        tick=tick,
        basis=tick,
    )
