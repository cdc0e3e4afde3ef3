"""Run one node against recorded input, in fake time. The same input gives the same output."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence

from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.clock import Clock, FakeClock
from gigabrain_zenoh.transport import LocalNetwork

Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]
Event = tuple[int, str, bytes]  # time since the start [ns], key, payload


def record(network: LocalNetwork, clock: Clock) -> list[Event]:
    """A list that grows with all that passes on the topics of `network` from now on."""
    events: list[Event] = []
    network.listen("robot/*", lambda key, data: events.append((clock.now_ns(), key, data)))
    return events


async def replay(node: Node, recording: Sequence[Event]) -> list[tuple[str, bytes]]:
    """Feed `recording` to `node` at its recorded times; return what the node itself sent.

    Raises whatever ended the node, and ValueError for events that are not in order of time.
    """
    clock, network = FakeClock(), LocalNetwork()
    bus = Bus(network.transport(), clock)
    running = asyncio.ensure_future(node(bus, lambda: None))
    try:
        await clock.advance(0)
        for at_ns, key, payload in recording:
            if at_ns < clock.now_ns():
                raise ValueError(f"an event at {at_ns} ns follows one at {clock.now_ns()} ns")
            await clock.advance(at_ns - clock.now_ns())
            network.deliver(key, payload)
        await clock.advance(0)
    finally:
        running.cancel()
        await asyncio.wait((running,))
        await bus.close()
    if not running.cancelled():
        running.result()
    return network.sent
