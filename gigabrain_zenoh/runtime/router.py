"""Router and relay: Zenoh sessions that connect the others; with keys the router controls access.

A relay is a host's own router, with one link to the robot's router. It does no access control: the
robot's router checks messages against the host's certificate, as if processes connected to it.
"""

import asyncio
import contextlib
import logging
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Link
from gigabrain_zenoh.config.settings import RelayConfig, RouterConfig
from gigabrain_zenoh.host.posix import resource
from gigabrain_zenoh.runtime.access_audit import AccessAudit, zenoh_log
from gigabrain_zenoh.runtime.audit import AuditTrail
from gigabrain_zenoh.runtime.running import SOCKET
from gigabrain_zenoh.security.identity_files import identity_in

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
    door = AccessAudit(trail, config.knows)
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


log = logging.getLogger(__name__)
PATIENCE_S = 1.0  # how long the router may be missing before a warning is logged


class RouterLink:
    """State of the link to the robot's router."""

    def __init__(self, router: str) -> None:
        self.open = asyncio.Event()
        self._router = router

    def see(self, link: Link) -> None:
        """Update the state when the router's link comes or goes; other links use the socket."""
        if link.address.startswith(SOCKET) or link.there == self.open.is_set():
            return
        if link.there:
            self.open.set()
            log.info("joined to the router at %s", self._router)
        else:
            self.open.clear()
            log.warning("no link to the router at %s any more", self._router)


async def run_relay(config: RelayConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Report ready once the robot's router is linked; the session itself does the routing.

    Raises ConfigError if the link fails because the host's own keys are invalid.
    """
    way = RouterLink(config.router)
    bus.links(way.see)
    try:
        await asyncio.wait_for(way.open.wait(), PATIENCE_S)
    except TimeoutError:
        if config.keys:  # a router rejects invalid keys without an error
            await asyncio.to_thread(identity_in, Path(config.keys))
        text = "no router at %s yet; waiting for it (start one with: gigabrain router)"
        log.warning(text, config.router, extra={"data": {"event": "waiting"}})
        await way.open.wait()
    ready()
    await bus.failed
