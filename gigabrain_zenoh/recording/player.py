"""Plays a recording over the bus, at its own rate or another."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterable, Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path

from msgspec import Struct

from gigabrain_schemas.base import Message
from gigabrain_schemas.requests import DescribeRequest
from gigabrain_schemas.topics import DESCRIBE, Topic
from gigabrain_zenoh.bus.bus import Bus
from gigabrain_zenoh.bus.listening import topic_of
from gigabrain_zenoh.bus.transport import Transport
from gigabrain_zenoh.errors import ConfigError, Refused, unknown
from gigabrain_zenoh.host.signals import run_until, stop_signals
from gigabrain_zenoh.recording.bag_reader import Bag, Sample, check_magic
from gigabrain_zenoh.recording.node import key_filter
from gigabrain_zenoh.runtime.connect import Where, connect

DISCOVERY_S = 0.5  # for the discovery of subscribers, before the first message
REPLY_TIMEOUT_S = 0.3
MIN_ROUND_S = 0.1  # of a loop, in the recording's time; a single message has no duration


class PlayOptions(Struct, frozen=True, kw_only=True):
    """Selection of messages to play, and their rate and keys."""

    rate: float = 1.0  # times the recorded rate
    start_s: float = 0.0  # from the first message
    loop: bool = False
    topics: tuple[str, ...] = ()  # names or key expressions; empty for all
    remap: Mapping[str, str] = {}  # recorded key: key to publish on instead


class Player:
    """Publishes the messages of a bag. It drops none: a slow subscriber slows it down."""

    def __init__(self, path: Path, options: PlayOptions, transport: Transport) -> None:
        self._path, self._options, self._transport = path, options, transport
        self._topics: dict[str, Topic[Message]] = {}
        self._kept: dict[str, Sample] = {}  # newest of topics kept for late subscribers
        self._count: int | None = None  # of messages to play; None before they are counted
        self._round_end_s = 0.0  # earliest end of this round
        self.sent = 0
        self.late_s = 0.0  # greatest delay of a message

    async def play(self) -> None:
        """Play to the end, or for ever with `loop`.

        Raises ConfigError if the file is not a bag, or has no message to play.
        """
        self._declare()
        await asyncio.sleep(DISCOVERY_S)
        await self._play_once()
        while self._options.loop:
            await asyncio.sleep(max(0.0, self._round_end_s - time.monotonic()))
            await self._play_once()

    def _samples(self) -> Iterable[Sample]:
        """Iterate over the chosen messages, without those that a recorder appends meanwhile."""
        wanted = key_filter(self._options.topics)
        return islice((sample for sample in Bag(self._path) if wanted(sample.key)), self._count)

    def _declare(self) -> None:
        """Declare all publishers before the first message.

        Raises ConfigError, and UnknownName for a remapped key that is not played.
        """
        keys, first_ns, last_ns, count = dict[str, None](), 0, 0, 0
        for sample in self._samples():
            count += 1
            keys[sample.key] = None
            first_ns, last_ns = first_ns or sample.log_ns, max(last_ns, sample.log_ns)
        if not keys:
            raise ConfigError(f"{self._path} holds no message to play")
        for key in self._options.remap:
            if key not in keys:
                raise unknown("key", key, keys)
        self._count = count
        if self._options.start_s > (length_s := (last_ns - first_ns) / 1e9):
            of = " of these topics" if self._options.topics else ""
            raise ConfigError(f"--start: the recording has {round(length_s, 3):g} s{of}")
        for key in keys:
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

        self._transport.serve(self._target(key), answer)

    def _target(self, key: str) -> str:
        return self._options.remap.get(key, key)

    async def _play_once(self) -> None:
        async for sample in self._due_samples():
            topic, key = self._topics[sample.key], self._target(sample.key)
            self._transport.publish(topic, key, sample.payload, sample.encoding)
            self.sent += 1

    async def _due_samples(self) -> AsyncIterator[Sample]:
        """Yield every message when it is due; first the kept ones of the skipped part."""
        start_s, first_ns, started = 0.0, 0, False
        skipped: dict[str, Sample] = {}
        for sample in self._samples():
            first_ns = first_ns or sample.log_ns
            at_s = (sample.log_ns - first_ns) / 1e9 - self._options.start_s
            if sample.key in self._topics and self._topics[sample.key].keep:
                self._kept[sample.key] = sample
                if at_s < 0:
                    skipped[sample.key] = sample
            if at_s < 0:
                continue
            if not started:
                started, start_s = True, time.monotonic()
                self._round_end_s = start_s + MIN_ROUND_S / self._options.rate
                for kept in skipped.values():
                    yield kept
            await self._until(start_s + at_s / self._options.rate)
            yield sample

    async def _until(self, due_s: float) -> None:
        now_s = time.monotonic()
        if now_s < due_s:
            await asyncio.sleep(due_s - now_s)
        elif self.sent % 64 == 0:
            await asyncio.sleep(0)  # lets queries be answered, also when the player is late
        self.late_s = max(self.late_s, now_s - due_s)


async def check_no_driver(bus: Bus) -> None:
    """Raise Refused if a driver runs on this bus."""
    replies = await bus.ask(DESCRIBE, DescribeRequest(), timeout_s=REPLY_TIMEOUT_S, name="driver")
    if replies:
        raise Refused(
            f"a driver runs on this bus (pid {replies[0].pid}): its robot would receive "
            "all messages twice; play with another --namespace, or with --beside-robot"
        )


async def play(path: Path, options: PlayOptions, where: Where, *, beside_robot: bool) -> int:
    """Play to the end or until Ctrl-C; return the exit code. Raises GigabrainError."""
    check_magic(path)
    key_filter(options.topics)  # raises for a wrong name, before connecting
    async with connect(where, "play") as bus:
        if not beside_robot:
            await check_no_driver(bus)
        player = Player(path, options, bus.transport)
        with stop_signals() as stop:
            await run_until(stop, player.play())
    print(f"{player.sent} messages sent, at most {player.late_s * 1e3:.0f} ms late")
    return 0
