"""Judgements of the fault suite: a healthy robot passes, and a faulty one does not."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Sequence
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from gigabrain_schemas.base import Velocity
from gigabrain_schemas.body import GateStatus, RobotState
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import BODY, CMD_VEL, STATE
from gigabrain_zenoh.bus.bus import Bus, Latest
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.qa.faults.rig import first_slower, first_zero
from gigabrain_zenoh.qa.faults.rows import clocks, estop
from gigabrain_zenoh.qa.faults.rows.body_line import first_disobeyed
from gigabrain_zenoh.qa.faults.rows.clocks import OtherHost, age_error_ms
from gigabrain_zenoh.qa.faults.rows.commands import steps_in_window
from gigabrain_zenoh.qa.faults.rows.estop import PressLog
from gigabrain_zenoh.qa.faults.rows.load import slope_mb_per_h
from gigabrain_zenoh.qa.probe import Probe
from gigabrain_zenoh.qa.robot_under_test import RobotUnderTest
from gigabrain_zenoh.testing.samples import BOOT, DRIVING, body, state
from gigabrain_zenoh.testing.waiting import settle

MB = 1_000_000


@contextlib.asynccontextmanager
async def reported() -> AsyncIterator[Bus]:
    """Somebody who hears a state twenty times a second."""
    network = LocalNetwork()
    driver, ear = (Bus(network.transport(), Clock(), name) for name in ("driver", "ear"))

    async def report() -> None:
        for tick in range(1, 10_000):
            driver.publish(STATE, state(tick))
            await asyncio.sleep(0.05)

    reporting = asyncio.create_task(report())
    try:
        yield ear
    finally:
        reporting.cancel()
        await asyncio.gather(driver.close(), ear.close())


async def test_a_host_whose_clock_is_slightly_off_finds_the_same_ages() -> None:
    async with reported() as bus:
        assert await age_error_ms(bus, OtherHost(), 20) < 1.0


async def test_a_host_whose_clock_runs_twice_as_fast_does_not() -> None:
    async with reported() as bus:
        assert await age_error_ms(bus, OtherHost(lambda since_ns: since_ns), 20) > 1.0


async def test_a_host_that_goes_by_the_stamps_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    class ByStamp(Latest[Any]):
        """A `Latest` that takes the age from the publisher's stamp, which the bus must not do."""

        def __init__(self, topic: Any, clocks: Clock, time: Any) -> None:
            super().__init__(topic, clocks, time)
            self._by = clocks

        def age_ns(self) -> int | None:
            return self._by.unix_ns() - self.current.stamp_ns if self.current else None

    monkeypatch.setattr(clocks, "Latest", ByStamp)
    async with reported() as bus:
        assert await age_error_ms(bus, OtherHost(), 5) > 4900.0


def test_memory_growth_is_the_slope_over_all_samples() -> None:
    samples = [(0.0, 100.0), (1800.0, 101.0), (3600.0, 102.0)]
    assert slope_mb_per_h(samples) == pytest.approx(2.0)
    leaks_180_mb_per_h = [(float(s), 50.0 + 0.05 * s) for s in range(20)]
    assert slope_mb_per_h(leaks_180_mb_per_h) == pytest.approx(180.0)


def drive(modes: Sequence[str], commanded: Sequence[int]) -> Probe:
    """Return a probe that recorded these gate modes, one a tick, and commands in these ticks."""
    probe = Probe(Bus(LocalNetwork().transport(), Clock(), "suite"))
    for tick, mode in enumerate(modes, start=1):
        gate = replace(DRIVING, mode=mode) if mode == "enabled" else GateStatus(mode="stopping")
        probe.states.append(replace(state(tick), gate=gate))
    for tick in commanded:
        probe.commands.append(CmdVel(linear_x=0.2, source="control", boot=BOOT, tick=tick))
        probe.arrivals.append(tick)
    return probe


