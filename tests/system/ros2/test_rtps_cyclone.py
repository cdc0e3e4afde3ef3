"""Services between us and Cyclone DDS, whose rmw layer puts 16 bytes before each payload.

The rmw layer itself is on no package index: cyclonedds plays its part, with its types.
"""

import asyncio
import struct
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Any

import pytest
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import int64, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from gigabrain_zenoh.ros2.rtps import RequestReply, ServiceType
from gigabrain_zenoh.testing.waiting import until
from tests.ros2.judge import free_domain

SET_BOOL = ServiceType("std_srvs/srv/SetBool")
QOS = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(10))
TRUE = b"\0\1\0\0" + b"\1\0\0\0"
STOPPED = b"\0\1\0\0" + b"\1\0\0\0" + struct.pack("<I", 8) + b"stopped\0"


@dataclass
class Request(IdlStruct, typename="std_srvs.srv.dds_.SetBool_Request_"):  # type: ignore[call-arg]
    guid: uint64
    seq: int64
    data: bool


@dataclass
class Reply(IdlStruct, typename="std_srvs.srv.dds_.SetBool_Response_"):  # type: ignore[call-arg]
    guid: uint64
    seq: int64
    success: bool
    message: str


class Cyclone:
    """One participant of Cyclone DDS with both topics of a service."""

    def __init__(self, domain: int) -> None:
        self.participant = DomainParticipant(domain)
        self.requests = Topic(self.participant, "rq/estopRequest", Request)
        self.replies = Topic(self.participant, "rr/estopReply", Reply)

    def client(self) -> tuple[DataWriter, DataReader]:
        return (
            DataWriter(self.participant, self.requests, QOS),
            DataReader(self.participant, self.replies, QOS),
        )

    def server(self) -> tuple[DataReader, DataWriter]:
        return (
            DataReader(self.participant, self.requests, QOS),
            DataWriter(self.participant, self.replies, QOS),
        )


@pytest.fixture
async def both() -> AsyncIterator[tuple[RequestReply, Cyclone]]:
    with free_domain() as domain:
        bus = await RequestReply.open(domain)
        yield bus, await asyncio.to_thread(Cyclone, domain)
        await bus.close()


async def taken(reader: DataReader) -> Any:
    """Wait for the next valid sample, and return it."""
    found: list[Any] = []

    def take() -> bool:
        found.extend(reader.take(10))
        return bool(found)

    await until(take, "a sample")
    return found[0]


async def test_a_cyclone_client_receives_our_reply_with_its_own_header(both) -> None:
    bus, cyclone = both
    got: list[bytes] = []

    async def answer(request: bytes) -> bytes:
        got.append(request)
        return STOPPED

    served = bus.serve("/estop", SET_BOOL, answer)
    writer, reader = cyclone.client()
    await until(lambda: served.clients, "the client is found")
    await until(lambda: writer.get_publication_matched_status().current_count, "we are found")

    for number in (1 << 40, (1 << 40) + 1):
        writer.write(Request(guid=0x1122334455667788, seq=number, data=True))
        reply = await taken(reader)
        assert (reply.guid, reply.seq) == (0x1122334455667788, number)
        assert (reply.success, reply.message) == (True, "stopped")
    assert [request[:5] for request in got] == [TRUE[:5]] * 2


async def test_our_client_receives_its_reply_of_a_cyclone_server_and_not_others(both) -> None:
    bus, cyclone = both
    reader, writer = cyclone.server()
    call = asyncio.create_task(bus.call("/estop", SET_BOOL, TRUE, 30.0))
    request = await taken(reader)
    assert request.data is True

    writer.write(Reply(request.guid + 1, request.seq, False, "of another client"))
    writer.write(Reply(request.guid, request.seq + 1, False, "of another call"))
    writer.write(Reply(request.guid, request.seq, True, "stopped"))

    assert (await call)[: len(STOPPED)] == STOPPED
