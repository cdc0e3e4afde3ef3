"""Faults while an emulated arm moves or carries a thing: it rests, and drops nothing.

It is at rest when no joint is more than 2 deg from its final position.
"""

import asyncio
import inspect
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from functools import partial
from typing import Any

from gigabrain_drivers.driver.catalog import load_robot
from gigabrain_schemas.body import Joint
from gigabrain_zenoh.qa.arm_mission import LOOK_S, repeated_mission
from gigabrain_zenoh.qa.faults.rig import RESTED_TICKS, Rig, deployment_of
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, Skipped, fault_row, worse_of
from gigabrain_zenoh.qa.probe import until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest

SILENT_SERVO = 3  # the elbow's, while the first joint moves
JOG_RAD_S = 1.0  # as fast as it carries things
FAST_RAD_S = 0.8
MIDDLE_RAD = 0.7  # middle of the operator's motion, with room on both sides
TURN_RAD = 1.2  # from the middle, where the operator turns back
JOG_S = 0.05  # between two messages of the operator
CARRIES_RAD_S = 0.5  # of the fastest joint, while it carries a thing
ALL = ("router", "driver", "perception", "decision", "control", "safety")
REST_S = 1.5  # of simulated time, in which every arm has come to rest
AGAIN = Figure("moved again", "ms")
RESTS = Figure("at rest after", "ms")
DROPPED = Figure("dropped")
HELD = (RESTS.at_most(120), AGAIN.at_most(0.0))
KEPT = (*HELD, DROPPED.at_most(0))

Action = Callable[[], Awaitable[object] | object]
Motion = Callable[[RobotUnderTest], AbstractAsyncContextManager[None]]


@fault_row(51, "arm", *HELD)
async def arm_e_stop(rig: Rig) -> Measured:
    """Press the e-stop."""
    robot = await rig.robot("arm")
    press = partial(robot.operator.estop, "fault suite")
    return _but_dropped(await _stopped(robot, _jogged, press))


@fault_row(52, "arm", *HELD)
async def arm_driver_killed_or_frozen(rig: Rig) -> Measured:
    """Kill the driver, and freeze it: the servos hold their last goals."""
    return _but_dropped(await _killed_or_frozen(await rig.robot("arm"), _jogged, "driver"))


@fault_row(53, "arm", *HELD)
async def arm_control_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze control while it moves a joint for an operator."""
    return _but_dropped(await _killed_or_frozen(await rig.robot("arm"), _jogged, "control"))


@fault_row(54, "arm", *HELD)
async def arm_safety_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze safety."""
    return _but_dropped(await _killed_or_frozen(await rig.robot("arm"), _jogged, "safety"))


@fault_row(55, "arm", RESTS.at_most(400), AGAIN.at_most(0.0))
async def arm_servo_silent(rig: Rig) -> Measured:
    """Have one servo answer no more, while another one moves."""
    robot = await rig.robot("arm")
    mend = robot.break_body
    return _but_dropped(
        await _stopped(robot, _jogged, lambda: mend(base={"silent_servo": SILENT_SERVO}), mend)
    )


@fault_row(56, "arm", *KEPT)
async def carrying_e_stop(rig: Rig) -> Measured:
    """Press the e-stop while it carries a thing."""
    async with _table(rig) as robot:
        return await _stopped(robot, _carrying, partial(robot.operator.estop, "fault suite"))


@fault_row(57, "arm", *KEPT)
async def carrying_driver_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze the driver while it carries a thing."""
    async with _table(rig) as robot:
        return await _killed_or_frozen(robot, _carrying, "driver")


@fault_row(58, "arm", *KEPT)
async def carrying_router_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze the router while it carries a thing."""
    async with _table(rig) as robot:
        return await _killed_or_frozen(robot, _carrying, "router")


@fault_row(59, "arm", *KEPT)
async def carrying_control_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze control while it carries a thing."""
    async with _table(rig) as robot:
        return await _killed_or_frozen(robot, _carrying, "control")


@fault_row(60, "arm", *KEPT)
async def carrying_decision_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze decision while it carries a thing."""
    async with _table(rig) as robot:
        return await _killed_or_frozen(robot, _carrying, "decision")


