"""Checks with a peer that fails: unplugged, frozen, back again; and a driver that is killed."""

import asyncio
import logging
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_zenoh.qa.conformance.result import Failed, Finding
from gigabrain_zenoh.qa.conformance.rig import SHARE, Rig, stop_ticks
from gigabrain_zenoh.qa.conformance.session import Session
from gigabrain_zenoh.qa.conformance.stops import LATE_TICKS
from gigabrain_zenoh.qa.conformance.subject import Subject

PULLED_MS = 100.0  # until the gate knows that the line is cut
FROZEN_MS = 250.0  # until it knows that the peer hangs
SLACK_MS = 100.0  # on top of these, for a machine that others use as well
NOTICED = 12  # ticks, for the gate to know, where it is not what is judged
BACK_TICKS = 250
QUIET_TICKS = 15
START_S = 20.0  # for a driver in a process of its own, on a busy machine
LOOK_S = 0.005
KNOWN, TOLD, RESTS = "known", "motors told zero", "at rest"  # from the fault on


async def unplugged(rig: Rig) -> Finding:
    """The line is cut at full drive: the gate knows, and the body stops by itself."""
    return await _cut(rig, "unplugged", PULLED_MS)


async def frozen(rig: Rig) -> Finding:
    """The peer hangs with its line open."""
    return await _cut(rig, "frozen", FROZEN_MS)


async def reconnects(rig: Rig) -> Finding:
    """The line comes back by itself, and nothing from before moves the body."""
    await rig.drive()
    rig.subject.faults("unplugged")
    try:
        if await rig.until(lambda: "link_lost" in rig.causes, NOTICED) is None:
            raise Failed("the loss was not noticed")
        # before it stands: what moves it afterwards would be old bytes
        if await rig.until(lambda: rig.rests, _rest_ticks(rig)) is None:
            raise Failed("the body did not stop by itself")
    finally:
        rig.subject.faults("")
    back = await rig.until(lambda: rig.state and rig.state.link.connected, BACK_TICKS)
    if back is None:
        return Finding(False, f"not back after {BACK_TICKS} ticks")
    moved = await rig.until(lambda: any(rig.subject.told(rig.state)), QUIET_TICKS)
    reconnects = rig.state.link.reconnects if rig.state else 0
    await rig.drive()
    await rig.pause()
    old = "nothing moved it" if moved is None else "it moved before anybody enabled it"
    return Finding(
        moved is None and reconnects > 0, f"after {back} ticks, reconnects {reconnects}; {old}"
    )


async def driver_killed(subject: Subject) -> Finding:
    """The driver itself ends by SIGKILL: the body stops by its own watchdog."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", __name__),
        *(subject.name, str(subject.folder), str(subject.way())),
        env=environment,
    )
    loop = asyncio.get_running_loop()
    try:
        await _until(lambda: any(subject.told(None)), START_S, "the driver's process did not drive")
        await asyncio.sleep(0.3)
        begin = loop.time()
    finally:
        child.kill()
        await child.wait()
    await _until(lambda: not any(subject.told(None)), 2.0, "the motors ran on for 2 s")
    took = (loop.time() - begin) * 1e3
    late = took - subject.promised_ms - SLACK_MS
    told = f"motors told zero after {took:.0f} ms"
    return Finding(late <= 0, told, {"motors told zero": took}, max(late, 0.0))


def _rest_ticks(rig: Rig) -> int:
    """The most ticks until a body that is left to itself stands."""
    return stop_ticks(rig, round((rig.subject.promised_ms + SLACK_MS) * 1e6 / TICK_NS))


async def _cut(rig: Rig, fault: str, known_ms: float) -> Finding:
    await rig.drive()
    rig.subject.faults(fault)
    try:
        times = await rig.firsts(
            {
                KNOWN: lambda: "link_lost" in rig.causes,
                TOLD: lambda: not any(rig.subject.told(rig.state)),
                RESTS: lambda: rig.rests,
            },
            _rest_ticks(rig) + LATE_TICKS,
        )
        rig.wanted = None
        await rig.go_on(QUIET_TICKS)
    finally:
        rig.subject.faults("")
    thawed = await rig.until(lambda: any(rig.subject.told(rig.state)), QUIET_TICKS)
    if await rig.until(lambda: rig.state and rig.state.link.connected, BACK_TICKS) is None:
        raise Failed(f"not heard again after {BACK_TICKS} ticks")
    limits = {
        KNOWN: known_ms + SLACK_MS,
        TOLD: rig.subject.promised_ms + SLACK_MS,
        RESTS: _rest_ticks(rig) * TICK_NS / 1e6,
    }
    late = max(times.get(name, math.inf) - most for name, most in limits.items())
    told = [f"{n} after {times[n]:.0f} ms" if n in times else f"never {n}" for n in limits]
    again = "; then what had piled up moved it" if thawed is not None else ""
    missed = late if math.isfinite(late) and not again else 0.0
    return Finding(late <= 0 and not again, ", ".join(told) + again, times, max(missed, 0.0))


async def _until(condition: Callable[[], bool], within_s: float, what: str) -> None:
    loop = asyncio.get_running_loop()
    end = loop.time() + within_s
    while not condition():
        if loop.time() > end:
            raise Failed(what)
        await asyncio.sleep(LOOK_S)


async def drive_for_ever(name: str, folder: Path, way: int) -> None:
    """In a process of its own: half speed, until somebody kills it."""
    subject = Subject(name, "emulated", folder)
    async with Session(subject) as it:
        await it.connected()
        it.wanted = Velocity(linear_x=way * SHARE * subject.robot.max_linear_speed)
        while True:
            await it.go_on(50)


if __name__ == "__main__":
    logging.getLogger().addHandler(logging.NullHandler())  # what it warns of is the kit's doing
    asyncio.run(drive_for_ever(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])))
