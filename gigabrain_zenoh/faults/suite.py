"""Runs fault tests, one after the other, those that share a robot together."""

import asyncio
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.faults.fault import (
    Fault,
    Measured,
    Result,
    Skipped,
    Stage,
    Test,
    Verdict,
    judge,
)
from gigabrain_zenoh.faults.rig import Options, Rig
from gigabrain_zenoh.faults.waiting import StallWatch
from gigabrain_zenoh.process import find

STALL_S = 0.03  # held up for longer, this machine and not the robot is to blame for a failure
TRIES = 3  # runs that end in such a stall are run again so often
LIMIT_S = 300.0  # for one run of one test in its short form
STAGES = get_args(Stage)

Say = Callable[[Result], None]


async def run_suite(
    faults: Iterable[Fault],
    options: Options,
    folder: Path,
    repeat: int = 1,
    begun: Callable[[Fault], None] = lambda fault: None,
    ended: Say = lambda result: None,
) -> list[Result]:
    """Every fault `repeat` times; the results in the table's order."""
    ordered = sorted(faults, key=lambda fault: (STAGES.index(fault.stage), fault.number))
    stalls = StallWatch()
    stalls.start()
    results = []
    try:
        async with Rig(options, folder) as rig:
            for fault in ordered:
                begun(fault)
                results.append(await _repeated(fault, rig, stalls, repeat))
                ended(results[-1])
    finally:
        stalls.close()
    return sorted(results, key=lambda result: result.number)


@dataclass
class Run:
    """What came of one run, after all that were thrown away."""

    measured: Measured | None = None
    verdict: Verdict = "passed"
    reason: str = ""
    stall_s: float = 0.0
    thrown: int = 0


async def _repeated(fault: Fault, rig: Rig, stalls: StallWatch, repeat: int) -> Result:
    """All runs of one fault; the first that does not pass is the last."""
    loop, runs = asyncio.get_running_loop(), list[Run]()
    began_s = loop.time()
    while len(runs) < repeat and (not runs or runs[-1].verdict == "passed"):
        runs.append(await _patiently(fault, rig, stalls))
    measured = [run.measured for run in runs if run.measured is not None]
    return Result(
        number=fault.number,
        name=fault.name,
        criterion=fault.criterion,
        verdict=runs[-1].verdict,
        reason=runs[-1].reason,
        worst=judge(fault, measured)[2] if measured else {},
        runs=len(measured),
        seconds=round(loop.time() - began_s, 1),
        stalls=sum(run.thrown for run in runs),
        stall_ms=round(max(run.stall_s for run in runs) * 1e3),
    )


async def _patiently(fault: Fault, rig: Rig, stalls: StallWatch) -> Run:
    """One run that passed, or was skipped, or failed although this machine did not stand still."""
    for thrown in range(TRIES):
        stalls.reset()
        run = await _judged(fault, rig)
        run.stall_s, run.thrown = max(run.stall_s, await stalls.longest_s()), thrown
        if run.verdict != "FAILED" or run.stall_s < STALL_S:
            break
    return run


async def _judged(fault: Fault, rig: Rig) -> Run:
    """One run. The robot of one that failed is used no more."""
    try:
        measured = await _run(fault, rig)
    except Skipped as error:
        return Run(verdict="skipped", reason=str(error))
    except (GigabrainError, TimeoutError) as error:
        late_s = rig.late_s
        await rig.give_up()
        text = str(error) or f"not over after {LIMIT_S:g} s"
        return Run(verdict="FAILED", reason=text, stall_s=late_s)
    verdict, reason, _ = judge(fault, [measured])
    return Run(measured, verdict, reason, rig.late_s)


async def _run(fault: Fault, rig: Rig) -> Measured:
    test: Test = find(fault.path)
    async with asyncio.timeout(None if rig.long else LIMIT_S):
        measured = await test(rig)
        await rig.check()
    return measured


def failed(results: Sequence[Result]) -> bool:
    """Whether any test has failed."""
    return any(result.verdict == "FAILED" for result in results)
