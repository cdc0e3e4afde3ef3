"""Runs fault tests, one after the other, those that share a robot together."""

import asyncio
import contextlib
import gc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import get_args

import msgspec

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.plugins import find
from gigabrain_zenoh.qa.faults.disturbance import DISTURBED_MS, RunQueueWatch
from gigabrain_zenoh.qa.faults.fault import (
    Fault,
    Measured,
    Result,
    Skipped,
    Stage,
    Test,
    Try,
    conclude,
    judge,
)
from gigabrain_zenoh.qa.faults.rig import Options, Rig

PATIENCE = 3  # disturbed runs at most, passed or failed, beside each that counts
LIMIT_S = 300.0  # for one run of one test in its short form
STAGES = get_args(Stage)

Begun = Callable[[Fault], None]
Ended = Callable[[Fault, Try], None]
Earlier = Mapping[int, Sequence[Try]]


async def run_suite(
    faults: Iterable[Fault],
    options: Options,
    folder: Path,
    repeat: int = 1,
    begun: Begun = lambda fault: None,
    ended: Ended = lambda fault, one: None,
    earlier: Earlier = MappingProxyType({}),
) -> list[Result]:
    """Run every fault until `repeat` runs of it count; the results in the table's order.

    `earlier` are runs of before, by the fault's number: they count like those of now.
    """
    ordered = sorted(faults, key=lambda fault: (STAGES.index(fault.stage), fault.number))
    results = []
    async with Rig(options, folder) as rig:
        for fault in ordered:
            begun(fault)
            before = earlier.get(fault.number, ())
            results.append(conclude(fault, await _tries(fault, rig, repeat, ended, before)))
    return sorted(results, key=lambda result: result.number)


async def _tries(
    fault: Fault, rig: Rig, repeat: int, ended: Ended, before: Sequence[Try]
) -> list[Try]:
    """Run one fault; a run that was disturbed is followed by another, whatever came of it.

    A long form counts in any case: in an hour some thread always waits for a core for a while.
    """
    tries, disturbed = list(before), sum(one.disturbed for one in before)
    while len(tries) - disturbed < repeat and disturbed < PATIENCE * repeat:
        tries.append(await _try(fault, rig))
        ended(fault, tries[-1])
        disturbed += tries[-1].disturbed
        if tries[-1].verdict == "skipped":
            break
    return tries


async def _try(fault: Fault, rig: Rig) -> Try:
    loop, watch = asyncio.get_running_loop(), RunQueueWatch(lambda: ("self", *rig.pids()))
    watch.start()
    began_s = loop.time()
    try:
        with uncollected():
            judged = await _judged(fault, rig)
    finally:
        watch.close()
    return msgspec.structs.replace(
        judged,
        waited_ms=round(watch.longest_ms, 1),
        disturbed=watch.longest_ms >= DISTURBED_MS and not (fault.loads or rig.long),
        seconds=round(loop.time() - began_s, 1),
    )


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Collect garbage before the block, and none in it.

    The suite is the network and the people of its robots. One collection of all that it remembers
    took 35 ms and more, and what it held up was taken for a fault of the robot.
    """
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


async def _judged(fault: Fault, rig: Rig) -> Try:
    """One run. The robot of one that failed is used no more."""
    try:
        measured = await _run(fault, rig)
    except Skipped as error:
        return Try(verdict="skipped", reason=str(error))
    except (GigabrainError, TimeoutError) as error:
        await rig.give_up()
        return Try(verdict="FAILED", reason=str(error) or f"not over after {LIMIT_S:g} s")
    verdict, reason = judge(fault, measured, wall=rig.options.wall, long=rig.long)
    return Try(verdict=verdict, reason=reason, measured=dict(measured))


async def _run(fault: Fault, rig: Rig) -> Measured:
    test: Test = find(fault.path)
    async with asyncio.timeout(None if rig.long else LIMIT_S):
        measured = await test(rig)
        await rig.check()
    return measured


def failed(results: Sequence[Result]) -> bool:
    """Whether any test has failed."""
    return any(result.verdict == "FAILED" for result in results)