async def test_who_looks_on_hears_commands_again_whoever_else_listens_to_them() -> None:
    network = LocalNetwork()
    probe = Probe(Bus(network.transport(), Clock(), "suite"))
    robot = Bus(network.transport(), Clock(), "robot")
    for deaf in (False, True, False):
        end = probe.bus.tap(CMD_VEL.key, lambda *_: None)  # as the soak counts what comes
        probe.ignore_commands(deaf)
        robot.publish(BODY, body())
        await settle()
        robot.publish(CMD_VEL, CmdVel(linear_x=0.2, source="control"))
        await settle()
        end()
    assert len(probe.commands) == 2
    assert probe.bus.listens.count(CMD_VEL.key) == 1


@pytest.mark.parametrize(("seen", "slower"), [(20, 20), (23, 23), (40, 31)])
async def test_ticks_that_control_did_not_answer_count_like_all_others(
    seen: int, slower: int
) -> None:
    probe = drive(["enabled"] * 30 + ["stopping"] * 15, [*range(1, 20), *range(seen, 45)])
    for n, command in enumerate(probe.commands):
        if command.tick >= seen:
            probe.commands[n] = replace(command, linear_x=0.1)
    assert first_slower(probe, probe.states[0], 15) == slower


async def test_zero_is_when_the_body_is_measured_at_rest_for_good() -> None:
    probe = drive(["enabled"] * 20 + ["stopping"] * 25, range(1, 21))
    for n, one in enumerate(probe.states):
        moving = one.tick < 30 or one.tick == 33
        probe.states[n] = replace(one, velocity=Velocity(linear_x=0.2 if moving else 0.0))
    assert first_zero(probe, probe.states[0], 20) == 34


async def test_every_start_and_every_stop_counts() -> None:
    modes = ["enabled"] * 30 + ["stopping"] * 15 + ["enabled"] * 30
    once = drive(modes, [*range(1, 25), *range(31, 76)])
    assert once.stops(once.states[0]) == [31]
    counts = [once.starts_and_stops(once.states[0], ticks) for ticks in (29, 30, 44, 45)]
    assert counts == [0, 1, 1, 2]
    never = drive(["enabled"] * 60, range(1, 61))
    assert never.starts_and_stops(never.states[0], 60) == 0


async def test_measured_reversals_are_judged_where_the_body_was_commanded_one_way_before() -> None:
    probe = drive(["enabled"] * 60, [])
    for n, one in enumerate(probe.states):
        told = 0.02 * (n % 2) if n < 20 else 0.02 * (n - 20)
        probe.states[n] = replace(one, sent=Velocity(linear_x=told), stamp_ns=n * 20_000_000)
    assert [steps_in_window(probe, tick) for tick in (10, 20, 24, 26, 30)] == [0, 0, 0, 12, 12]


async def test_a_press_takes_as_long_as_its_answer_however_few_ticks_that_are() -> None:
    probe = drive(["enabled"], [])
    presses = PressLog(cast("RobotUnderTest", SimpleNamespace(probe=probe)))

    async def press() -> None:
        before = probe.state
        await asyncio.sleep(0.2)
        gate = GateStatus(mode="latched", estop_generation=1)
        probe.states.append(replace(before, tick=before.tick + 1, gate=gate))
        probe.on_state(probe.state)

    await presses.press(press)
    figures = presses.figures()
    assert figures[estop.LATCHED] == 20.0
    assert min(figures[estop.ANSWER], figures[estop.ANSWER_P99], figures[estop.ZERO_MAX]) >= 200.0


def turned(*pairs: tuple[float, float]) -> list[RobotState]:
    """States in which the body was told to turn, and turned, so fast [rad/s]."""
    return [
        replace(state(tick), sent=Velocity(angular_z=told), velocity=Velocity(angular_z=measured))
        for tick, (told, measured) in enumerate(pairs)
    ]


def test_a_body_disobeys_from_when_it_turns_unlike_all_it_was_commanded_of_late() -> None:
    straight, swings = (0.0, 0.0), (0.0, 0.9)
    assert first_disobeyed(turned(*[straight] * 3, *[swings] * 5)) == 3
    # it was told so a while ago, and may still turn for its own lag of 15 ticks
    assert first_disobeyed(turned((0.9, 0.0), (0.9, 0.9), *[swings] * 30)) == 17
    # the other way round is no obedience
    assert first_disobeyed(turned((-0.9, 0.0), straight, *[swings] * 5)) == 2
