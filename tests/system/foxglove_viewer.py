"""A viewer that speaks Foxglove's WebSocket protocol, written from its specification."""

import asyncio
import json
import struct
from collections.abc import Iterator
from typing import Any

from websockets.asyncio.client import ClientConnection

PATIENCE_S = 20.0
MESSAGE = struct.Struct("<BIQ")  # opcode 1, subscription, time [ns]
SAY = struct.Struct("<BI")  # opcode 1, channel


class Viewer:
    """Keeps what the server says."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[str, dict[str, Any]] = {}  # by topic
        self.graph: dict[str, Any] = {}
        self.server: dict[str, Any] = {}
        self._subscribed: dict[int, str] = {}
        self._messages: dict[str, list[bytes]] = {}

    async def say(self, **values: object) -> None:
        await self._socket.send(json.dumps(values))

    async def channel(self, topic: str) -> dict[str, Any]:
        while topic not in self.channels:
            await self._hear()
        return self.channels[topic]

    async def subscribe(self, topic: str) -> None:
        number = (await self.channel(topic))["id"]
        self._subscribed[number] = topic
        await self.say(op="subscribe", subscriptions=[{"id": number, "channelId": number}])

    async def message(self, topic: str) -> bytes:
        """The next one on `topic`."""
        while not self._messages.get(topic):
            await self._hear()
        return self._messages[topic].pop(0)

    async def connections(self, topic: str) -> dict[str, Any]:
        while topic not in str(self.graph):
            await self._hear()
        return self.graph

    async def publish_on(self, topic: str, channel: int = 1) -> None:
        about = {"id": channel, "topic": topic, "encoding": "json", "schemaName": "Twist"}
        await self.say(op="advertise", channels=[about])

    async def publish(self, content: object, channel: int = 1) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        await self._socket.send(SAY.pack(1, channel) + data)

    async def _hear(self) -> None:
        frame = await asyncio.wait_for(self._socket.recv(), PATIENCE_S)
        if isinstance(frame, bytes):
            opcode, number, _ = MESSAGE.unpack_from(frame)
            assert opcode == 1
            self._messages.setdefault(self._subscribed[number], []).append(frame[MESSAGE.size :])
            return
        told = json.loads(frame)
        if told["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in told["channels"]}
        elif told["op"] == "connectionGraphUpdate":
            self.graph = told
        elif told["op"] == "serverInfo":
            self.server = told


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """The fields of a Protocol Buffers message: number, and bytes, float64 or fixed32."""
    at = 0

    def varint() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            value, shift, at = value | (byte & 127) << shift, shift + 7, at + 1
            if byte < 128:
                return value

    while at < len(data):
        number, kind = divmod(varint(), 8)
        if kind == 0:
            yield number, varint()
        elif kind == 1:
            yield number, struct.unpack_from("<d", data, at)[0]
            at += 8
        elif kind == 5:
            yield number, struct.unpack_from("<I", data, at)[0]
            at += 4
        else:
            length = varint()
            yield number, data[at : at + length]
            at += length
