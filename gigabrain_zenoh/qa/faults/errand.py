"""Somebody has sent the robot somewhere, and parts of its brain die on the way."""

import asyncio
import importlib.util
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import msgspec

from gigabrain_schemas.body import RobotState
from gigabrain_schemas.brain import PoseInMap
from gigabrain_schemas.topics import POSE
from gigabrain_zenoh.client.tasks import Tasks
from gigabrain_zenoh.qa.faults.fault import Failed, Measured, Skipped
from gigabrain_zenoh.qa.faults.rig import Options, Rig, deployment_of
from gigabrain_zenoh.qa.faults.stopping import TICK_MS
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import Deployment

NEEDS = ("numba", "cv2", "gtsam", "py_trees")  # the extra `nav`
PLACES = ((0.9, 0.9), (0.9, -0.9), (-0.9, 0.9), (-0.9, -0.9))  # [m], free ones of the arena
UNDER_WAY = 0.12  # [m/s]
DEATHS = (("decision", 0.4), ("perception", 1.0))  # [m] from where it began
THERE_S = 120.0  # of wall time
KILLS = 20  # in the long form
EXPLORED_M, EXPLORE_S = 1.0, 180.0  # before each of them, and how long that may take
GOES_ON = re.compile(r"the map of tick (\d+) goes on")


async def goal_goes_on(rig: Rig) -> Measured:
    """kill -9 of decision, then of perception: it stops, and then goes on without being told."""
    needs_navigation()
    await rig.give_up()
    async with rig.new(waiting_robot(rig.options)) as subject:
        tasks, truth = Tasks(subject.onlooker.bus), await subject.truth()
        place = max(PLACES, key=lambda one: _away(truth, one))
        task = await tasks.go_to(*in_map(truth, place))
        start = subject.onlooker.state
        after = [await _death(subject, victim, start, far_m) for victim, far_m in DEATHS]
        async with asyncio.timeout(THERE_S):
            ended = await tasks.result(task)
        await subject.onlooker.still()
        away_m = _away(await subject.truth(), place)
        await subject.check()
    worst = {name: max(one[name] for one in after) for name in after[0]}
    return {**worst, "given up": float(ended.state != "succeeded"), "off its goal": away_m}


async def map_goes_on(rig: Rig) -> Measured:
    """kill -9 of perception while the robot explores: the map made so far is there again."""
    needs_navigation()
    await rig.give_up()
    options = replace(rig.options, behaviour="navigate", world="house")
    async with rig.new(deployment_of(options, "auto")) as subject:
        trials = [await _map_death(subject) for _ in range(KILLS if rig.long else 2)]
        await subject.check()
    return {name: max(one[name] for one in trials) for name in trials[0]}


async def _map_death(subject: Subject) -> dict[str, float]:
    """Of perception, after some driving; times are of the robot's clock."""
    onlooker, poses = subject.onlooker, list[PoseInMap]()
    ends = onlooker.bus.subscribe(POSE, lambda _, pose: poses.append(pose))
    driven = onlooker.state
    await until(
        lambda: poses and onlooker.moved(driven) > EXPLORED_M and _under_way(onlooker.state)
        and poses[-1].localized,
        "it has explored", EXPLORE_S,
    )  # fmt: skip
    records, pid, killed = len(subject.records), subject.pid("perception"), onlooker.state.tick
    subject.kill("perception")
    await onlooker.still()
    poses.clear()
    await subject.restarted("perception", pid)
    await until(lambda: poses and poses[-1].localized, "it knows where it is")
    first, found = poses[0].basis, next(pose.basis for pose in poses if pose.localized)
    await until(lambda: _under_way(onlooker.state), "it drives again")
    ends()
    texts = (str(record.get("text", "")) for record in subject.records[records:])
    saved = [int(words[1]) for text in texts if (words := GOES_ON.match(text))]
    if not saved:
        raise Failed("a new map was begun")
    seconds = {
        "mapping lost": killed - saved[-1],
        "found after": found - first,
        "drives again after": onlooker.state.tick - killed,
    }
    return {name: ticks * TICK_MS / 1e3 for name, ticks in seconds.items()}


def _under_way(state: RobotState) -> bool:
    return state.gate.mode == "enabled" and state.velocity.linear_x > UNDER_WAY


def needs_navigation() -> None:
    """Raise Skipped where a robot cannot be sent to places."""
    if missing := [name for name in NEEDS if not importlib.util.find_spec(name)]:
        raise Skipped(f"needs gigabrain-zenoh[nav]: {missing[0]} is missing")


def waiting_robot(options: Options) -> Deployment:
    """A robot with a map that waits to be sent somewhere, and enables itself."""
    options = replace(options, behaviour="navigate", world="arena")
    deployment = deployment_of(options, "auto")
    decision = msgspec.structs.replace(deployment.decision, begin="wait")
    return msgspec.structs.replace(deployment, decision=decision)


async def _death(
    subject: Subject, victim: str, start: RobotState, far_m: float
) -> dict[str, float]:
    """Of one process, `far_m` from the start: how far the body goes, and when it drives again."""
    onlooker, distance = subject.onlooker, subject.distance

    def under_way() -> bool:
        return _under_way(onlooker.state)

    await until(lambda: under_way() and onlooker.moved(start) > far_m, "it is under way")
    before_m, pid = await distance(), subject.pid(victim)
    subject.kill(victim)
    await onlooker.still()
    rest_m = await distance()
    await subject.restarted(victim, pid)
    back, back_m = onlooker.state.tick, await distance()
    await until(under_way, f"it goes on after the death of {victim}")
    return {
        "travel": rest_m - before_m,
        "moved without it": back_m - rest_m,
        "goes on after": (onlooker.state.tick - back) * TICK_MS / 1e3,
    }


def _away(truth: Mapping[str, Any], place: tuple[float, float]) -> float:
    return math.dist((truth["true_x"], truth["true_y"]), place)


def in_map(truth: Mapping[str, Any], place: tuple[float, float]) -> tuple[float, float]:
    """A place of the world in the map, which begins where the body now is."""
    x, y = place[0] - truth["true_x"], place[1] - truth["true_y"]
    cosine, sine = math.cos(truth["true_yaw"]), math.sin(truth["true_yaw"])
    return cosine * x + sine * y, cosine * y - sine * x
