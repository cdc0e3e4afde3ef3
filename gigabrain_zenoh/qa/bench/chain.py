"""`gigabrain bench chain`: our chain and a bare relay, in turns, and where the difference goes."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from msgspec import Struct

from gigabrain_zenoh.qa.bench.costs import Hop, measure_hops
from gigabrain_zenoh.qa.bench.figures import Figures, over_rounds
from gigabrain_zenoh.qa.bench.runs import listen_to_chain, time_chain, time_peers, time_relay

LISTEN_S = 4.0
TARGET_P50, TARGET_P99 = 1.5, 2.0  # of the bare relay's


class Compared(Struct, frozen=True, kw_only=True):
    """One rate: the rounds, which were run in turns, and one run without a router beside them."""

    rate_hz: float
    chain: tuple[Figures, ...]
    relay: tuple[Figures, ...]
    peers: Figures

    @property
    def ratio_p50(self) -> float:
        """Ours over the bare relay's."""
        return over_rounds(self.chain).p50_ms / over_rounds(self.relay).p50_ms

    @property
    def ratio_p99(self) -> float:
        """Ours over the bare relay's."""
        return over_rounds(self.chain).p99_ms / over_rounds(self.relay).p99_ms


class ChainResult(Struct, frozen=True, kw_only=True):
    """The whole benchmark."""

    seconds: float  # of each run
    payload_bytes: tuple[int, ...]  # scan, world, intent, command
    rates: tuple[Compared, ...]
    overheard: Figures  # the chain with somebody listening, which the hops add up to
    hops: tuple[Hop, ...]


async def measure_chain(
    seconds: float, rounds: int, rates_hz: Sequence[float], say: Callable[[str], None]
) -> ChainResult:
    """Run it all. Raises GigabrainError when a process dies on the way."""
    with tempfile.TemporaryDirectory(prefix="gigabrain-bench-") as name:
        folder = Path(name)
        say(f"listening to the chain at {rates_hz[0]:g} Hz")
        heard, overheard = await listen_to_chain(rates_hz[0], min(seconds, LISTEN_S), folder)
        sizes = heard.sizes()
        compared = [await _compare(rate, seconds, rounds, sizes, folder, say) for rate in rates_hz]
        say("timing what each hop does")
        hops = await measure_hops(heard, overheard, folder)
    return ChainResult(
        seconds=seconds,
        payload_bytes=tuple(sizes),
        rates=tuple(compared),
        overheard=overheard,
        hops=tuple(hops),
    )


async def _compare(
    rate_hz: float,
    seconds: float,
    rounds: int,
    sizes: Sequence[int],
    folder: Path,
    say: Callable[[str], None],
) -> Compared:
    chain, relay = [], []
    for i in range(1, rounds + 1):
        say(f"{rate_hz:g} Hz, round {i} of {rounds}: chain")
        chain.append(await time_chain(rate_hz, seconds, folder))
        say(f"{rate_hz:g} Hz, round {i} of {rounds}: bare relay")
        relay.append(await time_relay(rate_hz, seconds, sizes, folder))
    say(f"{rate_hz:g} Hz: bare relay without a router")
    peers = await time_peers(rate_hz, seconds, sizes)
    return Compared(rate_hz=rate_hz, chain=tuple(chain), relay=tuple(relay), peers=peers)
