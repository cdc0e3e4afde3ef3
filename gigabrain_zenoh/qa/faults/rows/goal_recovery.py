"""Parts of the brain die while the robot drives to a goal or explores; it must go on by itself."""

import asyncio
import importlib.util
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import msgspec

from gigabrain_schemas.base import TICK_MS, Pose
from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.topics import POSE
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.geometry.pose import to_frame
from gigabrain_zenoh.launch.deployment import Deployment
from gigabrain_zenoh.qa.faults.rig import DRIVES_AGAIN, TRAVEL, Options, Rig, deployment_of
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, Skipped, fault_row, worse_of
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest

NEEDS = ("numba", "gtsam", "py_trees")  # the extra `nav`
PLACES = ((0.9, 0.9), (0.9, -0.9), (-0.9, 0.9), (-0.9, -0.9))  # [m], free places of the arena
MIN_SPEED = 0.12  # [m/s], of a robot that counts as under way
DEATHS = (("decision", 0.4), ("perception", 1.0))  # [m] from the start
ARRIVAL_S = 120.0  # of wall time
KILLS = 20  # in the long form
EXPLORED_M, EXPLORE_S = 1.0, 180.0  # distance before each kill, and its timeout

MOVED_WITHOUT = Figure("moved without it", "m")
GOES_ON = Figure("goes on after", "s")
GIVEN_UP = Figure("given up")
OFF_GOAL = Figure("off its goal", "m")
MAPPING_LOST = Figure("mapping lost", "s")
FOUND = Figure("found after", "s")


@fault_row(
    46, "", TRAVEL.at_most(0.15), MOVED_WITHOUT.at_most(0.005), GOES_ON.at_most(5),
    GIVEN_UP.at_most(0), OFF_GOAL.at_most(0.2), needs=("nav",),
)  # fmt: skip
async def goal_recovery(rig: Rig) -> Measured:
    """Kill decision, then perception: the robot stops, and then goes on to its goal by itself."""
    needs_navigation()
    async with rig.own_robot(waiting_robot(rig.options)) as robot:
        tasks, truth = Tasks(robot.probe.bus), await robot.truth()
        place = max(PLACES, key=lambda one: _distance(truth, one))
        task = await tasks.go_to(*in_map(truth, place))
        start, worst = robot.probe.state, dict[Figure, float]()
        for victim, far_m in DEATHS:
            worst = worse_of(worst, await _death(robot, victim, start, far_m))
        async with asyncio.timeout(ARRIVAL_S):
            ended = await tasks.result(task)
        await robot.probe.at_rest()
        off_m = _distance(await robot.truth(), place)
    return {**worst, GIVEN_UP: float(ended.state != "succeeded"), OFF_GOAL: off_m}


@fault_row(
    47, "", MAPPING_LOST.at_most(10), FOUND.at_most(5), DRIVES_AGAIN.at_most(10), needs=("nav",)
)
async def map_recovery(rig: Rig) -> Measured:
    """Kill perception while the robot explores: the map made so far must be restored."""
    needs_navigation()
    options = replace(rig.options, behaviour="navigate", world="house")
    worst = dict[Figure, float]()
    async with rig.own_robot(deployment_of(options, "auto")) as robot:
        for _ in range(KILLS if rig.long else 2):
            worst = worse_of(worst, await _map_death(robot))
    return worst


async def _map_death(robot: RobotUnderTest) -> Measured:
    """Kill perception after some driving; times are of the robot's clock."""
    probe, poses = robot.probe, list[PoseInMap]()
    unsubscribe = probe.bus.subscribe(POSE, lambda _, pose: poses.append(pose))
    start = probe.state
    await until(
        lambda: poses and probe.distance_from(start) > EXPLORED_M and _under_way(probe.state)
        and poses[-1].localized,
        "it has explored", EXPLORE_S,
    )  # fmt: skip
    records, pid, killed = len(robot.records), robot.pid("perception"), probe.state.tick
    robot.kill("perception")
    await probe.at_rest()
    poses.clear()
    await robot.until_restarted("perception", pid)
    await until(lambda: poses and poses[-1].localized, "it is localized")
    first, found = poses[0].basis, next(pose.basis for pose in poses if pose.localized)
    await until(lambda: _under_way(probe.state), "it drives again")
    unsubscribe()
    new = robot.records[records:]
    saved = [int(record["map_tick"]) for record in new if record.get("event") == "map_restored"]
    if not saved:
        raise Failed("a new map was begun")
    ticks = {
        MAPPING_LOST: killed - saved[-1],
        FOUND: found - first,
        DRIVES_AGAIN: probe.state.tick - killed,
    }
    return {figure: count * TICK_MS / 1e3 for figure, count in ticks.items()}


def _under_way(state: RobotState) -> bool:
    return state.gate.mode == "enabled" and state.velocity.linear_x > MIN_SPEED


def needs_navigation() -> None:
    """Raise Skipped where the extra `nav` is missing."""
    if missing := [name for name in NEEDS if not importlib.util.find_spec(name)]:
        raise Skipped(f"needs gigabrain-zenoh[nav]: {missing[0]} is missing")


def waiting_robot(options: Options) -> Deployment:
    """Return a robot with a map that waits for goals, and enables itself."""
    options = replace(options, behaviour="navigate", world="arena")
    deployment = deployment_of(options, "auto")
    decision = msgspec.structs.replace(
        deployment.decision, settings={**deployment.decision.settings, "start": "wait"}
    )
    return msgspec.structs.replace(deployment, decision=decision)


async def _death(robot: RobotUnderTest, victim: str, start: RobotState, far_m: float) -> Measured:
    """Kill one process `far_m` from the start."""
    probe = robot.probe

    def under_way() -> bool:
        return _under_way(probe.state)

    await until(lambda: under_way() and probe.distance_from(start) > far_m, "it is under way")
    before_m, pid = await robot.travelled(), robot.pid(victim)
    robot.kill(victim)
    await probe.at_rest()
    rest_m = await robot.travelled()
    await robot.until_restarted(victim, pid)
    back, back_m = probe.state.tick, await robot.travelled()
    await until(under_way, f"it goes on after the death of {victim}")
    return {
        TRAVEL: rest_m - before_m,
        MOVED_WITHOUT: back_m - rest_m,
        GOES_ON: (probe.state.tick - back) * TICK_MS / 1e3,
    }


def _distance(truth: Mapping[str, Any], place: tuple[float, float]) -> float:
    return math.dist((truth["true_x"], truth["true_y"]), place)


def in_map(truth: Mapping[str, Any], place: tuple[float, float]) -> tuple[float, float]:
    """Return a place of the world in the map, whose origin is where the body now is."""
    return to_frame(true_pose(truth), *place)


def true_pose(truth: Mapping[str, Any]) -> Pose:
    """Return the body's pose in the world, by the physics."""
    return Pose(x=truth["true_x"], y=truth["true_y"], yaw=truth["true_yaw"])
