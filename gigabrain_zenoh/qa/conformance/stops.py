"""Checks behind the gate: the body stops whenever its commander is not to be trusted."""

import asyncio
import contextlib
import logging
import math
import sys
from collections.abc import AsyncIterator, Iterator

import msgspec

from gigabrain_schemas.base import TICK_NS
from gigabrain_zenoh.geometry.limits import ZERO
from gigabrain_zenoh.qa.conformance.result import Failed, Finding
from gigabrain_zenoh.qa.conformance.rig import ATTEMPTS, Rig, stop_ticks

SILENCE = 7  # ticks: 100 ms without a command, told in the next tick
AT_ONCE = 2
TICK_MS = TICK_NS / 1e6
DISORDER_TICKS = 35
LATE_TICKS = 100  # for which a body that still moves is watched, to say how late it is
COMMANDER = "import time\nwhile True:\n print(flush=True)\n time.sleep(0.02)\n"


async def silence(rig: Rig) -> Finding:
    """The commander falls silent at full drive."""
    await rig.drive()
    rig.wanted = None
    return await _stopped(rig, stop_ticks(rig, SILENCE))


async def not_a_number(rig: Rig) -> Finding:
    """The commander sends NaN: zero at once, without a ramp."""
    await rig.drive()
    rig.wanted = None
    last, calls = rig.last, len(rig.tap.calls)
    if last is None:
        raise Failed("nothing was commanded")
    with _unsaid("gigabrain_zenoh.bus.bus"):
        rig.deliver({**msgspec.structs.asdict(last), "linear_x": math.nan, "seq": last.seq + 1})
        told = await rig.until(lambda: rig.tap.calls[calls:], AT_ONCE)
    zero = told is not None and rig.tap.calls[calls].asked == ZERO
    found = await _stopped(rig, stop_ticks(rig, AT_ONCE))
    said = "zero at once" if zero else "not zero at once"
    return Finding(found.ok and zero, f"{said}; {found.measured}")


@contextlib.contextmanager
def _unsaid(name: str) -> Iterator[None]:
    """What the kit does wrong on purpose is not logged by the logger of that name."""
    logger = logging.getLogger(name)
    logger.addFilter(_nothing)
    try:
        yield
    finally:
        logger.removeFilter(_nothing)


def _nothing(_: logging.LogRecord) -> bool:
    return False


async def disorder(rig: Rig) -> Finding:
    """Old, duplicated and reordered commands: none is obeyed, and none counts as being alive."""
    wanted = await rig.drive()
    earlier = rig.last
    await rig.go_on(12)
    rig.wanted, last, calls = None, rig.last, len(rig.tap.calls)
    if earlier is None or last is None:
        raise Failed("nothing was commanded")
    before, end = sum(rig.refused.values()), rig.tick + DISORDER_TICKS
    back = -wanted.linear_x
    replace = msgspec.structs.replace
    at_rest: int | None = None
    begin = rig.tick
    most = stop_ticks(rig, SILENCE)
    while rig.tick < end or (at_rest is None and rig.tick < begin + most + LATE_TICKS):
        rig.deliver(replace(last, linear_x=back))  # a duplicate
        rig.deliver(replace(last, linear_x=back, seq=last.seq - 3))  # overtaken
        rig.deliver(replace(earlier, linear_x=back, seq=last.seq + 100))  # old, though new by count
        rig.deliver(replace(last, linear_x=back, seq=last.seq + 200, tick=rig.tick + 1000))
        if at_rest is None and rig.rests:
            at_rest = rig.tick - begin
        await rig.go_on(1)
    refused = sum(rig.refused.values()) - before
    backward = sum(1 for call in rig.tap.calls[calls:] if call.asked.linear_x * back > 0)
    text = f"{refused} refused, {backward} obeyed; "
    if at_rest is None:
        return Finding(False, text + "never at rest")
    late_ms = 0.0 if backward else max((at_rest - most) * TICK_MS, 0.0)
    good = backward == 0 and at_rest <= most
    return Finding(good, f"{text}at rest after {at_rest} ticks", late_ms=late_ms)


async def killed(rig: Rig) -> Finding:
    """The commander is a process, and ends by SIGKILL."""
    for _ in range(ATTEMPTS):
        await rig.drive()
        async with _commander(rig):
            if await rig.until(lambda: rig.wanted is None, 250) is None:
                raise Failed("the commander's process did not start")
            await rig.go_on(15)
            obeyed = rig.mode == "enabled"
        if obeyed:
            return await _stopped(rig, stop_ticks(rig, SILENCE))
    raise Failed(f"the commander's process was not obeyed; gate {rig.mode}")


@contextlib.asynccontextmanager
async def _commander(rig: Rig) -> AsyncIterator[None]:
    """A process that commands what the rig commanded; killed at the end."""
    commander = await asyncio.create_subprocess_exec(
        sys.executable, "-S", "-c", COMMANDER, stdout=asyncio.subprocess.PIPE
    )
    relay = asyncio.create_task(_relay(rig, commander))
    try:
        yield
    finally:
        commander.kill()
        relay.cancel()
        await asyncio.gather(commander.wait(), relay, return_exceptions=True)


async def _relay(rig: Rig, commander: asyncio.subprocess.Process) -> None:
    """A command for each line of the commander, which takes over from the rig with its first."""
    assert commander.stdout
    velocity = rig.wanted or ZERO
    while await commander.stdout.readline():
        rig.wanted = None
        rig.command(velocity)


async def _stopped(rig: Rig, most: int) -> Finding:
    ticks = await rig.until(lambda: rig.rests, most + LATE_TICKS)
    if ticks is None:
        return Finding(False, f"still moving after {most + LATE_TICKS} ticks of at most {most}")
    text, late_ms = f"at rest after {ticks} ticks of at most {most}", (ticks - most) * TICK_MS
    return Finding(ticks <= most, text, {"at rest": ticks * TICK_MS}, max(late_ms, 0.0))
