"""The router: a Zenoh session that joins the others, and with keys keeps the door."""

import contextlib
import resource
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.audit import AuditTrail
from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.keys.door import Door, zenoh_log
from gigabrain_zenoh.settings import RouterConfig

FILES = 65536  # as many as there may be links, also those that never say a word
FLUSH_NS = 1_000_000_000


async def run(config: RouterConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Routing goes on by itself for as long as the session is open."""
    _make_room()
    if not config.knows:
        ready()
        await bus.failed
        return
    trail = AuditTrail(bus, Path(config.state_dir))
    door = Door(trail, config.knows)
    try:
        with zenoh_log(door.seen):
            bus.links(door.link)
            ready()
            await _keep(bus, trail)
    finally:
        await trail.close()


async def _keep(bus: Bus, trail: AuditTrail) -> None:
    async for _ in bus.clock.every(FLUSH_NS):
        trail.flush()
        if bus.failed.done():
            bus.failed.result()


def _make_room() -> None:
    """Silent connections must not use up the files that this process may have open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(hard, FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(ValueError, OSError):  # some systems allow less than they say
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
