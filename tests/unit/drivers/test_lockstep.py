import asyncio

from gigabrain_drivers.driver.lockstep import Lockstep
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.safety import SafetyState
from gigabrain_zenoh.safety.catalogue import cause


def command(tick: int, basis: int, source: str = "control") -> CmdVel:
    return CmdVel(linear_x=0.0, tick=tick, basis=basis, source=source)


def test_a_tick_without_a_scan_waits_for_the_command_that_echoes_it() -> None:
    steps = Lockstep()
    steps.begin(7, 5)
    steps.verdict(SafetyState(verdict="ok", tick=6, basis=5))
    steps.command(command(6, 5))
    assert not steps.complete
    steps.command(command(7, 5))
    assert steps.complete


def test_a_tick_without_a_scan_waits_for_safety_that_may_repeat_itself_in_every_second() -> None:
    steps = Lockstep()
    steps.begin(8, 5)
    steps.command(command(8, 5))
    for tick, enough in ((5, False), (6, False), (7, True)):
        steps.verdict(SafetyState(verdict="ok", tick=tick, basis=5))
        assert steps.complete is enough


def test_a_tick_with_a_scan_waits_for_the_command_and_the_verdict_that_rest_on_it() -> None:
    steps = Lockstep()
    steps.begin(10, 10)
    steps.command(command(10, 5))
    steps.verdict(SafetyState(verdict="ok", basis=5))
    assert not steps.complete
    steps.command(command(10, 10))
    assert not steps.complete
    steps.verdict(SafetyState(verdict="ok", tick=10, basis=10))
    assert steps.complete


def test_a_verdict_that_misses_a_part_of_the_brain_does_not_count() -> None:
    steps = Lockstep()
    steps.begin(1, 1)
    steps.command(command(1, 1))
    starting, missing = cause("starting"), cause("perception_silent")
    steps.verdict(SafetyState(verdict="stop", basis=1, causes=(starting, missing)))
    assert not steps.complete
    steps.verdict(SafetyState(verdict="stop", basis=1, causes=(starting,)))
    assert steps.complete


def test_what_claims_a_tick_that_is_still_to_come_answers_none() -> None:
    steps = Lockstep()
    steps.begin(10, 10)
    for wrong in ((2**40, 10), (10, 2**40)):
        steps.command(command(*wrong))
        steps.verdict(SafetyState(verdict="ok", tick=wrong[0], basis=wrong[1]))
    steps.begin(11, 10)
    assert not steps.complete
    steps.command(command(11, 10))
    assert not steps.complete
    steps.verdict(SafetyState(verdict="ok", tick=11, basis=10))
    assert steps.complete


def test_a_commander_that_looks_itself_needs_no_basis() -> None:
    steps = Lockstep()
    steps.begin(10, 10)
    steps.verdict(SafetyState(verdict="ok", tick=10, basis=10))
    steps.command(command(10, 0, "script"))
    assert steps.complete


async def test_the_answer_wakes_the_one_who_waits() -> None:
    steps = Lockstep()
    steps.begin(1, 0)
    waiting = asyncio.ensure_future(steps.wait(10.0))
    await asyncio.sleep(0)
    steps.command(command(1, 0))
    assert await waiting
    assert steps.timeouts == 0


async def test_a_tick_that_nobody_answers_goes_on_and_is_counted() -> None:
    steps = Lockstep()
    steps.begin(1, 0)
    await steps.answered()
    assert steps.timeouts == 1
