"""The kit: all checks in order, on one robot and one link."""

import asyncio
import contextlib
import functools
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import NamedTuple, Self

from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.conformance import direct, line_faults, stops, timing
from gigabrain_zenoh.qa.conformance.result import Failed, Finding, NotApplicable, Result, summary
from gigabrain_zenoh.qa.conformance.rig import Rig
from gigabrain_zenoh.qa.conformance.subject import Subject

LONGEST_S = 60.0  # of one check
ATTEMPTS = 3  # of one that this machine may have made late
STARVED = 0.1  # of a check's time, waited for a core, from which on nobody can tell why it failed


class Check(NamedTuple):
    """A driver by itself, before an open peer or a cut line."""

    name: str
    criterion: str
    run: Callable[[Subject], Awaitable[Finding]]
    with_peer: bool = False
    repeated: bool = False  # once more for each repetition that is asked for


class GateCheck(NamedTuple):
    """A driver in its process, behind the gate."""

    name: str
    criterion: str
    run: Callable[[Rig], Awaitable[Finding]]
    with_peer: bool = False
    repeated: bool = False


CUT = "zero {promise}; both + 100; at rest 15 ticks (legs: 30) later"
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
        "motors told zero {promise} + 100",
        line_faults.driver_killed,
        with_peer=True,
        repeated=True,
    ),
)
GATED = (
    GateCheck("reports at its rate", "9 of 10 ticks, 100 ms old; scans to 25 %", timing.reports),
    GateCheck(
        "stops on silence",
        "7 ticks, its ramp, 15 of the body (legs: 30)",
        stops.silence,
        repeated=True,
    ),
    GateCheck("stops on NaN", "zero in 2 ticks, 15 of the body (legs: 30)", stops.not_a_number),
    GateCheck("stops on disorder", "nothing obeyed; as on silence", stops.disorder),
    GateCheck("stops on SIGKILL", "of the commander; as on silence", stops.killed, repeated=True),
    GateCheck(
        "stops unplugged",
        f"known in 100 ms, motors told {CUT}",
        line_faults.unplugged,
        with_peer=True,
        repeated=True,
    ),
    GateCheck(
        "stops on a frozen peer",
        f"known in 250 ms, motors told {CUT}",
        line_faults.frozen,
        with_peer=True,
        repeated=True,
    ),
    GateCheck(
        "reconnects",
        "by itself in 5 s; still until enabled, then drives",
        line_faults.reconnects,
        with_peer=True,
    ),
    GateCheck("command to byte", "p50 at most 1 ms", timing.latency),
)


async def run(subject: Subject, progress: Callable[[str], None], repeat: int = 1) -> list[Result]:
    """All checks on an entered subject, in order, and its stops `repeat` times.

    `progress` is called with what is being checked.
    """
    results: list[Result] = []
    call: Callable[[], Awaitable[Finding]]
    for alone in ALONE:
        call = functools.partial(alone.run, subject)
        results.append(await _judged(alone, subject, call, progress, repeat))
    async with Shared(subject) as shared:
        for gated in GATED:
            call = functools.partial(shared.run, gated.run)
            results.append(await _judged(gated, subject, call, progress, repeat))
    return results


class Shared:
    """One rig for all checks, but a new one after each that failed: it may have broken it."""

    def __init__(self, subject: Subject) -> None:
        self._subject, self._stack = subject, contextlib.AsyncExitStack()
        self._rig: Rig | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def run(self, check: Callable[[Rig], Awaitable[Finding]]) -> Finding:
        """What the check finds on the rig."""
        rig, self._rig = self._rig, None
        if rig is None:
            await self._stack.aclose()
            rig = await self._stack.enter_async_context(Rig(self._subject))
        finding = await check(rig)
        self._rig = rig if finding.ok else None
        return finding


async def _judged(
    check: Check | GateCheck,
    subject: Subject,
    call: Callable[[], Awaitable[Finding]],
    progress: Callable[[str], None],
    repeat: int,
) -> Result:
    criterion = check.criterion.format(promise=subject.promise)
    if check.with_peer and not subject.has_peer:
        text = f"link {subject.link} has no peer that could fail"
        return Result(check.name, criterion, text, "n/a")
    times, findings = repeat if check.repeated else 1, list[Finding]()
    try:
        for count in range(1, times + 1):
            progress(f"{check.name}, {count} of {times}" if times > 1 else check.name)
            findings.append(await _found(call))
    except NotApplicable as error:
        return Result(check.name, criterion, str(error), "n/a")
    ok = all(finding.ok for finding in findings)
    return Result(check.name, criterion, summary(findings), "pass" if ok else "fail")


async def _found(call: Callable[[], Awaitable[Finding]]) -> Finding:
    """What the check finds; once more where this machine, not the driver, may have been late.

    Raises NotApplicable where that is so each time.
    """
    for _ in range(ATTEMPTS):
        waited_ms = this_process.waited_ms()
        finding = await _tried(call)
        waited_ms = this_process.waited_ms() - waited_ms
        if finding.ok or not 0 < finding.late_ms <= waited_ms:
            return finding
    raise NotApplicable(
        f"{finding.measured}; this machine is too busy to tell: it had the kit wait "
        f"{waited_ms:.0f} ms for a core meanwhile"
    )


async def _tried(call: Callable[[], Awaitable[Finding]]) -> Finding:
    """What the check finds. What a driver raises is a finding too, and not the end of the kit."""
    began_s = time.monotonic()
    try:
        async with asyncio.timeout(LONGEST_S):
            return await call()
    except NotApplicable:
        raise
    except TimeoutError:
        return Finding(False, f"took over {LONGEST_S:.0f} s", late_ms=STARVED * LONGEST_S * 1e3)
    except Failed as error:
        late_ms = STARVED * (time.monotonic() - began_s) * 1e3
        return Finding(False, str(error), late_ms=late_ms)
    except GigabrainError as error:
        return Finding(False, str(error))
    except Exception as error:  # noqa: BLE001 - a stranger's driver; its error is the finding
        return Finding(False, repr(error))


async def check(
    name: str, link: LinkName, folder: Path, progress: Callable[[str], None], repeat: int = 1
) -> list[Result]:
    """All checks on the robot called `name`. Raises ConfigError when it cannot be had."""
    async with Subject(name, link, folder) as subject:
        return await run(subject, progress, repeat)
