"""Processes that are killed, frozen, or have a part that hangs."""

import asyncio
import signal

from gigabrain_zenoh.qa.faults.fault import FaultRow, Stage
from gigabrain_zenoh.qa.faults.rig.rig import (
    BRAKES,
    MOVED_AGAIN,
    NONE_STALE,
    RESTED_TICKS,
    STALE,
    STAYS_STILL,
    STOPS_IN_TIME,
    TRAVEL,
    ZERO,
    Rig,
    Stop,
    broken,
    deployment_of,
    stop_by,
)
from gigabrain_zenoh.qa.judging import Figure, Measured, Skipped, worse_of
from gigabrain_zenoh.qa.probe import TICK_MS, moving, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime.managed_process import Backoff

FROZEN_TICKS, LONG_FROZEN_TICKS = 250, 3000  # 5 s, 60 s
NEVER_THAWED: dict[Stage, tuple[str, ...]] = {
    "auto": ("perception", "decision", "control", "safety"),
    "line": ("driver",),
}
ROOM_M = 0.8
DRIVING = 0.05  # [m/s], [rad/s]

ENABLED_WITHOUT_SAFETY = Figure("enabled without it")
DRIVES_AGAIN = Figure("drives again after", "s", wall=True)
RECORDING_LOST = Figure("recording lost", "s")
UNREADABLE = Figure("earlier messages unreadable")
CONTROL_DELAYED = Figure("control delayed", "ms")


async def decision_killed(rig: Rig) -> Measured:
    """Send SIGKILL while it drives."""
    return await _killed(await rig.robot("sim"), "decision")


async def decision_frozen(rig: Rig) -> Measured:
    """Send SIGSTOP while it drives; liveliness would not notice."""
    return (await _frozen(await rig.robot("sim"), "decision", RESTED_TICKS))[1]


async def frozen_and_thawed(rig: Rig) -> Measured:
    """Send SIGCONT to decision and driver after a while: old messages move nothing."""
    robot = await rig.robot("sim")
    ticks = LONG_FROZEN_TICKS if rig.long else FROZEN_TICKS
    stop, _ = await _frozen(robot, "decision", ticks)
    decision = await _thawed(robot, stop.distance_m)
    await robot.drive()
    robot.freeze("driver")
    await asyncio.sleep(ticks * TICK_MS / 1e3)  # the robot's own time stands still with it
    robot.thaw()
    await until(lambda: robot.probe.state.gate.mode == "idle", "the gate shuts")
    await robot.probe.at_rest()
    return worse_of(decision, await _thawed(robot, await robot.travelled()))


async def control_killed_or_frozen(rig: Rig) -> Measured:
    """Kill control; then freeze and thaw it."""
    robot = await rig.robot("sim")
    killed = await _killed(robot, "control")
    stop, frozen = await _frozen(robot, "control", RESTED_TICKS)
    return worse_of(killed, worse_of(frozen, await _thawed(robot, stop.distance_m)))


async def perception_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze perception: the brain's world model grows old."""
    robot = await rig.robot("sim")
    killed = await _killed(robot, "perception")
    return worse_of(killed, (await _frozen(robot, "perception", RESTED_TICKS))[1])


async def safety_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze safety: the gate must not open without it."""
    robot = await rig.robot("sim")
    killed = await _killed(robot, "safety")
    stop, _ = await _frozen(robot, "safety", 0)
    enabled = await robot.probe.tries_to_enable()
    frozen = _figures(stop, await robot.travelled() - stop.distance_m)
    return {**worse_of(killed, frozen), ENABLED_WITHOUT_SAFETY: enabled}


async def decision_loop_hangs(rig: Rig) -> Measured:
    """Hang decision's planning while it repeats its last intent 50 times a second."""
    await rig.give_up()
    change = broken(("decision",), "hanging")
    async with rig.new(deployment_of(rig.options, "sim"), change) as robot:
        stop = await stop_by(robot, lambda: robot.signal("decision", signal.SIGUSR1))
        await robot.check()
    return stop.figures()


