"""Run one node against recorded input, in fake time. The same input gives the same output."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence

from gigabrain_schemas.heard import WAITED
from gigabrain_schemas.topics import MAP_SAVE, SERVICES
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.journal import PastJournal
from gigabrain_zenoh.param_service import serve_params
from gigabrain_zenoh.transport import LocalNetwork

Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]
Event = tuple[int, str, bytes]  # time since the start [ns], key, payload
ASKED = {service.key for service in SERVICES}
GOES_ON = {MAP_SAVE.key}  # while it is answered, time does
UNDONE = b"\0"  # of a wait: the work was not done in time
PATIENCE_S = 30.0  # for an answer, which may take work beside the loop; it may wait for time, too


def record(network: LocalNetwork, clock: Clock) -> list[Event]:
    """A list that grows with all that passes on the topics of `network` from now on."""
    events: list[Event] = []
    network.listen("robot/*", lambda key, data: events.append((clock.now_ns(), key, data)))
    return events


async def replay(
    node: Node, recording: Sequence[Event], process: str = ""
) -> list[tuple[str, bytes]]:
    """Feed `recording` to `node` at its recorded times; return what the node itself sent.

    `process` is its name, by which it is asked for its parameters. An event on a service's key is a
    request, which is answered before time goes on, but for saving a map; one on WAITED
    says how waiting for work beside had ended at the event before it. Raises whatever ended the
    node, and ValueError for events that are not in order of time.
    """
    clock, network = FakeClock(), LocalNetwork()
    bus = Bus(network.transport(), clock, process)
    serve_params(bus)
    bus.journal = past = PastJournal()
    ready, asked = asyncio.Event(), list[asyncio.Future[None]]()
    running = asyncio.ensure_future(node(bus, ready.set))
    try:
        await _either(running, ready)  # a node may compile, beside the loop
        await clock.advance(0)
        for (at_ns, key, payload), past.outcomes in _with_waits(recording):
            if at_ns < clock.now_ns():
                raise ValueError(f"an event at {at_ns} ns follows one at {clock.now_ns()} ns")
            await clock.advance(at_ns - clock.now_ns())
            if key in ASKED or key.rpartition("/")[0] in ASKED:
                asked.append(asyncio.ensure_future(_ask(network, key, payload)))
                await asyncio.wait(asked[-1:], timeout=0.0 if key in GOES_ON else PATIENCE_S)
            else:
                network.deliver(key, payload)
        await clock.advance(0)
    finally:
        for each in (running, *asked):
            each.cancel()
        await asyncio.wait((running, *asked))
        await bus.close()
    if not running.cancelled():
        running.result()
    return network.sent


def _with_waits(recording: Iterable[Event]) -> Iterator[tuple[Event, deque[bool]]]:
    """Each event with the outcomes of the waits that follow it."""
    event, outcomes = None, deque[bool]()
    for one in recording:
        if one[1] == WAITED:
            outcomes.append(one[2] != UNDONE)
            continue
        if event:
            yield event, outcomes
        event, outcomes = one, deque()
    if event:
        yield event, outcomes


async def _either(running: asyncio.Future[None], ready: asyncio.Event) -> None:
    waiting = asyncio.ensure_future(ready.wait())
    await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()


async def _ask(network: LocalNetwork, key: str, payload: bytes) -> None:
    for answer in network.servers(key):
        with contextlib.suppress(GigabrainError):  # a refusal; what was granted shows the change
            await answer(payload)
