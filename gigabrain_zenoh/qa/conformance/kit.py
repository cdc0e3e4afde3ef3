"""The driver author's kit: all checks in order, on one robot and one link."""

import asyncio
import contextlib
import functools
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, NamedTuple, Self

from gigabrain_zenoh.config.settings import LinkName
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.conformance import arm_checks, driver_checks, gate_checks
from gigabrain_zenoh.qa.conformance.driver_checks import CheckedRobot
from gigabrain_zenoh.qa.conformance.gated_driver import GatedDriver
from gigabrain_zenoh.qa.judging import DriverCheckResult, Failed, Finding, Skipped, summary

MAX_CHECK_S = 60.0  # of one check
ATTEMPTS = 3  # for a check that the machine may have delayed
STARVED_SHARE = 0.1  # least share of a check's time in which it waited for a core


class DriverCheck(NamedTuple):
    """A check of a driver by itself, or of a driver in its process behind the gate."""

    name: str
    criterion: str
    run: Callable[[Any], Awaitable[Finding]]  # of a CheckedRobot, or of a GatedDriver
    with_peer: bool = False
    repeated: bool = False  # repeated as often as asked for


CUT = "motors at zero {promise}; both + 100; at rest 15 ticks (legs: 30) later"
OPENS = DriverCheck("opens", "received within 5 s", driver_checks.opens)
NEVER_RAISES = DriverCheck(
    "never raises", "stop and close, in any state, within 2 s", driver_checks.never_raises
)
KILLED = DriverCheck(
    "stops when it is killed", "motors at zero {promise}, or its guard's 100 ms; + 100",
    gate_checks.driver_killed, with_peer=True, repeated=True,
)  # fmt: skip
BASE_ALONE = (
    DriverCheck("obeys", "measured speed within 10 % + 0.02", driver_checks.obeys),
    DriverCheck("obeys within limits", "asked for 10 times its speed: at most its max speeds",
                driver_checks.limits),
    DriverCheck("returns what it sent", "the body's commands, to 0.02; without a peer, its motion",
                driver_checks.returns),
    DriverCheck("refuses NaN itself", "all zero, nothing raised", driver_checks.refuses_nan),
)  # fmt: skip
JOINTS_ALONE = (
    DriverCheck("opens without motion", "every joint within 0.5° for 2 s", arm_checks.opens_still),
    DriverCheck("joints obey", "each within 2 % of its range, in 3 s", arm_checks.joints_obey),
    DriverCheck("joints keep their ranges", "sent beyond: the end of the range is sent",
                arm_checks.joint_limits),
    DriverCheck("joints refuse NaN", "every joint within 0.5°, nothing raised",
                arm_checks.joints_refuse_nan),
)  # fmt: skip
BASE_GATED = (
    DriverCheck("reports at its rate", "9 of 10 ticks, 100 ms old; scans to 25 %",
                gate_checks.reports),
    DriverCheck("stops on silence", "7 ticks, its ramp, 15 of the body (legs: 30)",
                gate_checks.silence, repeated=True),
    DriverCheck("stops on NaN", "zero in 2 ticks, 15 of the body (legs: 30)",
                gate_checks.not_a_number),
    DriverCheck("stops on disorder", "nothing obeyed; as on silence", gate_checks.disorder),
    DriverCheck("stops on SIGKILL", "of the commander; as on silence",
                gate_checks.killed, repeated=True),
    DriverCheck("stops unplugged", f"reported in 100 ms, {CUT}",
                gate_checks.unplugged, with_peer=True, repeated=True),
    DriverCheck("stops on a frozen peer", f"reported in 250 ms, {CUT}",
                gate_checks.frozen, with_peer=True, repeated=True),
    DriverCheck("reconnects", "by itself in 5 s; still until enabled, then drives",
                gate_checks.reconnects, with_peer=True),
    DriverCheck("command to byte", "p50 at most 1 ms", gate_checks.latency),
)  # fmt: skip
JOINTS_GATED = (
    DriverCheck("enables without motion", "every joint within 0.5° for 1 s",
                arm_checks.enables_still),
    DriverCheck("joints stop on silence", "at rest in 12 ticks, held to 2°",
                arm_checks.joints_silence, repeated=True),
    DriverCheck("joints stop on an e-stop", "at rest in 6 ticks, held to 2°",
                arm_checks.joints_estop, repeated=True),
)  # fmt: skip


