"""Somebody has sent the robot somewhere, and parts of its brain die on the way."""

import asyncio
import importlib.util
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import msgspec

from gigabrain_schemas.body import RobotState
from gigabrain_zenoh.deployment import Deployment
from gigabrain_zenoh.faults.fault import Measured, Skipped
from gigabrain_zenoh.faults.rig import Options, Rig, deployment_of
from gigabrain_zenoh.faults.stopping import TICK_MS
from gigabrain_zenoh.faults.subject import Subject
from gigabrain_zenoh.faults.waiting import until
from gigabrain_zenoh.task_client import Tasks

NEEDS = ("numba", "cv2", "gtsam", "py_trees")  # the extra `nav`
PLACES = ((0.9, 0.9), (0.9, -0.9), (-0.9, 0.9), (-0.9, -0.9))  # [m], free ones of the arena
UNDER_WAY = 0.12  # [m/s]
DEATHS = (("decision", 0.4), ("perception", 1.0))  # [m] from where it began
THERE_S = 120.0  # of wall time


async def goal_goes_on(rig: Rig) -> Measured:
    """kill -9 of decision, then of perception: it stops, and then goes on without being told."""
    if missing := [name for name in NEEDS if not importlib.util.find_spec(name)]:
        raise Skipped(f"needs gigabrain-zenoh[nav]: {missing[0]} is missing")
    await rig.give_up()
    async with rig.new(_waiting(rig.options)) as subject:
        tasks, truth = Tasks(subject.onlooker.bus), await subject.truth()
        place = max(PLACES, key=lambda one: _away(truth, one))
        task = await tasks.go_to(*_in_map(truth, place))
        start = subject.onlooker.state
        after = [await _death(subject, victim, start, far_m) for victim, far_m in DEATHS]
        async with asyncio.timeout(THERE_S):
            ended = await tasks.result(task)
        await subject.onlooker.still()
        away_m = _away(await subject.truth(), place)
        await subject.check()
    worst = {name: max(one[name] for one in after) for name in after[0]}
    return {**worst, "given up": float(ended.state != "succeeded"), "off its goal": away_m}


def _waiting(options: Options) -> Deployment:
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
        now = onlooker.state
        return now.gate.mode == "enabled" and now.velocity.linear_x > UNDER_WAY

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


def _in_map(truth: Mapping[str, Any], place: tuple[float, float]) -> tuple[float, float]:
    """A place of the world in the map, which begins where the body now is."""
    x, y = place[0] - truth["true_x"], place[1] - truth["true_y"]
    cosine, sine = math.cos(truth["true_yaw"]), math.sin(truth["true_yaw"])
    return cosine * x + sine * y, cosine * y - sine * x
