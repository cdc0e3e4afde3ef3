"""Router process: a Zenoh session that connects the others; with keys it controls access."""

import contextlib
import resource
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.config.settings import RouterConfig
from gigabrain_zenoh.runtime.audit import AuditTrail
from gigabrain_zenoh.runtime.door import Door, zenoh_log

FILES = 65536  # one per possible link, including links that never send a message
FLUSH_NS = 1_000_000_000


async def run(config: RouterConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Run access control, if keys are configured; the session itself does the routing."""
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
    """Raise the limit of open files, so that silent connections do not exhaust it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILES if hard == resource.RLIM_INFINITY else min(hard, FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(ValueError, OSError):  # some systems allow less than they report
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
