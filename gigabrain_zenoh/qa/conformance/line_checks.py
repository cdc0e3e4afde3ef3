"""Checks with a peer that fails: unplugged, frozen, back again; and a driver that is killed."""

import asyncio
import logging
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path

from gigabrain_schemas.base import TICK_NS, Velocity
from gigabrain_zenoh.qa.conformance.gate_checks import LATE_TICKS
from gigabrain_zenoh.qa.conformance.gated_driver import SHARE, GatedDriver, stop_ticks
from gigabrain_zenoh.qa.conformance.robot import CheckedRobot, DriverSession
from gigabrain_zenoh.qa.judging import Failed, Finding

PULLED_MS = 100.0  # until the gate knows that the line is cut
FROZEN_MS = 250.0  # until it knows that the peer hangs
SLACK_MS = 100.0  # on top of these, for a machine that others use as well
NOTICED = 12  # ticks, for the gate to know, where it is not what is judged
BACK_TICKS = 250
QUIET_TICKS = 15
START_S = 20.0  # for a driver in a process of its own, on a busy machine
LOOK_S = 0.005
KNOWN, TOLD, RESTS = "known", "motors told zero", "at rest"  # from the fault on


async def unplugged(gated: GatedDriver) -> Finding:
    """The line is cut at full drive: the gate knows, and the body stops by itself."""
    return await _cut(gated, "unplugged", PULLED_MS)


async def frozen(gated: GatedDriver) -> Finding:
    """The peer hangs with its line open."""
    return await _cut(gated, "frozen", FROZEN_MS)


async def reconnects(gated: GatedDriver) -> Finding:
    """The line comes back by itself, and nothing from before moves the body."""
    await gated.drive()
    gated.checked.break_peer("unplugged")
    try:
        if await gated.until(lambda: "link_lost" in gated.causes, NOTICED) is None:
            raise Failed("the loss was not noticed")
        # before it stands: what moves it afterwards would be old bytes
        if await gated.until(lambda: gated.rests, _rest_ticks(gated)) is None:
            raise Failed("the body did not stop by itself")
    finally:
        gated.checked.break_peer("")
    back = await gated.until(lambda: gated.state and gated.state.link.connected, BACK_TICKS)
    if back is None:
        return Finding(False, f"not back after {BACK_TICKS} ticks")
    moved = await gated.until(lambda: any(gated.checked.commanded(gated.state)), QUIET_TICKS)
    reconnects = gated.state.link.reconnects if gated.state else 0
    await gated.drive()
    await gated.pause()
    old = "nothing moved it" if moved is None else "it moved before anybody enabled it"
    return Finding(
        moved is None and reconnects > 0, f"after {back} ticks, reconnects {reconnects}; {old}"
    )


async def driver_killed(robot: CheckedRobot) -> Finding:
    """The driver itself ends by SIGKILL: the body stops by its own watchdog."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", __name__),
        *(robot.name, str(robot.folder), str(robot.next_direction())),
        env=environment,
    )
    loop = asyncio.get_running_loop()
    try:
        await _until(lambda: any(robot.commanded(None)), START_S, "the driver did not drive")
        await asyncio.sleep(0.3)
        begin = loop.time()
    finally:
        child.kill()
        await child.wait()
    await _until(lambda: not any(robot.commanded(None)), 2.0, "the motors ran on for 2 s")
    took = (loop.time() - begin) * 1e3
    late = took - robot.promised_ms - SLACK_MS
    told = f"motors told zero after {took:.0f} ms"
    return Finding(late <= 0, told, {"motors told zero": took}, max(late, 0.0))


def _rest_ticks(gated: GatedDriver) -> int:
    """The most ticks until a body that is left to itself stands."""
    return stop_ticks(gated, round((gated.checked.promised_ms + SLACK_MS) * 1e6 / TICK_NS))


async def _cut(gated: GatedDriver, fault: str, known_ms: float) -> Finding:
    await gated.drive()
    gated.checked.break_peer(fault)
    try:
        times = await gated.firsts(
            {
                KNOWN: lambda: "link_lost" in gated.causes,
                TOLD: lambda: not any(gated.checked.commanded(gated.state)),
                RESTS: lambda: gated.rests,
            },
            _rest_ticks(gated) + LATE_TICKS,
        )
        gated.wanted = None
        await gated.run_for(QUIET_TICKS)
    finally:
        gated.checked.break_peer("")
    thawed = await gated.until(lambda: any(gated.checked.commanded(gated.state)), QUIET_TICKS)
    if await gated.until(lambda: gated.state and gated.state.link.connected, BACK_TICKS) is None:
        raise Failed(f"not heard again after {BACK_TICKS} ticks")
    limits = {
        KNOWN: known_ms + SLACK_MS,
        TOLD: gated.checked.promised_ms + SLACK_MS,
        RESTS: _rest_ticks(gated) * TICK_NS / 1e6,
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
    robot = CheckedRobot(name, "emulated", folder)
    async with DriverSession(robot) as it:
        await it.connected()
        it.wanted = Velocity(linear_x=way * SHARE * robot.file.max_linear_speed)
        while True:
            await it.run_for(50)


if __name__ == "__main__":
    logging.getLogger().addHandler(logging.NullHandler())  # what it warns of is the kit's doing
    asyncio.run(drive_for_ever(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3])))
