"""Checks with a peer that fails: unplugged, frozen, back again; and a driver that is killed."""

import asyncio
import os
import sys
from collections.abc import Callable
from pathlib import Path

from gigabrain_drivers.conformance.result import Failed, Finding
from gigabrain_drivers.conformance.rig import SHARE, Rig, stop_ticks
from gigabrain_drivers.conformance.session import Session
from gigabrain_drivers.conformance.subject import Subject
from gigabrain_schemas.base import Velocity

NOTICED = 12  # ticks until a dead line is known to the gate
BODY_TICKS = 30  # the body's own watchdog: 600 ms
BACK_TICKS = 250
QUIET_TICKS = 15
BODY_S = 0.6
START_S = 20.0  # for a driver in a process of its own, on a busy machine
LOOK_S = 0.005


async def unplugged(rig: Rig) -> Finding:
    """The line is cut at full drive: the gate knows, and the body stops by itself."""
    return await _cut(rig, "unplugged")


async def frozen(rig: Rig) -> Finding:
    """The peer hangs with its line open."""
    return await _cut(rig, "frozen")


async def reconnects(rig: Rig) -> Finding:
    """The line comes back by itself, and nothing from before moves the body."""
    assert rig.subject.peer
    await rig.drive()
    rig.subject.faults("unplugged")
    try:
        if await rig.until(lambda: rig.state and not rig.state.link.connected, NOTICED) is None:
            raise Failed("the loss was not noticed")
        rest = await rig.until(lambda: rig.rests, stop_ticks(rig, 0, BODY_TICKS))
        if rest is None:  # what moves it after this would be old bytes
            raise Failed("the body did not stop by itself")
    finally:
        rig.subject.faults("")
    back = await rig.until(lambda: rig.state and rig.state.link.connected, BACK_TICKS)
    if back is None:
        return Finding(False, f"not back after {BACK_TICKS} ticks")
    moved = await rig.until(lambda: any(rig.subject.told(rig.state)), QUIET_TICKS)
    reconnects = rig.state.link.reconnects if rig.state else 0
    await rig.drive(-1.0)
    await rig.pause()
    old = "nothing moved it" if moved is None else "it moved before anybody enabled it"
    return Finding(
        moved is None and reconnects > 0, f"after {back} ticks, reconnects {reconnects}; {old}"
    )


async def driver_killed(subject: Subject) -> Finding:
    """The driver itself ends by SIGKILL: the body stops by its own watchdog."""
    assert subject.peer
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    child = await asyncio.create_subprocess_exec(
        *(sys.executable, "-P", "-m", __name__, subject.name, str(subject.folder)),
        env=environment,
    )
    loop = asyncio.get_running_loop()
    try:
        await _until(lambda: any(subject.told(None)), START_S, "the driver's process did not drive")
        await asyncio.sleep(0.3)
    finally:
        child.kill()
        await child.wait()
    begin = loop.time()
    await _until(lambda: not any(subject.told(None)), 2.0, "the motors ran on for 2 s")
    took = loop.time() - begin
    return Finding(took <= BODY_S, f"motors told zero after {took * 1e3:.0f} ms")


async def _cut(rig: Rig, fault: str) -> Finding:
    assert rig.subject.peer
    await rig.drive()
    rig.subject.faults(fault)
    try:
        noticed = await rig.until(lambda: "link_lost" in rig.causes, NOTICED)
        rest = await rig.until(lambda: rig.rests, stop_ticks(rig, 0, BODY_TICKS))
        rig.wanted = None
        await rig.go_on(QUIET_TICKS)
    finally:
        rig.subject.faults("")
    thawed = await rig.until(lambda: any(rig.subject.told(rig.state)), QUIET_TICKS)
    if await rig.until(lambda: rig.state and rig.state.link.connected, BACK_TICKS) is None:
        raise Failed(f"not heard again after {BACK_TICKS} ticks")
    told = "never told to the gate" if noticed is None else f"known after {noticed} ticks"
    stood = "still moving" if rest is None else f"at rest after {(noticed or 0) + rest}"
    again = "" if thawed is None else "; then what had piled up moved it"
    return Finding(None not in (noticed, rest) and not again, f"{told}, {stood}{again}")


async def _until(condition: Callable[[], bool], within_s: float, what: str) -> None:
    loop = asyncio.get_running_loop()
    end = loop.time() + within_s
    while not condition():
        if loop.time() > end:
            raise Failed(what)
        await asyncio.sleep(LOOK_S)


async def drive_for_ever(name: str, folder: Path) -> None:
    """In a process of its own: half speed, until somebody kills it."""
    subject = Subject(name, "emulated", folder)
    async with Session(subject) as it:
        await it.connected()
        it.wanted = Velocity(linear_x=SHARE * subject.robot.max_linear_speed)
        while True:
            await it.go_on(50)


if __name__ == "__main__":
    asyncio.run(drive_for_ever(sys.argv[1], Path(sys.argv[2])))
