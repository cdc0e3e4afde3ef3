"""Somebody on the robot's network who writes what he likes, headers included."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from gigabrain_schemas.base import Message
from gigabrain_schemas.topics import Topic
from gigabrain_zenoh import codec
from gigabrain_zenoh.bus.zenoh.transport import ZenohTransport
from gigabrain_zenoh.config.settings import Endpoint


class Forger:
    """Sends messages as they are given, and bytes that are none."""

    def __init__(self, transport: ZenohTransport) -> None:
        self._transport = transport

    def send(self, topic: Topic[Any], message: Message) -> None:
        """A message with the header that it has."""
        self.send_bytes(topic, codec.encode(message), codec.encoding_of(topic.type))

    def send_bytes(self, topic: Topic[Any], payload: bytes, encoding: str = "") -> None:
        """Anything at all."""
        self._transport.publish(topic, topic.at("forger"), payload, encoding)


@asynccontextmanager
async def forging(endpoint: Endpoint) -> AsyncIterator[Forger]:
    """A forger with a session of his own."""
    transport = await ZenohTransport.open(endpoint)
    try:
        yield Forger(transport)
    finally:
        await transport.close()
