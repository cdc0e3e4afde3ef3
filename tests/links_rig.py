"""Who hears what a link brings, and patience."""

import asyncio
from collections.abc import Callable

from gigabrain_drivers.links.link import Link

GENEROUS_S = 60.0


async def until(condition: Callable[[], object]) -> None:
    """Wait for something that must come true."""
    async with asyncio.timeout(GENEROUS_S):
        while not condition():  # noqa: ASYNC110 - nothing here could set an event
            await asyncio.sleep(0.002)


class Heard:
    """What a link told its owner."""

    def __init__(self, link: Link) -> None:
        self.data, self.opened, self.lost = b"", 0, list[str]()
        link.on_bytes, link.on_open, link.on_lost = self._bytes, self._opened, self.lost.append

    def _bytes(self, data: bytes) -> None:
        self.data += data

    def _opened(self) -> None:
        self.opened += 1
