"""One trial: perception, planning, control and the gate's limits, tick by tick, with a plant."""

import math
import time
from collections import deque

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from gigabrain_schemas.arrays import hits, ranges_bytes
from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh import control, perception
from gigabrain_zenoh.bench.barn_worlds import World
from gigabrain_zenoh.bench.plant import FIELD_OF_VIEW, JACKAL, Conditions, Plant
from gigabrain_zenoh.gate import BRAIN
from gigabrain_zenoh.limits import ZERO, clamp, limits_of, ramp
from gigabrain_zenoh.navigation.local import Goal, LocalPlanner, LocalSettings, Moment, Sent
from gigabrain_zenoh.obstacles.surroundings import Surroundings
from gigabrain_zenoh.response import ResponseEstimator
from gigabrain_zenoh.settings import PerceptionConfig

TICK_S = 0.02
BOOT = 1
SCAN_TICKS = 2
LIMIT_S = 100.0
REACHED_M, BEGUN_M = 1.0, 0.1  # [m], from goal and start


class Trial(Struct, frozen=True, kw_only=True):
    """How one trial ended."""

    world: int
    trial: int
    result: str  # success, collision or timeout
    seconds: float  # from leaving the start
    least_clearance: float  # [m]
    cycles_ms: tuple[float, ...] = ()  # of planning, as long as this thread ran


class Brain:
    """The robot's own nodes, as far as they are needed, in one piece."""

    def __init__(self, goal: Goal, settings: LocalSettings) -> None:
        self._goal = goal
        self._planner = LocalPlanner(JACKAL, settings)
        self._surroundings = Surroundings()
        self._estimator = ResponseEstimator()
        self._memory, self._intent = control.Memory(), None
        self._perception = PerceptionConfig(mapping="slam")
        self.cycles_ms: list[float] = []
        self.plan = None

    def tick(self, state: RobotState, scan: LaserScan | None) -> CmdVel:
        self._estimator.state(state)
        if scan is not None:
            world = perception.step(self._perception, JACKAL, scan)
            world = self._surroundings.add(world, JACKAL.lidar, scan, state.pose)
            self._intent = self._decide(state, world)
        inputs = control.Inputs(state=state, intent=self._intent)
        self._memory, command = control.step(JACKAL, self._memory, inputs)
        command = replace(command, boot=BOOT, tick=state.tick, source=BRAIN)
        self._estimator.command(command)
        return command

    def _decide(self, state: RobotState, world: WorldModel) -> Intent:
        began = time.thread_time()
        sent = self._estimator.sent(state.tick - 30, state.tick - 1)
        plan = self._planner.plan(
            Moment(
                tick=state.tick,
                pose=state.pose,
                velocity=state.velocity,
                goal=self._goal,
                hits=hits(world).astype(np.float64),
                obstacles=world.obstacles,
                response=self._estimator.response,
                turn_gain=self._estimator.turn_gain,
                sent=tuple(Sent(tick, velocity) for tick, velocity in sent),
            )
        )
        self.cycles_ms.append((time.thread_time() - began) * 1e3)
        self.plan = plan
        return Intent(
            twist=plan.twist, trajectory=plan.trajectory, behaviour="navigate",
            reason=plan.reason, basis=state.tick, response=self._estimator.response,
        )


def drive(world: World, trial: int, conditions: Conditions, settings: LocalSettings, log=None) -> Trial:
    plant = Plant(conditions, world.start, seed=1000 * world.number + trial)
    x, y, yaw = world.start
    dx, dy = world.goal[0] - x, world.goal[1] - y
    c, s = math.cos(yaw), math.sin(yaw)
    goal = Goal(x=c * dx + s * dy, y=c * dy - s * dx)
    brain = Brain(goal, settings)
    limits, output = limits_of(JACKAL), ZERO
    least, begun = math.inf, None
    at = 7.3 * trial
    tick = 0
    def end(result):
        return Trial(world=world.number, trial=trial, result=result,
            seconds=(tick - (begun or 0)) * TICK_S, least_clearance=least,
            cycles_ms=tuple(brain.cycles_ms))
    while True:
        tick += 1
        discs = world.discs(at + tick * TICK_S)
        least = min(least, plant.clearance(discs))
        if least <= 0:
            return end("collision")
        if math.hypot(plant.x - world.goal[0], plant.y - world.goal[1]) < REACHED_M:
            return end("success")
        if begun is None and math.hypot(plant.x - x, plant.y - y) > BEGUN_M:
            begun = tick
        if (tick - (begun or 0)) * TICK_S > LIMIT_S:
            return end("timeout")
        state = RobotState(robot_type="jackal", pose=plant.odometry, velocity=plant.velocity,
            gate=GateStatus(mode="enabled", commander=BRAIN, enables=1), boot=BOOT, tick=tick)
        scan = None
        if tick % SCAN_TICKS == 0:
            scan = LaserScan(angle_min=-FIELD_OF_VIEW / 2, angle_increment=FIELD_OF_VIEW / (JACKAL.lidar.beams - 1),
                range_min=JACKAL.lidar.range_min, range_max=JACKAL.lidar.range_max,
                ranges=ranges_bytes(plant.scan(JACKAL.lidar, discs)), boot=BOOT, tick=tick, basis=tick)
        cmd = brain.tick(state, scan)
        if log is not None:
            log.append((tick, plant.x, plant.y, plant.yaw, plant.v, plant.w, cmd.linear_x, cmd.angular_z, least, brain.plan, brain._estimator.response, brain._estimator.turn_gain))
        target = clamp(Velocity(linear_x=cmd.linear_x, linear_y=cmd.linear_y, angular_z=cmd.angular_z), limits)
        output = ramp(output, target, limits, TICK_S)
        plant.tick(output)
