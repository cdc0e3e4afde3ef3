"""A viewer that speaks Foxglove's WebSocket protocol, written from its specification."""

import asyncio
import json
import struct
from collections.abc import Iterator
from typing import Any

from websockets.asyncio.client import ClientConnection

PATIENCE_S = 20.0
MESSAGE = struct.Struct("<BIQ")  # opcode 1, subscription, time [ns]
CALL = struct.Struct("<BIII")  # opcode 2 or 3, service, call, length of the encoding
PUBLISH = struct.Struct("<BI")  # opcode 1, channel


class Viewer:
    """A connection that keeps the messages of the server."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[str, dict[str, Any]] = {}  # topic -> channel
        self.graph: dict[str, Any] = {}
        self.server: dict[str, Any] = {}
        self._subscribed: dict[int, str] = {}
        self._messages: dict[str, list[bytes]] = {}
        self.services: dict[str, int] = {}
        self._calls, self._answers = 0, dict[int, dict[str, Any]]()
        self._parameters: dict[str, list[dict[str, Any]]] = {}  # request -> parameters

    async def send(self, **values: object) -> None:
        await self._socket.send(json.dumps(values))

    async def channel(self, topic: str) -> dict[str, Any]:
        while topic not in self.channels:
            await self._receive()
        return self.channels[topic]

    async def subscribe(self, topic: str) -> None:
        number = (await self.channel(topic))["id"]
        self._subscribed[number] = topic
        await self.send(op="subscribe", subscriptions=[{"id": number, "channelId": number}])

    async def message(self, topic: str) -> bytes:
        """Return the next message on `topic`."""
        while not self._messages.get(topic):
            await self._receive()
        return self._messages[topic].pop(0)

    async def connections(self, topic: str) -> dict[str, Any]:
        while topic not in str(self.graph):
            await self._receive()
        return self.graph

    async def publish_on(self, topic: str, channel: int = 1) -> None:
        about = {"id": channel, "topic": topic, "encoding": "json", "schemaName": "Twist"}
        await self.send(op="advertise", channels=[about])

    async def publish(self, content: object, channel: int = 1) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        await self._socket.send(PUBLISH.pack(1, channel) + data)

    async def call(self, service: str, content: object = None) -> dict[str, Any]:
        """Wait until a service is advertised, call it, and return its reply."""
        while service not in self.services:
            await self._receive()
        self._calls += 1
        head = CALL.pack(2, self.services[service], self._calls, 4) + b"json"
        await self._socket.send(head + json.dumps(content or {}).encode())
        while self._calls not in self._answers:
            await self._receive()
        return self._answers[self._calls]

    async def parameters(self, *names: str) -> dict[str, Any]:
        """Return the values of parameters by name."""
        await self.send(op="getParameters", parameterNames=names, id="get")
        return await self._values("get")

    async def set_parameters(self, **values: object) -> dict[str, Any]:
        """Set parameters and return their new values; two underscores stand for a dot."""
        wanted = [{"name": n.replace("__", "."), "value": v} for n, v in values.items()]
        await self.send(op="setParameters", parameters=wanted, id="set")
        return await self._values("set")

    async def _values(self, request: str) -> dict[str, Any]:
        while request not in self._parameters:
            await self._receive()
        return {one["name"]: one.get("value") for one in self._parameters.pop(request)}

    async def _receive(self) -> None:
        frame = await asyncio.wait_for(self._socket.recv(), PATIENCE_S)
        if isinstance(frame, bytes):
            if frame[0] == 3:
                _, _, call, length = CALL.unpack_from(frame)
                self._answers[call] = json.loads(frame[CALL.size + length :])
                return
            opcode, number, _ = MESSAGE.unpack_from(frame)
            assert opcode == 1
            self._messages.setdefault(self._subscribed[number], []).append(frame[MESSAGE.size :])
            return
        message_json = json.loads(frame)
        if message_json["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in message_json["channels"]}
        elif message_json["op"] == "connectionGraphUpdate":
            self.graph = message_json
        elif message_json["op"] == "serverInfo":
            self.server = message_json
        elif message_json["op"] == "advertiseServices":
            self.services |= {one["name"]: one["id"] for one in message_json["services"]}
        elif message_json["op"] == "parameterValues":
            self._parameters[message_json.get("id", "")] = message_json["parameters"]


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Yield the fields of a Protocol Buffers message: number, and bytes, float64 or fixed32."""
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
