"""A robot's own nodes on one network inside this process, in fake time."""

import asyncio
from collections.abc import Mapping
from typing import Self, TypeVar

from gigabrain_schemas.base import TICK_NS, Message
from gigabrain_schemas.topics import Service
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.runtime.replay import Node

Q = TypeVar("Q", bound=Message)
R = TypeVar("R", bound=Message)

ANSWER_S = 30.0  # of wall time: an answer may take work beside the loop


class InMemory:
    """Used as `async with InMemory(nodes) as robot:`. The last of the nodes brings the ticks."""

    def __init__(self, nodes: Mapping[str, Node]) -> None:
        self._nodes = nodes
        self._network, self._clock = LocalNetwork(), FakeClock()
        self._running: dict[str, tuple[asyncio.Future[None], Bus]] = {}

    async def __aenter__(self) -> Self:
        self.operator = Bus(self._network.transport(), self._clock, "operator")
        for name, node in self._nodes.items():
            ready, bus = asyncio.Event(), Bus(self._network.transport(), self._clock, name)
            running = asyncio.ensure_future(node(bus, ready.set))
            self._running[name] = running, bus
            waiting = asyncio.ensure_future(ready.wait())
            await asyncio.wait((running, waiting), return_when=asyncio.FIRST_COMPLETED)
            waiting.cancel()
            self._check()
        return self

    async def __aexit__(self, *_: object) -> None:
        for running, bus in reversed(self._running.values()):
            running.cancel()
            await asyncio.wait((running,))
            await bus.close()
        await self.operator.close()

    async def tick(self) -> None:
        """Let 20 ms pass. Raises whatever has ended a node."""
        await self._clock.advance(TICK_NS)
        self._network.sent.clear()
        self._check()

    async def ask(self, service: Service[Q, R], request: Q) -> list[R]:
        """What the nodes answer, while time stands still. Raises Refused, with why."""
        return await self.operator.ask(service, request, timeout_s=ANSWER_S)

    def _check(self) -> None:
        for running, _ in self._running.values():
            if running.done():
                running.result()
