"""Who talks to whom, as Foxglove and Lichtblick draw it."""

from collections import defaultdict

from foxglove import ConnectionGraph

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.graph import chain
from gigabrain_zenoh.diagnostics.roll_call import flows, roll_call


async def connections(bus: Bus) -> ConnectionGraph:
    """The processes of the robot and what they say to one another."""
    senders, receivers = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    there = await roll_call(bus)
    for flow in chain(flows(there.values(), {})):
        senders[flow.key].add(flow.sender)
        receivers[flow.key].add(flow.receiver)
    graph = ConnectionGraph()
    for key in senders:
        graph.set_published_topic(key, sorted(senders[key]))
        graph.set_subscribed_topic(key, sorted(receivers[key]))
    return graph
