"""Results of the conformance kit on a machine that is too busy."""

import functools
import itertools
import os
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from gigabrain_zenoh.host import this_process
from gigabrain_zenoh.qa.conformance import driver_checks, kit
from gigabrain_zenoh.qa.judging import Failed, Finding, Skipped


def waiting(monkeypatch: pytest.MonkeyPatch, each_ms: float) -> None:
    """A machine that has the kit wait so long between two looks."""
    steps = itertools.count()
    monkeypatch.setattr(this_process, "waited_ms", lambda: each_ms * next(steps))


def finds(*findings: Finding) -> Callable[[], Awaitable[Finding]]:
    """A check that finds this, one after the other."""
    rest = iter(findings)

    async def check() -> Finding:
        return next(rest)

    return check


LATE = Finding(False, "at rest after 60 ticks of at most 50", late_ms=200.0)
GOOD = Finding(True, "at rest after 20 ticks of at most 50")
WRONG = Finding(False, "3 obeyed")


async def test_late_on_a_machine_that_was_later_still_is_tried_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waiting(monkeypatch, 300.0)
    assert await kit._found(finds(LATE, LATE, GOOD)) == GOOD


async def test_late_three_times_on_such_a_machine_says_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waiting(monkeypatch, 300.0)
    with pytest.raises(Skipped, match="60 ticks of at most 50; this machine is too busy"):
        await kit._found(finds(LATE, LATE, LATE))


async def test_late_by_more_than_the_machine_is_the_drivers_fault(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    waiting(monkeypatch, 100.0)
    assert await kit._found(finds(LATE)) == LATE


async def test_what_is_wrong_is_wrong_on_any_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    waiting(monkeypatch, 1e6)
    assert await kit._found(finds(WRONG)) == WRONG


async def test_a_driver_that_does_not_come_as_far_fails_on_a_machine_with_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def stuck() -> Finding:
        raise Failed("the body did not move; gate idle")

    waiting(monkeypatch, 0.0)
    assert (await kit._found(stuck)).measured == "the body did not move; gate idle"
    waiting(monkeypatch, 1e6)
    with pytest.raises(Skipped, match="did not move; gate idle; this machine is too busy"):
        await kit._found(stuck)


@pytest.mark.long
async def test_a_speed_that_is_not_reached_counts_on_a_machine_with_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver_checks, "RAMP_TICKS", 5)
    monkeypatch.setattr(driver_checks, "UNIT", -1.0)  # nothing comes as near as that
    async with driver_checks.CheckedRobot("mock", "sim", tmp_path) as robot:
        call = functools.partial(driver_checks.obeys, robot)
        waiting(monkeypatch, 0.0)
        assert not (await kit._found(call)).ok
        waiting(monkeypatch, 1e6)
        with pytest.raises(Skipped, match="this machine is too busy"):
            await kit._found(call)


def test_waiting_for_a_core_is_summed_over_all_threads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for thread, text in (("7", "900 2000000 5\n"), ("8", "100 500000 2\n")):
        folder = tmp_path / "self" / "task" / thread
        folder.mkdir(parents=True)
        (folder / "schedstat").write_text(text)
    monkeypatch.setattr(this_process, "PROC", tmp_path)
    assert this_process.waited_ms() == 2.5
    assert this_process.waited_ns_by_thread("self") == {"7": 2_000_000, "8": 500_000}


def test_where_the_system_does_not_say_nothing_was_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(this_process, "PROC", tmp_path / "none")
    monkeypatch.setattr(this_process, "OWN_SCHEDSTAT", tmp_path / "none")
    assert (this_process.waited_ms(), this_process.own_waited_ms()) == (0.0, 0.0)
    assert this_process.stolen_ns_by_core() == {}


def test_what_a_host_keeps_from_a_virtual_machine_is_reported_by_core(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = ("cpu  9 9 9 9 9 9 9 7 0 0", "cpu0 1 2 3 4 5 6 7 5 9 9", "cpu1 1 2 3 4 5 6 7 2 9 9")
    (tmp_path / "stat").write_text("\n".join((*lines, "intr 1 2 3", "")))
    monkeypatch.setattr(this_process, "PROC", tmp_path)
    tick_ns = 1_000_000_000 // os.sysconf("SC_CLK_TCK")
    assert this_process.stolen_ns_by_core() == {"cpu0": 5 * tick_ns, "cpu1": 2 * tick_ns}
