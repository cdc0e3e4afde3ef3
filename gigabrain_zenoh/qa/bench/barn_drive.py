"""One trial: perception, decision's planning, control and the gate's limits, tick by tick.

They are the functions that the processes call, in the order in which messages wake them. The robot
hears of nothing but scans, odometry and its measured speed.
"""

import time

import numpy as np
from msgspec.structs import replace

from gigabrain_schemas.arrays import hits
from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel, Intent, WorldModel
from gigabrain_schemas.sensors import LaserScan
from gigabrain_zenoh.config.settings import PerceptionConfig
from gigabrain_zenoh.control import node as control
from gigabrain_zenoh.decision.response import ResponseEstimator
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.geometry.limits import ZERO, clamp, limits_of, ramp
from gigabrain_zenoh.navigation.local import Goal, LocalPlanner, LocalSettings, Moment, Sent
from gigabrain_zenoh.perception import node as perception
from gigabrain_zenoh.perception.obstacles.surroundings import Surroundings
from gigabrain_zenoh.qa.bench.barn_worlds import World
from gigabrain_zenoh.qa.bench.course import Course, Trial
from gigabrain_zenoh.qa.bench.plant import JACKAL, LIDAR, Conditions

TICK_S = TICK_NS / 1e9
BOOT = 1
SENT_TICKS = 30  # of commands, that planning looks back on
DRIVING = GateStatus(mode="enabled", commander=BRAIN, enables=1)


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


def drive(world: World, trial: int, conditions: Conditions, samples: int) -> Trial:
    """One trial in one world; the same arguments give the same result."""
    course = Course(world, trial, conditions)
    brain = Brain(course.goal, LocalSettings(samples=samples))
    limits, output = limits_of(JACKAL), ZERO
    while True:
        course.look()
        if course.result:
            return course.ended(tuple(brain.cycles_ms))
        scan, tick = course.scan(), course.tick
        state = replace(course.state(), gate=DRIVING, boot=BOOT, tick=tick)
        command = brain.tick(state, scan and replace(scan, boot=BOOT, tick=tick, basis=tick))
        asked = Velocity(linear_x=command.linear_x, angular_z=command.angular_z)
        output = ramp(output, clamp(asked, limits), limits, TICK_S)
        course.advance(output)
