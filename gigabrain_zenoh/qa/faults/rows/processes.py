"""Processes that are killed, frozen, or have a part that hangs."""

import asyncio
import contextlib
import itertools
import math
import random
import signal
import time
from collections.abc import Mapping
from typing import Any

import psutil

from gigabrain_schemas.base import TICK_MS
from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh.qa.faults.rig import (
    BRAKES,
    DRIVES_AGAIN,
    DRIVES_AGAIN_WALL,
    MOTORS_ZERO,
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
    forged_command,
    forging,
    stop_by,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, Skipped, Stage, fault_row, worse_of
from gigabrain_zenoh.qa.probe import moving, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime import fork_server, forking
from gigabrain_zenoh.runtime.managed_process import Backoff

FROZEN_TICKS, LONG_FROZEN_TICKS = 250, 3000  # 5 s, 60 s
NEVER_THAWED: dict[Stage, tuple[str, ...]] = {
    "auto": ("perception", "decision", "control", "safety"),
    "line": ("driver",),
}
ROOM_M = 0.8
DRIVING = 0.05  # [m/s], [rad/s]

ENABLED_WITHOUT = Figure("enabled without it")
RECORDING_LOST = Figure("recording lost", "s")
UNREADABLE = Figure("earlier messages unreadable")
CONTROL_DELAYED = Figure("control delayed", "ms")


VICTIMS = ("router", "driver", "perception", "decision", "control", "safety")
ORDERS = 60  # sampled, in the long form
AFTER_S = 1.0  # of simulated time, for which a body is observed after a death
OLD_COMMANDS = 25
MAX_STARTS = 20
NOT_LATCHED = Figure("not latched at start")
ENABLED_LATCHED = Figure("enabled while latched")
OLD_OBEYED = Figure("commands of the old boot obeyed")
STARTS = Figure("starts")
READY_AFTER = Figure("ready after", "s", wall=True)
NOT_REPORTED = Figure("faults not reported")
WAIT_TOO_SHORT = Figure("wait too short", "s")
CPU_ADDED = Figure("cpu added", "%")
IDLE = Figure("idle after", "s")
DISPLACED, POSE_JUMPED = Figure("displaced", "m"), Figure("pose jumped", "m")
LATCH_IGNORED = Figure("latches ignored")


@fault_row(1, "sim", *STOPS_IN_TIME, STAYS_STILL)
async def decision_killed(rig: Rig) -> Measured:
    """Send SIGKILL while it drives."""
    return await _killed(await rig.robot("sim"), "decision")


@fault_row(2, "sim", *STOPS_IN_TIME, STAYS_STILL)
async def decision_frozen(rig: Rig) -> Measured:
    """Send SIGSTOP while it drives; liveliness would not notice."""
    return (await _frozen(await rig.robot("sim"), "decision", RESTED_TICKS))[1]


@fault_row(3, "sim", NONE_STALE, STAYS_STILL)
async def frozen_and_thawed(rig: Rig) -> Measured:
    """Send SIGCONT to decision and driver after a while: old messages move nothing."""
    robot = await rig.robot("sim")
    ticks = LONG_FROZEN_TICKS if rig.long else FROZEN_TICKS
    stop, _ = await _frozen(robot, "decision", ticks)
    decision = await _thawed(robot, stop.distance_m)
    await robot.until_driving()
    robot.freeze("driver")
    await asyncio.sleep(ticks * TICK_MS / 1e3)  # the robot's own time stands still with it
    robot.thaw()
    await until(lambda: robot.probe.state.gate.mode == "idle", "the gate shuts")
    await robot.probe.at_rest()
    return worse_of(decision, await _thawed(robot, await robot.travelled()))


@fault_row(4, "sim", *STOPS_IN_TIME, NONE_STALE, STAYS_STILL)
async def control_killed_or_frozen(rig: Rig) -> Measured:
    """Kill control; then freeze and thaw it."""
    robot = await rig.robot("sim")
    killed = await _killed(robot, "control")
    stop, frozen = await _frozen(robot, "control", RESTED_TICKS)
    return worse_of(killed, worse_of(frozen, await _thawed(robot, stop.distance_m)))


@fault_row(5, "sim", BRAKES.at_most(320), ZERO.at_most(680), TRAVEL.at_most(0.15), STAYS_STILL)
async def perception_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze perception: the brain's world model grows old."""
    robot = await rig.robot("sim")
    killed = await _killed(robot, "perception")
    return worse_of(killed, (await _frozen(robot, "perception", RESTED_TICKS))[1])


@fault_row(
    6, "sim", BRAKES.at_most(250), ZERO.at_most(610), TRAVEL.at_most(0.1), STAYS_STILL,
    ENABLED_WITHOUT.at_most(0),
)  # fmt: skip
async def safety_killed_or_frozen(rig: Rig) -> Measured:
    """Kill and freeze safety: the gate must not open without it."""
    robot = await rig.robot("sim")
    killed = await _killed(robot, "safety")
    stop, _ = await _frozen(robot, "safety", 0)
    enabled = await robot.probe.count_enables()
    frozen = _figures(stop, await robot.travelled() - stop.distance_m)
    return {**worse_of(killed, frozen), ENABLED_WITHOUT: enabled}


@fault_row(9, "", BRAKES.at_most(300), ZERO.at_most(660), TRAVEL.at_most(0.15))
async def decision_loop_hangs(rig: Rig) -> Measured:
    """Hang decision's planning while it repeats its last intent 50 times a second."""
    change = broken(("decision",), "hanging")
    async with rig.own_robot(deployment_of(rig.options, "sim"), change) as robot:
        stop = await stop_by(robot, lambda: robot.signal("decision", signal.SIGUSR1))
    return stop.figures()


@fault_row(48, "", DRIVES_AGAIN_WALL.at_most(12), NONE_STALE)
async def frozen_until_restarted(rig: Rig) -> Measured:
    """Send SIGSTOP without SIGCONT: the supervisor kills and restarts the process."""
    longest_s, stale = 0.0, 0.0
    for stage, victims in NEVER_THAWED.items():
        deployment = deployment_of(rig.options, stage, "auto")
        async with rig.own_robot(deployment, backoff=Backoff(), keep_stuck=False) as robot:
            for victim in victims:
                longest_s = max(longest_s, await _restart_s(robot, victim))
            stale += float((await robot.probe.truth())["stale_commands_executed"])
    return {DRIVES_AGAIN_WALL: longest_s, STALE: stale}


@fault_row(
    32, "", RECORDING_LOST.at_most(0.5), UNREADABLE.at_most(0), CONTROL_DELAYED.at_most(20),
    needs=("recorder",),
)  # fmt: skip
async def recorder_killed(rig: Rig) -> Measured:
    """Kill the recorder, and treat its files and its disk badly, where a recorder is installed."""
    try:
        from gigabrain_zenoh.qa.faults.recorder_faults import kill_recorder
    except ModuleNotFoundError as error:
        raise Skipped(f"needs gigabrain-zenoh[record]: {error.name} is missing") from None
    lost_s, unreadable, late_ms = await kill_recorder(rig)
    return {RECORDING_LOST: lost_s, UNREADABLE: unreadable, CONTROL_DELAYED: late_ms}


async def _restart_s(robot: RobotUnderTest, victim: str) -> float:
    """Return the time from the freeze until the robot drives with a new process [s]."""
    loop = asyncio.get_running_loop()
    await robot.until_driving(ROOM_M)
    pid = robot.pid(victim)
    robot.freeze(victim)
    frozen_s = loop.time()
    await robot.until_restarted(victim, pid)
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
    await robot.until_restarted(victim, pid)
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


@fault_row(
    7, "line", MOTORS_ZERO.at_most(150), NOT_LATCHED.at_most(0), ENABLED_LATCHED.at_most(0),
    OLD_OBEYED.at_most(0), STAYS_STILL,
)  # fmt: skip
async def gate_killed(rig: Rig) -> Measured:
    """Kill the gate, which is in the driver's process: it starts latched, with a new boot."""
    robot = await rig.robot("line")
    probe, old = robot.probe, robot.probe.state.boot
    zero_ms, _ = await _without_driver(robot)
    await until(lambda: probe.state.boot != old, "the driver's restart")
    await probe.ticks(10)
    born = [state for state in probe.states if state.boot == probe.state.boot]
    still_m = await robot.travelled()
    await robot.until_ready()
    enabled = await probe.count_enables()
    await robot.release()
    await robot.operator.enable(probe.bus.process)
    before_s = float((await robot.truth())["motors_moved_s"])
    async with forging(robot.endpoint) as forger:
        for number in range(OLD_COMMANDS):
            tick = probe.state.tick
            command = forged_command(
                probe, 0.2, 1_000_000 + number, boot=old, tick=tick, basis=tick
            )
            forger.send(CMD_VEL, command)
            await probe.ticks(1)
    truth = await robot.truth()
    return {
        MOTORS_ZERO: zero_ms,
        NOT_LATCHED: sum(state.gate.mode != "latched" for state in born[:10]),
        ENABLED_LATCHED: enabled,
        OLD_OBEYED: float(truth["motors_moved_s"] > before_s),
        MOVED_AGAIN: float(truth["distance_m"]) - still_m,
    }


@fault_row(8, "line", MOTORS_ZERO.at_most(150), TRAVEL.at_most(0.1))
async def driver_killed(rig: Rig) -> Measured:
    """Kill the driver: the body must stop by its own watchdog."""
    zero_ms, travel_m = await _without_driver(await rig.robot("line"))
    return {MOTORS_ZERO: zero_ms, TRAVEL: travel_m}


async def _without_driver(robot: RobotUnderTest) -> tuple[float, float]:
    """Return the time until the motors are commanded zero [ms], and the travel after that [m].

    The time is the physics' own, to within one of its steps.
    """
    await robot.until_driving()
    pid, before = robot.pid("driver"), await robot.prompt_truth()
    robot.kill("driver")
    after = await robot.wait_simulated(AFTER_S)
    await robot.until_restarted("driver", pid)
    zero_s = float(after["motors_moved_s"]) - float(before["sim_seconds"])
    return zero_s * 1e3, float(after["distance_m"]) - float(before["distance_m"])


@fault_row(64, "line", DISPLACED.at_most(0.1), POSE_JUMPED.at_most(0.1), STAYS_STILL)
async def emulator_killed(rig: Rig) -> Measured:
    """Kill the emulator, as by a power cut of the body: it stays where it is, in its pose too."""
    robot = await rig.robot("line")
    probe = robot.probe
    while await robot.travelled() < ROOM_M:  # away from the start
        await robot.until_driving()
    before = await robot.prompt_truth()
    pid = robot.kill("emulator")
    await until(lambda: not probe.state.link.connected, "the driver loses the body")
    lost = probe.state.pose
    await robot.until_restarted("emulator", pid)
    await until(lambda: probe.state.link.connected, "the driver finds the body")
    found, after = probe.state.pose, await robot.truth()
    await probe.ticks(RESTED_TICKS)
    return {
        DISPLACED: math.dist(_place(before), _place(after)),
        POSE_JUMPED: math.dist((lost.x, lost.y), (found.x, found.y)),
        MOVED_AGAIN: await robot.travelled() - float(after["distance_m"]),
    }


def _place(truth: Mapping[str, Any]) -> tuple[float, float]:
    return float(truth["true_x"]), float(truth["true_y"])


@fault_row(11, "line", IDLE.at_most(10), STAYS_STILL)
async def every_process_and_pair_killed(rig: Rig) -> Measured:
    """Kill single processes, pairs, and all in sampled orders; more of them in the long form."""
    robot = await rig.robot("line")
    worst: Measured = {}
    for victims in _groups(rig.long):
        worst = worse_of(worst, await _group_killed(robot, victims))
    return worst


def _groups(long: bool) -> list[tuple[str, ...]]:
    """Return the victims of each trial, in the order in which they are killed."""
    chance = random.Random(0)
    orders = [tuple(chance.sample(VICTIMS, len(VICTIMS))) for _ in range(ORDERS)]
    if long:
        singles = [(name,) for name in VICTIMS]
        return [*singles, *itertools.combinations(VICTIMS, 2), *orders]
    first = orders[0]
    return [first[0:2], first[2:4], first[4:6], orders[1]]


async def _group_killed(robot: RobotUnderTest, victims: tuple[str, ...]) -> Measured:
    probe = robot.probe
    await robot.until_driving(ROOM_M)
    pids = {name: robot.pid(name) for name in victims}
    begin_s = float((await robot.truth())["sim_seconds"])
    for name in victims:
        robot.kill(name)
    for name, pid in pids.items():
        await robot.until_restarted(name, pid)
    newest = probe.states[-1]
    await until(lambda: probe.state is not newest, "states go on")
    await until(lambda: probe.state.gate.mode in ("idle", "latched"), "the gate is shut")
    await probe.at_rest()
    rest = await robot.truth()
    await probe.ticks(RESTED_TICKS)
    return {
        IDLE: float(rest["sim_seconds"]) - begin_s,
        MOVED_AGAIN: await robot.travelled() - float(rest["distance_m"]),
    }


@fault_row(
    10, "", STARTS.at_most(5), WAIT_TOO_SHORT.at_most(0), ENABLED_WITHOUT.at_most(0),
    CPU_ADDED.at_most(5),
)  # fmt: skip
async def crash_loop(rig: Rig) -> Measured:
    """Kill a process at each start: it is given up after five, and the gate stays shut."""
    deployment = deployment_of(rig.options, "sim")
    async with rig.own_robot(deployment, backoff=Backoff(), checked=False) as robot:
        await robot.until_driving()
        usual = await _cpu_percent()
        births, deaths = await _kill_all_starts(robot, "perception")
        await robot.probe.at_rest()
        enabled = await robot.probe.count_enables()
        unusual = await _cpu_percent()
        started_again = robot.supervisor.statuses["perception"].pid is not None
    waits = [birth - death for birth, death in zip(births[1:], deaths, strict=False)]
    short = [0.2 * 2**n - wait for n, wait in enumerate(waits)]
    return {
        STARTS: len(births) + started_again,
        WAIT_TOO_SHORT: max(0.0, *short),
        ENABLED_WITHOUT: enabled,
        CPU_ADDED: max(0.0, unusual - usual),
    }


async def _cpu_percent() -> float:
    """Return the CPU share of this process, which holds supervisor and probe [% of a core]."""
    began_s, cpu_s = time.monotonic(), time.process_time()
    await asyncio.sleep(AFTER_S)
    return 100 * (time.process_time() - cpu_s) / (time.monotonic() - began_s)


async def _kill_all_starts(robot: RobotUnderTest, name: str) -> tuple[list[float], list[float]]:
    """Kill a process at each start until it is given up; return times of starts and deaths [s]."""
    status, births, deaths, seen = robot.supervisor.statuses[name], [], [], 0
    while status.state != "given up":
        if status.pid and status.pid != seen:
            seen = status.pid
            births.append(time.monotonic())
            robot.kill(name)
            deaths.append(time.monotonic())
        if len(births) > MAX_STARTS:
            raise Failed(f"{name} is never given up")
        await asyncio.sleep(0.005)
    return births, deaths


@fault_row(45, "auto", DRIVES_AGAIN.at_most(3), NONE_STALE, LATCH_IGNORED.at_most(0))
async def automatic_recovery(rig: Rig) -> Measured:
    """With `resume: auto` the robot drives again after any death, but never out of a latch."""
    robot = await rig.robot("auto")
    longest = 0.0
    for victim in VICTIMS:
        longest = max(longest, await _recovery_s(robot, victim))
    await robot.until_driving(ROOM_M)
    await robot.operator.estop("fault suite")
    await robot.probe.ticks(100)
    unlatched = robot.probe.state.gate.mode != "latched"
    truth = await robot.probe.truth()
    return {
        DRIVES_AGAIN: longest,
        STALE: float(truth["stale_commands_executed"]),
        LATCH_IGNORED: float(unlatched),
    }


async def _recovery_s(robot: RobotUnderTest, victim: str) -> float:
    """Return the time from the victim's return until the brain drives, in the robot's time [s]."""
    probe = robot.probe
    await robot.until_driving(ROOM_M)
    start = probe.state
    await robot.kill_and_restart(victim)
    back = probe.state

    def drives_on() -> bool:
        now = probe.state
        again = now.boot != start.boot or now.gate.enables > start.gate.enables
        return again and now.gate.mode == "enabled"

    await until(drives_on, "it drives on")
    since = back.tick if back.boot == probe.state.boot else 0
    return (probe.state.tick - since) * TICK_MS / 1e3


@fault_row(63, "", READY_AFTER.at_most(30), NOT_REPORTED.at_most(0))
async def fork_server_lost(rig: Rig) -> Measured:
    """Kill and freeze the fork server while a robot starts: its processes start by themselves."""
    if not forking.works_here():
        raise Skipped("processes are not forked on this system")
    longest_s, not_reported = 0.0, 0
    for fault in (signal.SIGKILL, signal.SIGSTOP):
        await rig.end_robot()
        attack = asyncio.create_task(_break_fork_server(fault))
        deployment = deployment_of(rig.options, "sim")
        async with rig.own_robot(deployment) as robot:
            await attack
            await robot.until_driving()
            longest_s = max(longest_s, robot.ready_s)
            not_reported += all(record.get("event") != "fork server" for record in robot.records)
    return {READY_AFTER: longest_s, NOT_REPORTED: not_reported}


async def _break_fork_server(fault: signal.Signals) -> None:
    """Send a signal to the fork server that this process starts next, once it is there."""
    while True:
        for child in psutil.Process().children():
            with contextlib.suppress(psutil.Error):
                if fork_server.__name__ in child.cmdline():
                    child.send_signal(fault)
                    return
        await asyncio.sleep(0.005)
