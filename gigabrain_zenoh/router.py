"""The router: a Zenoh session that joins the others. It has nothing of its own to say."""

from collections.abc import Callable

from gigabrain_zenoh.bus import Bus


async def run(bus: Bus, ready: Callable[[], None]) -> None:
    """Routing goes on by itself for as long as the session is open."""
    ready()
    await bus.failed
