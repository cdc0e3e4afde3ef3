"""What the fault suite judges by: that it tells a robot that is well from one that is not."""

import asyncio
import contextlib
import os
from collections.abc import AsyncIterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from gigabrain_schemas.body import GateStatus
from gigabrain_schemas.brain import CmdVel
from gigabrain_schemas.topics import BODY, CMD_VEL, STATE
from gigabrain_zenoh.bus import Bus, Latest
from gigabrain_zenoh.clock import Clock
from gigabrain_zenoh.faults import clock
from gigabrain_zenoh.faults.clock import OtherHost, age_error_ms
from gigabrain_zenoh.faults.growth import Growth
from gigabrain_zenoh.faults.onlooker import Onlooker
from gigabrain_zenoh.faults.smooth import starts, stops, stops_in_time
from gigabrain_zenoh.faults.stopping import first_zero
from gigabrain_zenoh.transport import LocalNetwork
from tests.brain_rig import BOOT, DRIVING, body, state
from tests.bus_rig import settle

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
        """What the bus must not do."""

        def __init__(self, topic: Any, clock: Clock, time: Any) -> None:
            super().__init__(topic, clock, time)
            self._by = clock

        def age_ns(self) -> int | None:
            return self._by.unix_ns() - self.current.stamp_ns if self.current else None

    monkeypatch.setattr(clock, "Latest", ByStamp)
    async with reported() as bus:
        assert await age_error_ms(bus, OtherHost(), 5) > 4900.0


def test_what_a_process_holds_more_than_before_is_seen(tmp_path: Path) -> None:
    growth = Growth([os.getpid(), os.getppid()])
    with contextlib.ExitStack() as stack:
        for number in range(3):
            stack.enter_context(open(tmp_path / str(number), "w"))
        held = b"x" * (64 * MB)
        assert growth.open_files() == 3
        assert growth.memory_mb() > 32.0
    del held
    assert growth.open_files() == 0


def drive(modes: Sequence[str], commanded: Sequence[int]) -> Onlooker:
    """Who has looked on while the gate was in these modes, and commands came in these ticks."""
    onlooker = Onlooker(Bus(LocalNetwork().transport(), Clock(), "suite"))
    for tick, mode in enumerate(modes, start=1):
        gate = replace(DRIVING, mode=mode) if mode == "enabled" else GateStatus(mode="stopping")
        onlooker.states.append(replace(state(tick), gate=gate))
    for tick in commanded:
        onlooker.commands.append(CmdVel(linear_x=0.2, source="control", boot=BOOT, tick=tick))
        onlooker.arrivals.append(tick)
    return onlooker


async def test_who_looks_on_hears_commands_again_whoever_else_listens_to_them() -> None:
    network = LocalNetwork()
    onlooker = Onlooker(Bus(network.transport(), Clock(), "suite"))
    robot = Bus(network.transport(), Clock(), "robot")
    for deaf in (False, True, False):
        end = onlooker.bus.tap(CMD_VEL.key, lambda *_: None)  # as the soak counts what comes
        onlooker.deafen(deaf)
        robot.publish(BODY, body())
        await settle()
        robot.publish(CMD_VEL, CmdVel(linear_x=0.2, source="control"))
        await settle()
        end()
    assert len(onlooker.commands) == 2
    assert onlooker.bus.listens.count(CMD_VEL.key) == 1


@pytest.mark.parametrize(("seen", "zero"), [(20, 20), (21, 20), (22, 20), (23, 21), (40, 31)])
async def test_ticks_that_a_busy_machine_left_out_do_not_make_a_stop_later(
    seen: int, zero: int
) -> None:
    onlooker = drive(["enabled"] * 30 + ["stopping"] * 15, [*range(1, 20), *range(seen, 45)])
    for n, command in enumerate(onlooker.commands):
        if command.tick >= seen:
            onlooker.commands[n] = replace(command, linear_x=0.1)
    assert first_zero(onlooker, onlooker.states[0], 15) == zero


async def test_a_stop_is_unexplained_only_where_commands_came_in_time() -> None:
    modes = ["enabled"] * 30 + ["stopping"] * 15 + ["enabled"] * 30
    steady = drive(modes, range(1, 76))
    assert stops(steady, steady.states[0]) == [31]
    assert stops_in_time(steady, steady.states[0]) == 1
    with_a_gap = drive(modes, [*range(1, 25), *range(31, 76)])
    assert stops(with_a_gap, with_a_gap.states[0]) == [31]
    assert stops_in_time(with_a_gap, with_a_gap.states[0]) == 0
    assert [starts(steady, steady.states[0], ticks) for ticks in (44, 45)] == [0, 1]
    never = drive(["enabled"] * 60, range(1, 61))
    assert starts(never, never.states[0], 60) == 0
    assert stops_in_time(never, never.states[0]) == 0
