"""The kit: all checks in order, on one robot and one link."""

import asyncio
import contextlib
import functools
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import NamedTuple

from gigabrain_drivers.conformance import direct, line_faults, stops, timing
from gigabrain_drivers.conformance.result import Failed, Finding, NotApplicable, Result
from gigabrain_drivers.conformance.rig import Rig
from gigabrain_drivers.conformance.subject import Subject
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.settings import LinkName

LONGEST_S = 60.0  # of one check


class Check(NamedTuple):
    """A driver by itself, before an open peer or a cut line."""

    name: str
    criterion: str
    run: Callable[[Subject], Awaitable[Finding]]
    with_peer: bool = False


class GateCheck(NamedTuple):
    """A driver in its process, behind the gate."""

    name: str
    criterion: str
    run: Callable[[Rig], Awaitable[Finding]]
    with_peer: bool = False


ALONE = (
    Check("opens", "heard within 5 s", direct.opens),
    Check("obeys", "measured speed within 10 % + 0.02", direct.obeys),
    Check("obeys within limits", "asked 10 times too fast: at most its max speeds", direct.limits),
    Check(
        "returns what it sent",
        "as the body was told, to 0.02; without a peer, as it moves",
        direct.returns,
    ),
    Check("refuses NaN itself", "all zero, nothing raised", direct.refuses_nan),
    Check("never raises", "stop and close, in any state, within 2 s", direct.never_raises),
    Check(
        "stops when it is killed",
        "the body's own watchdog, within 600 ms",
        line_faults.driver_killed,
        with_peer=True,
    ),
)
GATED = (
    GateCheck("reports at its rate", "9 of 10 ticks, 100 ms old; scans to 25 %", timing.reports),
    GateCheck("stops on silence", "7 ticks, its ramp, 15 of the body (legs: 30)", stops.silence),
    GateCheck("stops on NaN", "zero in 2 ticks, 15 of the body (legs: 30)", stops.not_a_number),
    GateCheck("stops on disorder", "nothing obeyed; as on silence", stops.disorder),
    GateCheck("stops on SIGKILL", "of the commander; as on silence", stops.killed),
    GateCheck(
        "stops unplugged",
        "known in 12 ticks, at rest 600 ms after its ramp",
        line_faults.unplugged,
        with_peer=True,
    ),
    GateCheck(
        "stops on a frozen peer",
        "known in 12 ticks, at rest 600 ms after its ramp",
        line_faults.frozen,
        with_peer=True,
    ),
    GateCheck(
        "reconnects",
        "by itself in 5 s; still until enabled, then drives",
        line_faults.reconnects,
        with_peer=True,
    ),
    GateCheck("command to byte", "p50 at most 1 ms", timing.latency),
)


async def run(subject: Subject, on_result: Callable[[Result], None]) -> list[Result]:
    """All checks on an entered subject; `on_result` is called with each as it is known."""
    results: list[Result] = []

    def told(result: Result) -> None:
        results.append(result)
        on_result(result)

    for alone in ALONE:
        told(await _judged(alone, subject, functools.partial(alone.run, subject)))
    async with contextlib.AsyncExitStack() as stack:
        rig = await stack.enter_async_context(Rig(subject))
        for gated in GATED:
            result = await _judged(gated, subject, functools.partial(gated.run, rig))
            told(result)
            if result.verdict == "fail":  # it may have broken more than itself
                await stack.aclose()
                rig = await stack.enter_async_context(Rig(subject))
    return results


async def _judged(
    check: Check | GateCheck, subject: Subject, call: Callable[[], Awaitable[Finding]]
) -> Result:
    """The check's result. What a driver raises is a finding too, and not the end of the kit."""
    if check.with_peer and not subject.has_peer:
        text = f"link {subject.link} has no peer that could fail"
        return Result(check.name, check.criterion, text, "n/a")
    try:
        async with asyncio.timeout(LONGEST_S):
            finding = await call()
    except NotApplicable as error:
        return Result(check.name, check.criterion, str(error), "n/a")
    except TimeoutError:
        return Result(check.name, check.criterion, f"took over {LONGEST_S:.0f} s", "fail")
    except (Failed, GigabrainError) as error:
        return Result(check.name, check.criterion, str(error), "fail")
    except Exception as error:  # noqa: BLE001 - a stranger's driver; its error is the finding
        return Result(check.name, check.criterion, repr(error), "fail")
    return Result(check.name, check.criterion, finding.measured, "pass" if finding.ok else "fail")


async def check(
    name: str, link: LinkName, folder: Path, on_result: Callable[[Result], None]
) -> list[Result]:
    """All checks on the robot called `name`. Raises ConfigError when it cannot be had."""
    async with Subject(name, link, folder) as subject:
        return await run(subject, on_result)
