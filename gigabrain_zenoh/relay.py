"""A host's own router: its processes meet here, and one link leads on to the robot's router.

It judges nobody. The robot's router lets pass what the host's own certificate may say, as if each
process had come there itself.
"""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path

from gigabrain_zenoh.bus import Bus
from gigabrain_zenoh.keys.checks import identity_in
from gigabrain_zenoh.running import SOCKET
from gigabrain_zenoh.settings import RelayConfig
from gigabrain_zenoh.transport import Link

log = logging.getLogger(__name__)

PATIENCE_S = 1.0  # how long the router may be missing before somebody is told


class Way:
    """The link to the robot's router."""

    def __init__(self, router: str) -> None:
        self.open = asyncio.Event()
        self._router = router

    def see(self, link: Link) -> None:
        """Somebody has come, or has gone: by the socket the host's own, else the router."""
        if link.address.startswith(SOCKET) or link.there == self.open.is_set():
            return
        if link.there:
            self.open.set()
            log.info("joined to the router at %s", self._router)
        else:
            self.open.clear()
            log.warning("no link to the router at %s any more", self._router)


async def run(config: RelayConfig, bus: Bus, ready: Callable[[], None]) -> None:
    """Routing goes on by itself; ready once the robot's router is there.

    Raises ConfigError where the host's own keys are why it is not.
    """
    way = Way(config.router)
    bus.links(way.see)
    try:
        await asyncio.wait_for(way.open.wait(), PATIENCE_S)
    except TimeoutError:
        if config.keys:  # a router turns bad ones away without a word
            await asyncio.to_thread(identity_in, Path(config.keys))
        text = "no router at %s yet; waiting for it (start one with: gigabrain router)"
        log.warning(text, config.router, extra={"data": {"event": "waiting"}})
        await way.open.wait()
    ready()
    await bus.failed
