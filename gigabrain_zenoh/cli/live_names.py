"""TAB: what is alive now. Nothing rather than an error, and soon: a shell waits for it."""

from typing import TYPE_CHECKING

from gigabrain_zenoh.errors import GigabrainError
from gigabrain_zenoh.host.signals import run_async

if TYPE_CHECKING:
    from gigabrain_schemas.requests import Description

SOON_S = 0.3


def topics(_: object) -> list[str]:
    """Names of topics: those that somebody sends on, or those of the table while none runs."""
    from gigabrain_schemas.topics import TOPICS
    from gigabrain_zenoh.diagnostics.names import short, topic_of

    said = {key for one in _there() for key in one.publishes if topic_of(key)}
    return sorted(map(short, said or {topic.key for topic in TOPICS}))


def processes(_: object) -> list[str]:
    """Names of the processes that answer."""
    return [one.process for one in _there()]


def _there() -> list["Description"]:
    from gigabrain_zenoh.diagnostics.roll_call import roll_call
    from gigabrain_zenoh.runtime.connect import Where, joined

    async def ask() -> list["Description"]:
        async with joined(Where(), "completion") as (bus, _):
            return list((await roll_call(bus, SOON_S)).values())

    try:
        return run_async(ask())
    except GigabrainError:
        return []
