"""Relay process: a host's own router, with one link to the robot's router.

It does no access control. The robot's router checks messages against the host's certificate, as if
each process had connected to it directly.
"""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Link
from gigabrain_zenoh.config.settings import RelayConfig
from gigabrain_zenoh.runtime.running import SOCKET
from gigabrain_zenoh.security.checks import identity_in

log = logging.getLogger(__name__)

PATIENCE_S = 1.0  # how long the router may be missing before a warning is logged


class Way:
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


async def run(config: RelayConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Report ready once the robot's router is linked; the session itself does the routing.

    Raises ConfigError if the link fails because the host's own keys are invalid.
    """
    way = Way(config.router)
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
