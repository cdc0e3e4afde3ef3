import asyncio

import pytest

from gigabrain_drivers.driver.lockstep import Lockstep
from gigabrain_schemas.brain import CameraStatus, CmdVel, WorldModel
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
    steps.verdict(SafetyState(verdict="stop", tick=1, basis=1, causes=(starting, missing)))
    assert not steps.complete
    steps.verdict(SafetyState(verdict="stop", tick=1, basis=1, causes=(starting,)))
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


def test_the_first_tick_waits_for_safety_though_no_scan_is_to_come() -> None:
    steps = Lockstep()
    steps.begin(1, 0)
    steps.command(command(1, 0))
    assert not steps.complete
    steps.verdict(SafetyState(verdict="ok", tick=1))
    assert steps.complete


async def test_the_answer_wakes_the_one_who_waits() -> None:
    steps = Lockstep()
    steps.begin(1, 0)
    waiting = asyncio.ensure_future(steps.wait(10.0))
    await asyncio.sleep(0)
    steps.command(command(1, 0))
    steps.verdict(SafetyState(verdict="ok", tick=1))
    assert await waiting
    assert steps.timeouts == 0


async def test_a_tick_that_nobody_answers_goes_on_and_is_counted() -> None:
    steps = Lockstep()
    steps.begin(1, 0)
    await steps.answered(lambda: None)
    assert steps.timeouts == 1


def answered(steps: Lockstep, tick: int) -> None:
    steps.command(command(tick, tick))
    steps.verdict(SafetyState(verdict="ok", tick=tick, basis=tick))


def saw(exposure: int, *, ok: bool = True) -> WorldModel:
    status = CameraStatus(name="front", ok=ok, exposure=exposure)
    return WorldModel(scan_ok=True, obstacle_ahead=False, cameras=(status,))


def test_a_tick_with_a_picture_waits_for_the_picture() -> None:
    steps = Lockstep()
    steps.begin(10, 10, ["front", "rear"])
    answered(steps, 10)
    for camera, tick in (("front", 10), ("rear", 5), ("rear", 11)):
        steps.picture(camera, tick)
        assert not steps.complete
    steps.picture("rear", 10)
    assert steps.complete


def test_a_tick_waits_for_contours_once_perception_has_made_some() -> None:
    steps = Lockstep()
    steps.begin(5, 5, ["front"])
    answered(steps, 5)
    steps.picture("front", 5)
    assert steps.complete
    steps.world(saw(5))
    steps.begin(10, 10, ["front"])
    answered(steps, 10)
    steps.picture("front", 10)
    assert not steps.complete
    steps.world(saw(10))
    assert steps.complete


def test_a_blind_camera_makes_no_contours_to_wait_for() -> None:
    steps = Lockstep()
    steps.begin(5, 5, ["front"])
    steps.world(saw(5))
    steps.begin(10, 10, ["front"])
    answered(steps, 10)
    steps.picture("front", 10)  # word that it is withheld
    steps.world(saw(5, ok=False))
    assert steps.complete


def test_a_tick_without_a_picture_still_waits_for_one_that_is_late() -> None:
    steps = Lockstep()
    steps.begin(5, 5, ["front"])
    steps.begin(6, 5)
    answered(steps, 6)
    assert not steps.complete
    steps.picture("front", 5)
    assert steps.complete


def test_pictures_that_never_come_can_be_given_up() -> None:
    steps = Lockstep()
    steps.begin(1, 1, ["front"])
    answered(steps, 1)
    assert not steps.complete
    steps.forget_pictures()
    assert steps.complete


async def test_the_first_tick_that_goes_on_alone_says_what_was_missing(
    caplog: pytest.LogCaptureFixture,
) -> None:
    steps = Lockstep(timeout_s=0.001)
    for tick in (10, 15):
        steps.begin(tick, tick, ("front", "rear"))
        steps.verdict(SafetyState(verdict="ok", tick=tick, basis=tick))
        steps.picture("rear", tick)
        await steps.answered(lambda: None)
    (record,) = caplog.records
    for part in ("tick 10", "a command", "front"):
        assert part in record.getMessage()
    for part in ("safety", "rear"):
        assert part not in record.getMessage()


async def test_a_tick_that_waits_long_is_announced_again_until_it_is_answered() -> None:
    steps = Lockstep(timeout_s=60.0)
    steps.begin(10, 10)
    announced = 0

    def again() -> None:
        nonlocal announced
        announced += 1
        if announced == 2:
            answered(steps, 10)

    await steps.answered(again)
    assert (announced, steps.timeouts) == (2, 0)


async def test_a_tick_with_the_usual_patience_is_announced_once() -> None:
    steps = Lockstep()
    steps.begin(10, 10)
    await steps.answered(lambda: pytest.fail("announced again"))
    assert steps.timeouts == 1
