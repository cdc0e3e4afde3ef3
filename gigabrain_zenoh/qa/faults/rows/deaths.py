"""Deaths of the driver, of all processes in any order, and deaths at each start."""

import asyncio
import itertools
import random
import time
from typing import Any

from gigabrain_schemas.topics import CMD_VEL
from gigabrain_zenoh.qa.faults.fault import FaultRow
from gigabrain_zenoh.qa.faults.rig.bad_network import forged_command, forging
from gigabrain_zenoh.qa.faults.rig.rig import (
    MOVED_AGAIN,
    NONE_STALE,
    RESTED_TICKS,
    STALE,
    STAYS_STILL,
    TRAVEL,
    Rig,
    deployment_of,
)
from gigabrain_zenoh.qa.judging import Failed, Figure, Measured, worse_of
from gigabrain_zenoh.qa.probe import TICK_MS, until
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.runtime.deployment import client_endpoint
from gigabrain_zenoh.runtime.managed_process import Backoff

VICTIMS = ("router", "driver", "perception", "decision", "control", "safety")
ORDERS = 60  # sampled, in the long form
PROMPT_S = 0.005  # an older answer is too old to count from
ROOM_M = 0.8
AFTER_S = 1.0  # of simulated time, for which a body is observed after a death
OLD_COMMANDS = 25
MAX_STARTS = 20

MOTORS_ZERO = Figure("motors zero after", "ms")
NOT_LATCHED = Figure("not latched at start")
ENABLED_LATCHED = Figure("enabled while latched")
OLD_OBEYED = Figure("commands of the old boot obeyed")
STARTS = Figure("starts")
WAIT_TOO_SHORT = Figure("wait too short", "s")
ENABLED_WITHOUT = Figure("enabled without it")
CPU_ADDED = Figure("cpu added", "%")
IDLE = Figure("idle after", "s")
DRIVES_AGAIN = Figure("drives again after", "s")
LATCH_IGNORED = Figure("latches ignored")


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
    enabled = await probe.tries_to_enable()
    await robot.release()
    await robot.person.enable(probe.bus.process)
    before_s = float((await robot.truth())["motors_moved_s"])
    async with forging(client_endpoint(robot.deployment)) as forger:
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


async def driver_killed(rig: Rig) -> Measured:
    """Kill the driver: the body must stop by its own watchdog."""
    zero_ms, travel_m = await _without_driver(await rig.robot("line"))
    return {MOTORS_ZERO: zero_ms, TRAVEL: travel_m}


async def _without_driver(robot: RobotUnderTest) -> tuple[float, float]:
    """Return the time until the motors are commanded zero [ms], and the travel after that [m].

    The time is the physics' own, to within one of its steps.
    """
    await robot.drive()
    pid, before = robot.pid("driver"), await _prompt_truth(robot)
    robot.kill("driver")
    after = await robot.after_simulated(AFTER_S)
    await robot.restarted("driver", pid)
    zero_s = float(after["motors_moved_s"]) - float(before["sim_seconds"])
    return zero_s * 1e3, float(after["distance_m"]) - float(before["distance_m"])


async def _prompt_truth(robot: RobotUnderTest) -> dict[str, Any]:
    """Return a truth that is at most 5 ms old, if the machine allows."""
    for _ in range(50):
        begin_s = time.monotonic()
        truth = await robot.truth()
        if time.monotonic() - begin_s < PROMPT_S:
            break
    return truth


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
    await robot.drive(ROOM_M)
    pids = {name: robot.pid(name) for name in victims}
    begin_s = float((await robot.truth())["sim_seconds"])
    for name in victims:
        robot.kill(name)
    for name, pid in pids.items():
        await robot.restarted(name, pid)
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


async def crash_loop(rig: Rig) -> Measured:
    """Kill a process at each start: it is given up after five, and the gate stays shut."""
    await rig.give_up()
    async with rig.new(deployment_of(rig.options, "sim"), backoff=Backoff()) as robot:
        await robot.drive()
        usual = await _cpu_percent()
        births, deaths = await _kill_all_starts(robot, "perception")
        await robot.probe.at_rest()
        enabled = await robot.probe.tries_to_enable()
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


async def automatic_recovery(rig: Rig) -> Measured:
    """With `resume: auto` the robot drives again after any death, but never out of a latch."""
    robot = await rig.robot("auto")
    longest = 0.0
    for victim in VICTIMS:
        longest = max(longest, await _recovery_s(robot, victim))
    await robot.drive(ROOM_M)
    await robot.person.estop("fault suite")
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
    await robot.drive(ROOM_M)
    pid, start = robot.pid(victim), probe.state
    robot.kill(victim)
    await robot.restarted(victim, pid)
    back = probe.state

    def drives_on() -> bool:
        now = probe.state
        again = now.boot != start.boot or now.gate.enables > start.gate.enables
        return again and now.gate.mode == "enabled"

    await until(drives_on, "it drives on")
    since = back.tick if back.boot == probe.state.boot else 0
    return (probe.state.tick - since) * TICK_MS / 1e3


ROWS = (
    FaultRow(
        7, gate_killed, "line",
        (
            MOTORS_ZERO.at_most(150), NOT_LATCHED.at_most(0), ENABLED_LATCHED.at_most(0),
            OLD_OBEYED.at_most(0), STAYS_STILL,
        ),
    ),
    FaultRow(8, driver_killed, "line", (MOTORS_ZERO.at_most(150), TRAVEL.at_most(0.1))),
    FaultRow(
        10, crash_loop, "",
        (
            STARTS.at_most(5), WAIT_TOO_SHORT.at_most(0), ENABLED_WITHOUT.at_most(0),
            CPU_ADDED.at_most(5),
        ),
    ),
    FaultRow(11, every_process_and_pair_killed, "line", (IDLE.at_most(10), STAYS_STILL)),
    FaultRow(
        45, automatic_recovery, "auto",
        (DRIVES_AGAIN.at_most(3), NONE_STALE, LATCH_IGNORED.at_most(0)),
    ),
)  # fmt: skip
