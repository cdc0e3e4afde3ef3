"""Deaths of the driver, of everybody in any order, and again and again."""

import asyncio
import itertools
import random
import time
from typing import Any

from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.requests import EnableRequest
from gigabrain_schemas.topics import CMD_VEL, ENABLE
from gigabrain_zenoh.errors import Refused
from gigabrain_zenoh.gate.gate import BRAIN
from gigabrain_zenoh.qa.faults.fault import Failed, Measured
from gigabrain_zenoh.qa.faults.forger import forging
from gigabrain_zenoh.qa.faults.rig import Rig, deployment_of
from gigabrain_zenoh.qa.faults.stopping import TICK_MS
from gigabrain_zenoh.qa.faults.subject import Subject
from gigabrain_zenoh.qa.faults.waiting import until
from gigabrain_zenoh.runtime.deployment import client_endpoint
from gigabrain_zenoh.runtime.managed_process import Backoff

VICTIMS = ("router", "driver", "perception", "decision", "control", "safety")
ORDERS = 60  # sampled, in the long form
PROMPT_S = 0.005  # an answer that took longer says too little of now
ROOM_M = 0.8
AFTER_S = 1.0  # of simulated time, for which a body is looked at after a death
OLD_COMMANDS = 25


async def gate_killed(rig: Rig) -> Measured:
    """kill -9 of the gate, which is in the driver's process: it boots latched, as somebody new."""
    subject = await rig.robot("line")
    onlooker, old = subject.onlooker, subject.onlooker.state.boot
    zero_ms, _ = await _without_driver(subject)
    await until(lambda: onlooker.state.boot != old, "the driver's restart")
    await onlooker.ticks(10)
    born = [state for state in onlooker.states if state.boot == onlooker.state.boot]
    still_m = await subject.distance()
    await subject.ready()
    enabled = await _tries_to_enable(subject)
    await subject.release()
    await subject.person.enable(subject.onlooker.bus.process)
    before_s = float((await subject.truth())["motors_moved_s"])
    await _command_of(subject, old)
    truth = await subject.truth()
    return {
        "motors zero after": zero_ms,
        "not latched at start": sum(state.gate.mode != "latched" for state in born[:10]),
        "enabled while latched": enabled,
        "commands of the old boot obeyed": float(truth["motors_moved_s"] > before_s),
        "moved again": float(truth["distance_m"]) - still_m,
    }


async def driver_killed(rig: Rig) -> Measured:
    """kill -9: nobody tells the body to stop, so it does that itself."""
    zero_ms, travel_m = await _without_driver(await rig.robot("line"))
    return {"motors zero after": zero_ms, "travel": travel_m}


async def _without_driver(subject: Subject) -> tuple[float, float]:
    """(until the motors were told zero [ms], travel [m]) after the driver's death.

    The time is the physics', to within one of its steps.
    """
    await subject.drive()
    pid, before = subject.pid("driver"), await _prompt_truth(subject)
    subject.kill("driver")
    after = await subject.simulated(AFTER_S)
    await subject.restarted("driver", pid)
    told_s = float(after["motors_moved_s"]) - float(before["sim_seconds"])
    return told_s * 1e3, float(after["distance_m"]) - float(before["distance_m"])


async def _prompt_truth(subject: Subject) -> dict[str, Any]:
    """The truth as it was a moment ago at most, if this machine lets it be had."""
    for _ in range(50):
        begin_s = time.monotonic()
        truth = await subject.truth()
        if time.monotonic() - begin_s < PROMPT_S:
            break
    return truth


async def _command_of(subject: Subject, boot: int) -> None:
    """Command the body in the name of whoever holds it, as one who knows an old boot only."""
    onlooker = subject.onlooker
    async with forging(client_endpoint(subject.deployment)) as forger:
        for number in range(OLD_COMMANDS):
            command = CmdVel(
                linear_x=0.2,
                source=onlooker.bus.process,
                boot=boot,
                tick=onlooker.state.tick,
                basis=onlooker.state.tick,
                seq=1_000_000 + number,
            )
            forger.send(CMD_VEL, command)
            await onlooker.ticks(1)


async def every_process_and_pair_killed(rig: Rig) -> Measured:
    """kill -9 of each process, of pairs, of all in some order; all of them in the long form."""
    subject = await rig.robot("line")
    trials = [await _trial(subject, victims) for victims in _plan(rig.long)]
    return {name: max(trial[name] for trial in trials) for name in trials[0]}


