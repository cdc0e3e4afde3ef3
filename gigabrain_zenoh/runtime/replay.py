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
REQUEST_KEYS = {service.key for service in SERVICES}
UNAWAITED = {MAP_SAVE.key}  # fake time continues while these are answered
NOT_DONE = b"\0"  # payload on WAITED: the work was not done in time
REPLY_TIMEOUT_S = 30.0  # a reply may need a worker thread, or need fake time to pass


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
    holds the outcome of a wait for a worker thread, at the event before it. At an event on FINISHED
    the work in a thread is finished; a recording without such events finishes it at every event.
    Raises the node's own error, and ValueError for events that are not in order of time.
    """
    clock, network = FakeClock(), LocalNetwork()
    bus = Bus(network.transport(), clock, process)
    serve_params(bus)
    bus.input_log = past = ReplayedInputLogger()
    finishes_logged = any(key == FINISHED for _, key, _ in recording)
    ready, requests = asyncio.Event(), list[asyncio.Future[None]]()
    running = asyncio.ensure_future(node(bus, ready.set))
    try:
        await _ready_or_ended(running, ready)  # a node may compile in a worker thread first
        await clock.advance(0)
        for (at_ns, key, payload), past.outcomes in _with_waits(recording):
            if at_ns < clock.now_ns():
                raise ValueError(f"an event at {at_ns} ns follows one at {clock.now_ns()} ns")
            await clock.advance(at_ns - clock.now_ns())
            if key in REQUEST_KEYS or key.rpartition("/")[0] in REQUEST_KEYS:
                requests.append(asyncio.ensure_future(_request(network, key, payload)))
                timeout_s = 0.0 if key in UNAWAITED else REPLY_TIMEOUT_S
                await asyncio.wait(requests[-1:], timeout=timeout_s)
            elif key == FINISHED:
                past.finish()
            else:
                network.deliver(key, payload)
                if not finishes_logged:
                    past.finish()
        await clock.advance(0)
    finally:
        for task in (running, *requests):
            task.cancel()
        await asyncio.wait((running, *requests))
        await bus.close()
    if not running.cancelled():
        running.result()
    return network.sent


def _with_waits(recording: Iterable[Event]) -> Iterator[tuple[Event, deque[bool]]]:
    """Yield each event with the outcomes of the waits that follow it."""
    event, outcomes = None, deque[bool]()
    for newer in recording:
        _, key, payload = newer
        if key == WAITED:
            outcomes.append(payload != NOT_DONE)
            continue
        if event:
            yield event, outcomes
        event, outcomes = newer, deque()
    if event:
        yield event, outcomes


async def _ready_or_ended(running: asyncio.Future[None], ready: asyncio.Event) -> None:
    waiting = asyncio.ensure_future(ready.wait())
    await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()


async def _request(network: LocalNetwork, key: str, payload: bytes) -> None:
    for answer in network.servers(key):
        with contextlib.suppress(GigabrainError):  # refused; accepted changes are recorded
            await answer(payload)
