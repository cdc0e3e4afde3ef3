"""Processes on one network in memory, on a clock that the test moves."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import Self, TypeVar

import msgspec

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.input_log import InputLogger
from gigabrain_zenoh.bus.transport import LocalNetwork
from gigabrain_zenoh.clock import FakeClock
from gigabrain_zenoh.host.threads import Job, done
from gigabrain_zenoh.testing.waiting import PATIENCE_S

M = TypeVar("M", bound=Message)
Node = Callable[[Bus, Callable[[], None]], Awaitable[None]]


class PatientJournal(InputLogger):
    """Waits for a node's background work, however slow the machine is.

    For tests that compare results.
    """

    def in_time(self, job: Job, patience_s: float) -> bool:
        """Wait for `job`, whatever patience the node has."""
        return done(job, PATIENCE_S)


class Net:
    """The buses of two processes on one network and one clock."""

    def __init__(self) -> None:
        self.network, self.clock = LocalNetwork(), FakeClock()
        self.one, self.two = self.bus("one"), self.bus("two")

    def bus(self, process: str) -> Bus:
        """Return the bus of one more process."""
        return Bus(self.network.transport(), self.clock, process)


class NodeBench:
    """One node alone on a network: `async with NodeBench(node) as bench:`."""

    def __init__(self, node: Node) -> None:
        self.clock, self.network = FakeClock(), LocalNetwork()
        self._node, self._read = node, 0
        self._ready = asyncio.Event()

    async def __aenter__(self) -> Self:
        self.bus = Bus(self.network.transport(), self.clock, "node")
        self.bus.input_log = PatientJournal()
        self._running = asyncio.ensure_future(self._node(self.bus, self._ready.set))
        await self.clock.advance(0)
        return self

    async def ready(self) -> None:
        """Wait until the node is ready; some compile first."""
        waiting = asyncio.ensure_future(self._ready.wait())
        await asyncio.wait((waiting, self._running), return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if self._running.done():
            self._running.result()

    async def restart(self) -> None:
        """End the node, and start it again."""
        await self._end()
        self._ready.clear()
        await self.__aenter__()

    async def __aexit__(self, *_: object) -> None:
        await self._end()

    async def _end(self) -> None:
        self._running.cancel()
        result = (await asyncio.gather(self._running, return_exceptions=True))[0]
        await self.bus.close()
        assert isinstance(result, asyncio.CancelledError), result

    def send(self, topic: Topic[M], message: M) -> None:
        """Deliver `message` to the node with the header it has."""
        self.network.deliver(topic.at(), codec.encode(message))

    def sent(self, topic: Topic[M]) -> list[M]:
        """Return what the node has published on `topic` since the last call.

        What it has published on other topics meanwhile is dropped.
        """
        new = self.network.sent[self._read :]
        self._read = len(self.network.sent)
        decode = msgspec.msgpack.Decoder(topic.type).decode
        return [decode(payload) for key, payload in new if key == topic.key]