def _plan(long: bool) -> list[tuple[str, ...]]:
    """Who dies, in which order."""
    chance = random.Random(0)
    orders = [tuple(chance.sample(VICTIMS, len(VICTIMS))) for _ in range(ORDERS)]
    if long:
        singles = [(name,) for name in VICTIMS]
        return [*singles, *itertools.combinations(VICTIMS, 2), *orders]
    first = orders[0]
    return [first[0:2], first[2:4], first[4:6], orders[1]]


async def _trial(subject: Subject, victims: tuple[str, ...]) -> dict[str, float]:
    """One group of deaths while it drives."""
    onlooker = subject.onlooker
    await subject.drive(ROOM_M)
    pids = {name: subject.pid(name) for name in victims}
    begin_s = float((await subject.truth())["sim_seconds"])
    for name in victims:
        subject.kill(name)
    for name, pid in pids.items():
        await subject.restarted(name, pid)
    newest = onlooker.states[-1]
    await until(lambda: onlooker.state is not newest, "states go on")
    await until(lambda: onlooker.state.gate.mode in ("idle", "latched"), "the gate is shut")
    await onlooker.still()
    rest = await subject.truth()
    await onlooker.ticks(50)
    return {
        "idle after": float(rest["sim_seconds"]) - begin_s,
        "moved again": await subject.distance() - float(rest["distance_m"]),
    }


async def crash_loop(rig: Rig) -> Measured:
    """A process that dies at each start is given up after five, and the robot stays shut."""
    await rig.give_up()
    async with rig.new(deployment_of(rig.options, "sim"), backoff=Backoff()) as subject:
        await subject.drive()
        usual = await _cpu_percent()
        births, deaths = await _kill_all_starts(subject, "perception")
        await subject.onlooker.still()
        enabled = await _tries_to_enable(subject)
        unusual = await _cpu_percent()
        started_again = subject.supervisor.statuses["perception"].pid is not None
    waits = [birth - death for birth, death in zip(births[1:], deaths, strict=False)]
    short = [0.2 * 2**n - wait for n, wait in enumerate(waits)]
    return {
        "starts": len(births) + started_again,
        "wait too short": max(0.0, *short),
        "enabled without it": enabled,
        "cpu added": max(0.0, unusual - usual),
    }


async def _cpu_percent() -> float:
    """What this process, the supervisor in it and its onlooker, uses of a core [%]."""
    began_s, cpu_s = time.monotonic(), time.process_time()
    await asyncio.sleep(AFTER_S)
    return 100 * (time.process_time() - cpu_s) / (time.monotonic() - began_s)


async def _kill_all_starts(subject: Subject, name: str) -> tuple[list[float], list[float]]:
    """When it was started and when it died [s], until it was given up."""
    status, births, deaths, seen = subject.supervisor.statuses[name], [], [], 0
    while status.state != "given up":
        if status.pid and status.pid != seen:
            seen = status.pid
            births.append(time.monotonic())
            subject.kill(name)
            deaths.append(time.monotonic())
        if len(births) > 20:
            raise Failed(f"{name} is started for ever")
        await asyncio.sleep(0.005)
    return births, deaths


async def _tries_to_enable(subject: Subject) -> int:
    """How often the brain could be enabled."""
    enabled = 0
    for _ in range(5):
        try:
            replies = await subject.onlooker.bus.ask(ENABLE, EnableRequest(source=BRAIN))
        except Refused:
            continue
        enabled += any(reply.ok for reply in replies)
        await subject.onlooker.ticks(5)
    return enabled


async def automatic_recovery(rig: Rig) -> Measured:
    """With `resume: auto` it drives again after any death, but never out of a latch."""
    subject = await rig.robot("auto")
    onlooker, longest = subject.onlooker, 0.0
    for victim in VICTIMS:
        longest = max(longest, await _recovery_s(subject, victim))
    await subject.drive(ROOM_M)
    await subject.person.estop("fault suite")
    await onlooker.ticks(100)
    passed = onlooker.state.gate.mode != "latched"
    truth = await onlooker.truth()
    return {
        "drives again after": longest,
        "stale executed": float(truth["stale_commands_executed"]),
        "latches passed over": float(passed),
    }


async def _recovery_s(subject: Subject, victim: str) -> float:
    """From the victim's return until the brain drives again [s] of the robot's time."""
    onlooker = subject.onlooker
    await subject.drive(ROOM_M)
    pid, start = subject.pid(victim), onlooker.state
    subject.kill(victim)
    await subject.restarted(victim, pid)
    back = onlooker.state

    def goes_on() -> bool:
        now = onlooker.state
        again = now.boot != start.boot or now.gate.enables > start.gate.enables
        return again and now.gate.mode == "enabled"

    await until(goes_on, "it goes on")
    since = back.tick if back.boot == onlooker.state.boot else 0
    return (onlooker.state.tick - since) * TICK_MS / 1e3
