"""Replays recorded input to one node in fake time. The same input gives the same output."""

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable, Iterable, Iterator, Sequence

from gigabrain_schemas.logs import FINISHED, WAITED
from gigabrain_schemas.topics import MAP_SAVE, SERVICES
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import ReplayedInputLogger
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.runtime.services import serve_params

Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]
Event = tuple[int, str, bytes]  # time since the start [ns], key, payload
ASKED = {service.key for service in SERVICES}
GOES_ON = {MAP_SAVE.key}  # fake time continues while these are answered
UNDONE = b"\0"  # payload on WAITED: the work was not done in time
PATIENCE_S = 30.0  # longest wait for an answer: it may need a worker thread, or fake time to pass


def record(network: LocalNetwork, clock: Clock) -> list[Event]:
    """Return a list to which every later message on the topics of `network` is appended."""
    events: list[Event] = []
    network.listen("robot/**", lambda key, data: events.append((clock.now_ns(), key, data)))
    return events


async def replay(
    node: Node, recording: Sequence[Event], process: str = ""
) -> list[tuple[str, bytes]]:
    """Feed `recording` to `node` at its recorded times; return the messages that the node sent.

    The node's parameters are served under the name `process`. An event on a service's key is a
    request; it is answered before time continues, except when it saves a map. An event on WAITED
    holds the outcome of a wait for a worker thread, at the event before it; at one on FINISHED work
    in a thread is finished, or at once where there is none. Raises the node's own
    error, and ValueError for events that are not in order of time.
    """
    clock, network = FakeClock(), LocalNetwork()
    bus = Bus(network.transport(), clock, process)
    serve_params(bus)
    bus.input_log = past = ReplayedInputLogger()
    finishes_logged = any(key == FINISHED for _, key, _ in recording)
    ready, asked = asyncio.Event(), list[asyncio.Future[None]]()
    running = asyncio.ensure_future(node(bus, ready.set))
    try:
        await _either(running, ready)  # a node may compile in a worker thread first
        await clock.advance(0)
        for (at_ns, key, payload), past.outcomes in _with_waits(recording):
            if at_ns < clock.now_ns():
                raise ValueError(f"an event at {at_ns} ns follows one at {clock.now_ns()} ns")
            await clock.advance(at_ns - clock.now_ns())
            if key in ASKED or key.rpartition("/")[0] in ASKED:
                asked.append(asyncio.ensure_future(_ask(network, key, payload)))
                await asyncio.wait(asked[-1:], timeout=0.0 if key in GOES_ON else PATIENCE_S)
            elif key == FINISHED:
                past.finish()
            else:
                network.deliver(key, payload)
                if not finishes_logged:
                    past.finish()
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
    """Yield each event with the outcomes of the waits that follow it."""
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
        with contextlib.suppress(GigabrainError):  # refused; accepted changes are recorded
            await answer(payload)