@fault_row(61, "arm", *KEPT)
async def carrying_safety_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze safety while it carries a thing."""
    async with _table(rig) as robot:
        return await _killed_or_frozen(robot, _carrying, "safety")


@fault_row(62, "arm", *KEPT)
async def carrying_all_killed(rig: Rig) -> Measured:
    """Kill all processes at once while it carries a thing, as when their computer dies."""
    async with _table(rig) as robot:

        async def kill_all() -> None:
            pids = {name: robot.kill(name) for name in ALL}
            for name, pid in pids.items():
                await robot.until_restarted(name, pid)

        return await _stopped(robot, _carrying, kill_all)


def _table(rig: Rig) -> AbstractAsyncContextManager[RobotUnderTest]:
    """Return a robot of its own: its things are where its mission has them."""
    return rig.own_robot(deployment_of(rig.options, "arm"))


def _but_dropped(measured: Measured) -> Measured:
    """Return the figures of an arm that carried nothing."""
    return {figure: value for figure, value in measured.items() if figure != DROPPED}


async def _killed_or_frozen(robot: RobotUnderTest, motion: Motion, victim: str) -> Measured:
    """Freeze a process, and then kill it: one that was killed has forgotten what it did."""
    frozen = await _stopped(robot, motion, *_frozen(robot, victim))
    return worse_of(frozen, await _stopped(robot, motion, *_killed(robot, victim)))


def _frozen(robot: RobotUnderTest, victim: str) -> tuple[Action, Action]:
    if victim != "router":
        return lambda: robot.freeze(victim), robot.thaw

    async def cut() -> None:  # no process answers meanwhile
        robot.freeze(victim)
        await asyncio.sleep(REST_S)
        robot.thaw()

    return cut, robot.until_ready


def _killed(robot: RobotUnderTest, victim: str) -> tuple[Action, Action]:
    if victim == "router":
        return lambda: robot.kill_and_restart(victim), robot.until_ready
    pid = robot.pid(victim)
    return lambda: robot.kill(victim), lambda: robot.until_restarted(victim, pid)


async def _stopped(
    robot: RobotUnderTest, motion: Motion, fault: Action, mend: Action = lambda: None
) -> Measured:
    """Return how the arm comes to rest after a fault, and that it stays there once it is mended.

    Times are those of the emulated arm.
    """
    async with motion(robot):
        before = await robot.prompt_truth()
        if motion is _carrying and not before["carried"]:
            raise Failed("it carries nothing")
        await _done(fault)
        rested = await robot.wait_simulated(REST_S)
        await _done(mend)
        await until(lambda: robot.probe.state.link.connected, "the arm answers")
        await robot.probe.ticks(RESTED_TICKS)
        after = await robot.truth()
        if robot.probe.state.gate.mode == "enabled":
            raise Failed("the gate is open")
    return {
        RESTS: _since(rested, float(before["sim_seconds"])),
        AGAIN: _since(after, float(rested["joints_moved_s"])),
        DROPPED: int(before["carried"]) - int(after["carried"]),
    }


def _since(truth: dict[str, Any], begin_s: float) -> float:
    return max(0.0, round((float(truth["joints_moved_s"]) - begin_s) * 1e3))


async def _done(action: Action) -> None:
    result = action()
    if inspect.isawaitable(result):
        await result


@asynccontextmanager
async def _carrying(robot: RobotUnderTest) -> AsyncIterator[None]:
    """Have the mission of the body's demo move things; begins while it carries one fast."""
    probe, body = robot.probe, robot.deployment.body
    if not load_robot(body).demo.mission:
        raise Skipped(f"{body} has no mission")

    def fast() -> bool:
        intent = probe.intent.fresh()
        if probe.state.gate.mode != "enabled" or not (intent and intent.reason == "traverse"):
            return False
        return max(abs(joint.velocity) for joint in probe.state.joints) > CARRIES_RAD_S

    async def enable() -> None:
        while True:
            if probe.state.gate.mode == "idle":
                await probe.enable_brain()
            await asyncio.sleep(LOOK_S)

    await robot.release()
    enabling = asyncio.create_task(enable())
    try:
        async with repeated_mission(probe.bus, body):
            await until(fast, "it carries something fast")
    finally:
        enabling.cancel()
    yield


@asynccontextmanager
async def _jogged(robot: RobotUnderTest) -> AsyncIterator[None]:
    """Have an operator swing the first joint to and fro; begins while it moves fast."""
    probe, way = robot.probe, 1.0

    def first() -> Joint:
        return probe.state.joints[0]

    async def jog() -> None:
        nonlocal way
        while True:
            if probe.state.joints:
                way = -way if way * first().position > TURN_RAD else way
                robot.operator.jog({first().name: way * JOG_RAD_S})
            await asyncio.sleep(JOG_S)

    def fast() -> bool:
        if probe.state.gate.mode != "enabled" or not probe.state.joints:
            return False
        return way * first().velocity > FAST_RAD_S and abs(first().position) < MIDDLE_RAD

    await robot.release()
    await until(lambda: probe.state.gate.mode == "idle", "the gate is shut")
    jogging = asyncio.create_task(jog())
    try:
        await probe.enable_brain()
        await until(fast, "the joint moves fast")
        yield
    finally:
        jogging.cancel()
