"""However several processes of one name start together, exactly one of them stays."""

import asyncio
import random
from collections.abc import Iterable

import pytest

from gigabrain_schemas.topics import Priority
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Answer, Close, LocalNetwork, LocalTransport
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.errors import ConfigError
from gigabrain_zenoh.runtime.services import NameClaim

SECOND_NS = 1_000_000_000


class SlowNetwork:
    """Joins processes over links of their own delays: what one declares another hears of late."""

    def __init__(self, delays_ns: Iterable[int]) -> None:
        self.clock, self._delays = FakeClock(), iter(delays_ns)
        self.refusals = 0  # questions that are still to be refused
        self.served: list[tuple[int, SlowTransport, Answer]] = []
        self._between: dict[frozenset[int], int] = {}

    def delay_ns(self, one: "SlowTransport", two: "SlowTransport") -> int:
        """From one end to the other, always the same."""
        pair = frozenset((id(one), id(two)))
        if len(pair) == 1:
            return 0
        return self._between.setdefault(pair, next(self._delays))


class SlowTransport(LocalTransport):
    """One process's end of it; only questions and answers are slow."""

    def __init__(self, network: SlowNetwork) -> None:
        super().__init__(LocalNetwork())
        self._slow = network

    def serve(self, key: str, answer: Answer, *, urgent: bool = False) -> Close:
        self._slow.served.append((self._slow.clock.now_ns(), self, answer))
        return lambda: None

    async def query(
        self, key: str, payload: bytes, encoding: str, timeout_s: float, priority: Priority
    ) -> list[bytes | str]:
        if self._slow.refusals:
            self._slow.refusals -= 1
            return ["too many others ask"]
        now = self._slow.clock.now_ns()
        heard_of = [
            (self._slow.delay_ns(self, other), answer)
            for since, other, answer in self._slow.served
            if since + self._slow.delay_ns(self, other) <= now
        ]
        in_time = [one for one in heard_of if 2 * one[0] <= timeout_s * SECOND_NS]
        asked = (self._asked(delay, answer, payload) for delay, answer in in_time)
        return list(await asyncio.gather(*asked))

    async def _asked(self, delay_ns: int, answer: Answer, payload: bytes) -> bytes | str:
        await self._slow.clock.sleep_ns(delay_ns)
        told, _ = await answer(payload)
        await self._slow.clock.sleep_ns(delay_ns)
        return told

    async def close(self) -> None:
        self._slow.served = [one for one in self._slow.served if one[1] is not self]


async def life(network: SlowNetwork, begin_ns: int, stay: asyncio.Event) -> None:
    """One process, as `gigabrain_zenoh.launch.process` has it."""
    await network.clock.sleep_ns(begin_ns)
    transport = SlowTransport(network)
    claim = NameClaim(Bus(transport, network.clock, "driver"))
    try:
        await claim.acquire()
        await claim.settle()
        await stay.wait()
    finally:
        await transport.close()


async def stayed(begins_ns: list[int], delays_ns: Iterable[int]) -> int:
    """Return the number of processes, begun at these times [ns], that still run after 20 s."""
    network, stay = SlowNetwork(delays_ns), asyncio.Event()
    lives = [asyncio.ensure_future(life(network, begin, stay)) for begin in begins_ns]
    await network.clock.advance(20 * SECOND_NS)
    left = [one for one in lives if not one.done()]
    for one in lives:
        if one.done():
            assert isinstance(one.exception(), ConfigError)
    stay.set()
    await asyncio.gather(*left)
    return len(left)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(20))
async def test_of_several_that_start_together_exactly_one_stays(seed: int) -> None:
    chance = random.Random(seed)
    for _ in range(25):
        slowest_ns = chance.choice((0, 1_000_000, 100_000_000, 800_000_000))
        begins = [chance.randint(0, slowest_ns * 2) for _ in range(chance.randint(2, 4))]
        delays = iter(lambda most=slowest_ns: chance.randint(0, most), None)
        assert await stayed(begins, delays) == 1, (begins, slowest_ns)


