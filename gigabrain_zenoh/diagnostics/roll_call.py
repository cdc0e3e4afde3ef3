"""Who is there, and who talks to whom."""

from collections.abc import Iterable, Mapping

from msgspec import Struct, field

from gigabrain_schemas.requests import DescribeRequest, Description
from gigabrain_schemas.safety import Health
from gigabrain_schemas.topics import DESCRIBE
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.diagnostics.keyexpr import matches
from gigabrain_zenoh.diagnostics.names import topic_of

ASK_S = 1.2  # how long a process may take to say who it is


class Flow(Struct, frozen=True, order=True):
    """One process hears another on a key."""

    sender: str
    key: str
    receiver: str
    hz: float = field(default=0.0)  # as the sender last reported


async def roll_call(bus: Bus, timeout_s: float = ASK_S) -> dict[str, Description]:
    """What every process says of itself, by its name."""
    told = await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=timeout_s, name="*")
    return {one.process: one for one in sorted(told, key=lambda one: one.process)}


def senders(key: str, there: Iterable[Description]) -> list[str]:
    """Who has sent on `key`."""
    return [one.process for one in there if any(matches(key, sent) for sent in one.publishes)]


def receivers(key: str, there: Iterable[Description]) -> list[str]:
    """Who listens to `key`."""
    return [
        one.process
        for one in there
        if any(matches(heard, key) or matches(key, heard) for heard in one.subscribes)
    ]


def flows(there: Iterable[Description], health: Mapping[str, Health]) -> list[Flow]:
    """Every way that messages take; only what really goes, where a process tells its rates.

    What a process only listens to in vain is no flow, nor is what it sent in the past, but for
    what is kept for late joiners.
    """
    there, found = tuple(there), set()
    for sender in there:
        rates = health[sender.process].sent_hz if sender.process in health else None
        for key in sender.publishes:
            hz = rates.get(key, 0.0) if rates is not None else 0.0
            topic = topic_of(key)
            if rates is not None and not hz and not (topic and topic.keep):
                continue
            for name in receivers(key, there):
                if name != sender.process:
                    found.add(Flow(sender.process, key, name, hz))
    return sorted(found)