async def frozen_until_restarted(rig: Rig) -> Measured:
    """Send SIGSTOP without SIGCONT: the supervisor kills and restarts the process."""
    await rig.give_up()
    longest_s, stale = 0.0, 0.0
    for stage, victims in NEVER_THAWED.items():
        deployment = deployment_of(rig.options, stage, "auto")
        async with rig.new(deployment, backoff=Backoff(), keep_stuck=False) as robot:
            await robot.settle()
            for victim in victims:
                longest_s = max(longest_s, await _restart_s(robot, victim))
            stale += float((await robot.probe.truth())["stale_commands_executed"])
            await robot.check()
    return {DRIVES_AGAIN: longest_s, STALE: stale}


async def recorder_killed(rig: Rig) -> Measured:
    """Kill the recorder, and treat its files and its disk badly, where a recorder is installed."""
    try:
        from gigabrain_zenoh.qa.faults.rows.recorder_faults import kill_recorder
    except ModuleNotFoundError as error:
        raise Skipped(f"needs gigabrain-zenoh[record]: {error.name} is missing") from None
    lost_s, unreadable, late_ms = await kill_recorder(rig)
    return {RECORDING_LOST: lost_s, UNREADABLE: unreadable, CONTROL_DELAYED: late_ms}


async def _restart_s(robot: RobotUnderTest, victim: str) -> float:
    """Return the time from the freeze until the robot drives with a new process [s]."""
    loop = asyncio.get_running_loop()
    await robot.drive(ROOM_M)
    pid = robot.pid(victim)
    robot.freeze(victim)
    frozen_s = loop.time()
    await robot.restarted(victim, pid)
    await robot.release()
    probe = robot.probe
    await until(
        lambda: probe.state.gate.mode == "enabled" and moving([probe.state], DRIVING),
        "it drives again",
    )
    return loop.time() - frozen_s


async def _killed(robot: RobotUnderTest, victim: str) -> Measured:
    pid = robot.pid(victim)
    stop = await stop_by(robot, lambda: robot.kill(victim), victim)
    await robot.restarted(victim, pid)
    await robot.probe.ticks(RESTED_TICKS)
    return _figures(stop, await robot.travelled() - stop.distance_m)


async def _frozen(robot: RobotUnderTest, victim: str, ticks: int) -> tuple[Stop, Measured]:
    """Freeze a process for `ticks`; return how the robot stopped, with the travel after that."""
    stop = await stop_by(robot, lambda: robot.freeze(victim), victim)
    return stop, _figures(stop, await robot.travel_within(ticks))


async def _thawed(robot: RobotUnderTest, rest_m: float) -> Measured:
    """Thaw a process; return what it does until a person enables the robot."""
    robot.thaw()
    await robot.probe.ticks(RESTED_TICKS)
    truth = await robot.probe.truth()
    again_m = await robot.travelled() - rest_m
    return {STALE: float(truth["stale_commands_executed"]), MOVED_AGAIN: again_m}


def _figures(stop: Stop, again_m: float) -> Measured:
    return {**stop.figures(), MOVED_AGAIN: again_m}


ROWS = (
    FaultRow(1, decision_killed, "sim", (*STOPS_IN_TIME, STAYS_STILL)),
    FaultRow(2, decision_frozen, "sim", (*STOPS_IN_TIME, STAYS_STILL)),
    FaultRow(3, frozen_and_thawed, "sim", (NONE_STALE, STAYS_STILL)),
    FaultRow(4, control_killed_or_frozen, "sim", (*STOPS_IN_TIME, NONE_STALE, STAYS_STILL)),
    FaultRow(
        5, perception_killed_or_frozen, "sim",
        (BRAKES.at_most(320), ZERO.at_most(680), TRAVEL.at_most(0.15), STAYS_STILL),
    ),
    FaultRow(
        6, safety_killed_or_frozen, "sim",
        (
            BRAKES.at_most(250), ZERO.at_most(610), TRAVEL.at_most(0.1), STAYS_STILL,
            ENABLED_WITHOUT_SAFETY.at_most(0),
        ),
    ),
    FaultRow(
        9, decision_loop_hangs, "", (BRAKES.at_most(300), ZERO.at_most(660), TRAVEL.at_most(0.15)),
    ),
    FaultRow(
        32, recorder_killed, "",
        (RECORDING_LOST.at_most(0.5), UNREADABLE.at_most(0), CONTROL_DELAYED.at_most(20)),
        needs=("recorder",),
    ),
    FaultRow(48, frozen_until_restarted, "", (DRIVES_AGAIN.at_most(12), NONE_STALE)),
)  # fmt: skip