@pytest.mark.parametrize("later_ns", [SECOND_NS // 10, SECOND_NS, 5 * SECOND_NS, 15 * SECOND_NS])
async def test_who_already_works_stays_whatever_the_numbers(later_ns: int) -> None:
    network, stay = SlowNetwork(iter(lambda: 1_000_000, None)), asyncio.Event()
    first = asyncio.ensure_future(life(network, 0, stay))
    await network.clock.advance(later_ns)
    others = [asyncio.ensure_future(life(network, 0, stay)) for _ in range(5)]
    await network.clock.advance(5 * SECOND_NS)
    assert [type(one.exception()) for one in others] == [ConfigError] * 5
    assert not first.done()
    stay.set()
    await first


@pytest.mark.parametrize(("refusals", "driving"), [(1, 1), (9, 1), (100, 2)])
async def test_a_refused_question_does_not_say_that_the_name_is_free(
    refusals: int, driving: int
) -> None:
    network, stay = SlowNetwork(iter(lambda: 1_000_000, None)), asyncio.Event()
    first = asyncio.ensure_future(life(network, 0, stay))
    await network.clock.advance(10 * SECOND_NS)
    network.refusals = refusals
    second = asyncio.ensure_future(life(network, 0, stay))
    await network.clock.advance(4 * SECOND_NS)
    assert 2 - second.done() == driving
    first.cancel()
    second.cancel()
    await asyncio.gather(first, second, return_exceptions=True)


async def test_who_is_alone_does_not_wait() -> None:
    clock = FakeClock()
    claim = NameClaim(Bus(LocalNetwork().transport(), clock, "driver"))
    await claim.acquire()
    assert claim.claim == "working"
    keeping = asyncio.ensure_future(claim.settle())
    await clock.advance(4 * SECOND_NS)
    await keeping
    assert claim.claim == "settled"


@pytest.mark.parametrize("lost", [(0,), (1,), (0, 1)])
async def test_of_two_that_were_parted_the_one_that_lost_its_link_leaves(
    lost: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, parted = FakeClock(), [LocalNetwork(), LocalNetwork()]
    transports = [network.transport() for network in parted]
    claims = [NameClaim(Bus(transport, clock, "driver")) for transport in transports]
    for claim in claims:
        await claim.acquire()
    keeping = [asyncio.ensure_future(claim.keep()) for claim in claims]
    await clock.advance(5 * SECOND_NS)
    assert [claim.claim for claim in claims] == ["settled", "settled"]
    both = [*parted[0].servers("robot/describe/*"), *parted[1].servers("robot/describe/*")]
    for network in parted:
        monkeypatch.setattr(network, "servers", lambda _: both)
    for index in lost:
        transports[index].losses += 1
    await clock.advance(10 * SECOND_NS)
    (left,) = [index for index, task in enumerate(keeping) if task.done()]
    assert left in lost
    assert isinstance(keeping[left].exception(), ConfigError)
    both.pop(left)
    await clock.advance(10 * SECOND_NS)
    assert claims[1 - left].claim == "settled"
    keeping[1 - left].cancel()


async def test_who_is_alone_after_a_loss_settles_again(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, network = FakeClock(), LocalNetwork()
    transport = network.transport()
    claim = NameClaim(Bus(transport, clock, "driver"))
    await claim.acquire()
    keeping = asyncio.ensure_future(claim.keep())
    await clock.advance(5 * SECOND_NS)
    transport.losses += 1
    with monkeypatch.context() as cut:
        cut.setattr(network, "servers", lambda _: [])
        await clock.advance(20 * SECOND_NS)
        assert claim.claim == "working"
    await clock.advance(5 * SECOND_NS)
    assert (claim.claim, keeping.done()) == ("settled", False)
    keeping.cancel()
