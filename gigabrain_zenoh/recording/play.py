"""Sends a recording again, at its own pace or another."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterable, Mapping
from dataclasses import replace
from pathlib import Path

from msgspec import Struct

from gigabrain_schemas.base import Message
from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.transport import Transport
from gigabrain_zenoh.errors import ConfigError, Refused
from gigabrain_zenoh.recording.bagfile import topic_of
from gigabrain_zenoh.recording.node import chosen
from gigabrain_zenoh.recording.reading import Bag, Sample

LISTENERS_S = 0.5  # for those who listen to be known everywhere, before the first message goes
ASK_S = 0.3


class PlayOptions(Struct, frozen=True, kw_only=True):
    """What to play, and how."""

    rate: float = 1.0  # times the recorded pace
    start_s: float = 0.0  # from the first message
    loop: bool = False
    topics: tuple[str, ...] = ()  # names or key expressions; all without
    remap: Mapping[str, str] = {}  # key: the key to send it on instead


class Player:
    """Sends what is in a bag. Nothing is dropped on this side: a slow reader slows it down."""

    def __init__(self, path: Path, options: PlayOptions, transport: Transport) -> None:
        self._path, self._options, self._transport = path, options, transport
        self._topics: dict[str, Topic[Message]] = {}
        self._kept: dict[str, Sample] = {}  # newest of what late joiners ask for
        self.sent = 0
        self.late_s = 0.0  # the most that a message was sent after its time

    async def play(self) -> None:
        """To the end; for ever where it loops. Raises ConfigError for what is no bag."""
        self._declare()
        await asyncio.sleep(LISTENERS_S)
        await self._once()
        while self._options.loop:
            await self._once()

    def _samples(self) -> Iterable[Sample]:
        wanted = chosen(self._options.topics)
        return (sample for sample in Bag(self._path) if wanted(sample.key))

    def _declare(self) -> None:
        """Declare all publishers before the first message."""
        seen = {sample.key: sample for sample in self._samples()}
        if not seen:
            raise ConfigError(f"{self._path} holds no message to play")
        for key in seen:
            known = topic_of(key)
            topic = known or Topic(key, Message, 1.0)
            self._topics[key] = replace(topic, congestion="block")
            if known and known.keep:
                self._serve(key)

    def _serve(self, key: str) -> None:
        async def answer(_: bytes) -> tuple[bytes, str]:
            if key not in self._kept:
                raise Refused("it has not been played yet")
            return self._kept[key].payload, self._kept[key].encoding

        self._transport.serve(self._at(key), answer)

    def _at(self, key: str) -> str:
        return self._options.remap.get(key, key)

    async def _once(self) -> None:
        async for sample in self._paced():
            self._send(sample)

    async def _paced(self) -> AsyncIterator[Sample]:
        """Every message when it is due; before the first of them the maps of what was skipped."""
        began_s, first_ns, begun = 0.0, 0, False
        for sample in self._samples():
            first_ns = first_ns or sample.log_ns
            at_s = (sample.log_ns - first_ns) / 1e9 - self._options.start_s
            if sample.key in self._topics and self._topics[sample.key].keep:
                self._kept[sample.key] = sample
            if at_s < 0:
                continue
            if not begun:
                begun, began_s = True, time.monotonic()
                for kept in self._kept.values():
                    if kept is not sample:
                        yield kept
            await self._until(began_s + at_s / self._options.rate)
            yield sample

    async def _until(self, due_s: float) -> None:
        now_s = time.monotonic()
        if now_s < due_s:
            await asyncio.sleep(due_s - now_s)
        elif self.sent % 64 == 0:
            await asyncio.sleep(0)  # whoever asks is answered however late we are
        self.late_s = max(self.late_s, now_s - due_s)

    def _send(self, sample: Sample) -> None:
        topic = self._topics[sample.key]
        self._transport.publish(topic, self._at(sample.key), sample.payload, sample.encoding)
        self.sent += 1


async def check_nobody_drives(bus: Bus) -> None:
    """Raises Refused where a driver runs on this bus: its robot would hear two of everything."""
    replies = await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=ASK_S, name="driver")
    if replies:
        raise Refused(
            f"a driver runs here (pid {replies[0].pid}); play with another --namespace, "
            "or with --beside-robot"
        )
