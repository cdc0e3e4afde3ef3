"""Queries by the thousand: bounded, a few in a turn of the loop, and an e-stop before all."""

import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from gigabrain_schemas.topics import ESTOP, SERVICES
from gigabrain_zenoh.bus.bridge import Bridge, QueryQueue
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork, LocalTransport
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.testing.waiting import start_thread, until


class Rig:
    """A process that serves three keys, and what it has begun to answer, in order."""

    def __init__(self) -> None:
        self.bridge, self.refused, self.begun = Bridge(), list[str](), list[str]()
        self.turns = 0
        self.at_turn: dict[str, int] = {}
        self.goes_on = asyncio.Event()
        self.goes_on.set()
        self.questions: QueryQueue[str] = QueryQueue(self.bridge, self.refused.append)
        self.describe, self.close_describe = self.questions.serve(self._answer, urgent=False)
        self.goal, _ = self.questions.serve(self._answer, urgent=False)
        self.estop, _ = self.questions.serve(self._answer, urgent=True)
        self._turn()

    def _turn(self) -> None:
        self.turns += 1
        self._timer = asyncio.get_running_loop().call_soon(self._turn)

    async def _answer(self, query: str) -> None:
        self.begun.append(query)
        self.at_turn[query] = self.turns
        await self.goes_on.wait()

    def close(self) -> None:
        self._timer.cancel()
        self.questions.close()
        self.bridge.close()


@pytest.fixture
async def rig() -> AsyncIterator[Rig]:
    made = Rig()
    yield made
    made.close()


def ask(put: Callable[[str], None], count: int, name: str) -> None:
    for number in range(count):
        put(f"{name} {number}")


async def test_an_estop_behind_20000_queries_is_begun_first(rig: Rig) -> None:
    ask(rig.describe, 20_000, "describe")
    rig.estop("estop")
    before = rig.turns
    await until(lambda: len(rig.begun) >= 33)
    assert rig.begun[0] == "estop"
    assert rig.at_turn["estop"] - before <= 3
    assert rig.begun[1:] == [f"describe {number}" for number in range(19_968, 20_000)]
    assert rig.refused == [f"describe {number}" for number in range(19_968)]


async def test_an_estop_that_comes_while_queries_are_answered_waits_for_4_of_them(rig: Rig) -> None:
    ask(rig.describe, 20_000, "describe")
    await until(lambda: rig.begun)
    begun, before = len(rig.begun), rig.turns
    rig.estop("estop")
    await until(lambda: "estop" in rig.begun)
    assert rig.begun.index("estop") - begun <= 4
    assert rig.at_turn["estop"] - before <= 3


async def test_no_more_than_4_queries_are_begun_in_a_turn_of_the_loop(rig: Rig) -> None:
    ask(rig.describe, 20, "describe")
    ask(rig.goal, 20, "goal")
    await until(lambda: len(rig.begun) == 40)
    turns = list(rig.at_turn.values())
    assert max(turns.count(turn) for turn in turns) == 4
    assert rig.begun[:4] == ["describe 0", "goal 0", "describe 1", "goal 1"]  # alternately


async def test_a_flood_from_threads_loses_no_estop_and_tells_each_asker_once(rig: Rig) -> None:
    flood = start_thread(lambda: ask(rig.describe, 20_000, "describe"))
    presses = start_thread(lambda: ask(rig.estop, 20, "estop"))
    flood.join()
    presses.join()
    await until(lambda: len(rig.begun) + len(rig.refused) == 20_020)
    assert [query for query in rig.begun if "estop" in query] == [f"estop {n}" for n in range(20)]
    assert len({*rig.begun, *rig.refused}) == 20_020


async def test_answers_that_do_not_end_hold_up_neither_other_keys_nor_an_estop(rig: Rig) -> None:
    rig.goes_on.clear()
    for number in range(100):
        rig.describe(f"describe {number}")
        await asyncio.sleep(0)
    await until(lambda: len(rig.begun) == 32)
    ask(rig.estop, 30, "estop")
    rig.goal("goal")
    await until(lambda: len(rig.begun) == 32 + 30 + 1)
    rig.goes_on.set()
    await until(lambda: len(rig.begun) == 32 + 30 + 1 + 32)


async def test_who_waits_for_a_key_that_is_served_no_more_is_told_so(rig: Rig) -> None:
    ask(rig.describe, 3, "describe")
    rig.close_describe()
    rig.close_describe()
    rig.goal("goal")
    await until(lambda: rig.begun)
    assert (rig.begun, len(rig.refused)) == (["goal"], 3)


class Spy(LocalTransport):
    """Notes which keys are urgent."""

    def __init__(self) -> None:
        super().__init__(LocalNetwork())
        self.urgent: dict[str, bool] = {}

    def serve(self, key: str, answer: object, *, urgent: bool = False) -> Callable[[], None]:
        self.urgent[key] = urgent
        return lambda: None


async def never(_: Any) -> Any:
    raise AssertionError("nobody asks")


async def test_the_estop_is_urgent_and_nothing_else() -> None:
    spy = Spy()
    bus = Bus(spy, FakeClock(), "driver")
    for service in SERVICES:
        bus.serve(service, never)
    assert spy.urgent[ESTOP.key]
    assert sum(spy.urgent.values()) == 1