def checks_of(robot: CheckedRobot) -> tuple[tuple[DriverCheck, ...], tuple[DriverCheck, ...]]:
    """Return the checks of a robot's driver alone, and those behind the gate."""
    base, joints = robot.has_base, bool(robot.file.joints)
    alone = (OPENS, *BASE_ALONE * base, *JOINTS_ALONE * joints, NEVER_RAISES, *(KILLED,) * base)
    return alone, BASE_GATED * base + JOINTS_GATED * joints


async def check(
    name: str, link: LinkName, folder: Path, progress: Callable[[str], None], repeat: int = 1
) -> list[DriverCheckResult]:
    """Run all checks on the robot called `name`. Raises ConfigError."""
    async with CheckedRobot(name, link, folder) as robot:
        return await run(robot, progress, repeat)


async def run(
    robot: CheckedRobot, progress: Callable[[str], None], repeat: int = 1
) -> list[DriverCheckResult]:
    """Run all checks on an entered robot, in order, and its stops `repeat` times.

    `progress` is called with the name of each check.
    """
    results: list[DriverCheckResult] = []
    call: Callable[[], Awaitable[Finding]]
    all_alone, all_gated = checks_of(robot)
    for alone in all_alone:
        call = functools.partial(alone.run, robot)
        results.append(await _judged(alone, robot, call, progress, repeat))
    async with SharedGate(robot) as shared:
        for gated in all_gated:
            call = functools.partial(shared.run, gated.run)
            results.append(await _judged(gated, robot, call, progress, repeat))
    return results


class SharedGate:
    """One gated driver for all checks; a failed check gets a new one for the next."""

    def __init__(self, robot: CheckedRobot) -> None:
        self._robot, self._stack = robot, contextlib.AsyncExitStack()
        self._gated: GatedDriver | None = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._stack.aclose()

    async def run(self, check: Callable[[GatedDriver], Awaitable[Finding]]) -> Finding:
        """Run a check on the gated driver."""
        gated, self._gated = self._gated, None
        if gated is None:
            await self._stack.aclose()
            gated = await self._stack.enter_async_context(GatedDriver(self._robot))
        finding = await check(gated)
        self._gated = gated if finding.ok else None
        return finding


async def _judged(
    check: DriverCheck,
    robot: CheckedRobot,
    call: Callable[[], Awaitable[Finding]],
    progress: Callable[[str], None],
    repeat: int,
) -> DriverCheckResult:
    criterion = check.criterion.format(promise=robot.promise)
    if check.with_peer and not robot.has_peer:
        text = f"link {robot.link} has no peer that could fail"
        return DriverCheckResult(check.name, criterion, text, "skipped")
    times, findings = repeat if check.repeated else 1, list[Finding]()
    try:
        for count in range(1, times + 1):
            progress(f"{check.name}, {count} of {times}" if times > 1 else check.name)
            findings.append(await _found(call))
    except Skipped as error:
        return DriverCheckResult(check.name, criterion, str(error), "skipped")
    ok = all(finding.ok for finding in findings)
    return DriverCheckResult(check.name, criterion, summary(findings), "passed" if ok else "FAILED")


async def _found(call: Callable[[], Awaitable[Finding]]) -> Finding:
    """Run a check; repeat it if the machine, not the driver, may have been late.

    Raises Skipped if that happens each time.
    """
    for _ in range(ATTEMPTS):
        waited_ms = this_process.waited_ms()
        finding = await _tried(call)
        waited_ms = this_process.waited_ms() - waited_ms
        if finding.ok or not 0 < finding.late_ms <= waited_ms:
            return finding
    raise Skipped(
        f"{finding.measured}; this machine is too busy to judge it: the kit waited "
        f"{waited_ms:.0f} ms for a core"
    )


async def _tried(call: Callable[[], Awaitable[Finding]]) -> Finding:
    """Run a check once. An exception of the driver is a finding too, and does not end the kit."""
    began_s = time.monotonic()
    try:
        async with asyncio.timeout(MAX_CHECK_S):
            return await call()
    except Skipped:
        raise
    except TimeoutError:
        late_ms = STARVED_SHARE * MAX_CHECK_S * 1e3
        return Finding(False, f"took over {MAX_CHECK_S:.0f} s", late_ms=late_ms)
    except Failed as error:
        late_ms = STARVED_SHARE * (time.monotonic() - began_s) * 1e3
        return Finding(False, str(error), late_ms=late_ms)
    except GigabrainError as error:
        return Finding(False, str(error))
    except Exception as error:  # noqa: BLE001 - any error of an unknown driver is a finding
        return Finding(False, repr(error))
