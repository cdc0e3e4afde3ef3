"""Runs fault tests, one after the other, those that share a robot together."""

import asyncio
import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.faults.fault import Fault, Measured, Result, Skipped, Test, judge
from gigabrain_zenoh.faults.rig import Options, Rig
from gigabrain_zenoh.faults.waiting import StallWatch
from gigabrain_zenoh.process import find

STALL_S = 0.25  # standing still for longer, this machine and not the robot is to blame
TRIES = 3  # runs that end in such a stall are run again so often
LIMIT_S = 300.0  # for one run of one test in its short form
STAGES = ("sim", "auto", "serial", "tcp", "")

Say = Callable[[Result], None]


def find_test(fault: Fault) -> Test:
    """The function that carries a fault out. Raises Skipped where there is none."""
    try:
        return find(fault.path)  # type: ignore[no-any-return]
    except (ModuleNotFoundError, AttributeError):
        raise Skipped("not written yet") from None


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


async def _repeated(fault: Fault, rig: Rig, stalls: StallWatch, repeat: int) -> Result:
    """All runs of one fault; the first that fails is the last."""
    loop = asyncio.get_running_loop()
    began_s, runs, thrown, longest_s = loop.time(), list[Measured](), 0, 0.0
    reason, skipped = "", False
    for _ in range(repeat):
        for attempt in itertools.count(1):
            stalls.reset()
            try:
                runs.append(await _run(fault, rig))
            except Skipped as error:
                reason, skipped = str(error), True
            except (GigabrainError, TimeoutError) as error:
                reason = str(error) or f"not over after {LIMIT_S:g} s"
                await rig.give_up()
            if not reason or skipped or stalls.longest_s < STALL_S or attempt == TRIES:
                break
            thrown, reason = thrown + 1, ""
        longest_s = max(longest_s, stalls.longest_s)
        if reason:
            break
    verdict, missed, worst = judge(fault, runs) if runs else ("skipped", "", {})
    return Result(
        number=fault.number,
        name=fault.name,
        criterion=fault.criterion,
        verdict="skipped" if skipped else "FAILED" if reason else verdict,
        reason=reason or missed,
        worst=worst,
        runs=len(runs),
        seconds=round(loop.time() - began_s, 1),
        stalls=thrown,
        stall_ms=round(longest_s * 1e3),
    )


async def _run(fault: Fault, rig: Rig) -> Measured:
    test = find_test(fault)
    async with asyncio.timeout(None if rig.long else LIMIT_S):
        measured = await test(rig)
        await rig.check()
    return measured


def failed(results: Sequence[Result]) -> bool:
    """Whether any test has failed."""
    return any(result.verdict == "FAILED" for result in results)
